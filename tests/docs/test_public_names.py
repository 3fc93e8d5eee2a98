"""Each public name has its line in `docs/reference`."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import pytest

from ..data import ROOT


@pytest.fixture(scope="module")
def names() -> ModuleType:
    """The extension that lists them."""
    spec = importlib.util.spec_from_file_location("public_names", ROOT / "docs" / "public_names.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_public_name_says_in_a_line_what_it_is_for(names: ModuleType) -> None:
    listed = [item for subpackage in names.subpackages() for item in names.names_of(subpackage)]
    assert len(listed) > 200
    assert [f"{item.subpackage}.{item.name}" for item in listed if not item.purpose.endswith((".", ")", "`"))] == []


def test_the_page_has_every_subpackage_and_name(names: ModuleType) -> None:
    text = names.page()
    for subpackage in names.subpackages():
        assert f"## {subpackage}\n" in text
        for item in names.names_of(subpackage):
            assert f"`{item.name} <{item.target}>`" in text
