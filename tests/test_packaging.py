"""One version, one list of dependencies, and a README whose links lead somewhere from a wheel."""

from __future__ import annotations

import email
import importlib.util
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import softneck

from .data import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# What conda-forge calls otherwise.
CONDA_NAMES = {"matplotlib-base": "matplotlib"}


def with_links(text: str, home: str | None) -> str:
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.with_links(text, home)


def test_the_version_stands_in_one_place() -> None:
    assert "version" in PROJECT["dynamic"]
    assert "version" not in PROJECT
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited is not None
    assert cited[1] == softneck.__version__
    assert "set version = load_file_regex" in (ROOT / "conda" / "meta.yaml").read_text(encoding="utf-8")


def test_the_conda_recipe_asks_for_what_the_wheel_asks_for() -> None:
    recipe = (ROOT / "conda" / "meta.yaml").read_text(encoding="utf-8")
    run = recipe.split("  run:\n")[1].split("\n\n")[0]
    listed = dict(re.findall(r"- (\S+) (>=\S+)", run))
    assert listed.pop("python") == PROJECT["requires-python"]
    asked = dict(re.fullmatch(r"([a-z0-9-]+)(>=.+)", one).groups() for one in PROJECT["dependencies"])  # type: ignore[union-attr]
    assert {CONDA_NAMES.get(name, name): bound for name, bound in listed.items()} == asked


def test_links_are_absolute_where_a_home_is_known_and_words_where_not() -> None:
    text = "![loop](docs/loop.svg) [names](docs/names.md#a) [there](https://example.org) [here](#top)"
    home = "https://example.org/softneck"
    assert with_links(text, home) == (
        f"![loop]({home}/docs/loop.svg) [names]({home}/docs/names.md#a) [there](https://example.org) [here](#top)"
    )
    assert with_links(text, None) == "loop names [there](https://example.org) [here](#top)"


def test_every_link_of_the_readme_leads_to_a_file() -> None:
    links = re.findall(r"\]\((?!https?://|#)([^)#]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []


@pytest.mark.slow
def test_the_readme_of_a_wheel_has_no_dead_link(tmp_path: Path) -> None:
    hook = "import sys; from hatchling import build; print(build.build_wheel(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", hook, str(tmp_path)], cwd=ROOT, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        told = email.message_from_bytes(archive.read(name))
    text = told.get_payload()
    assert isinstance(text, str)
    assert text.startswith("# softneck")
    assert re.findall(r"\]\((?!https?://|#)", text) == []
    assert told["Description-Content-Type"] == "text/markdown"
    assert told["Version"] == softneck.__version__
