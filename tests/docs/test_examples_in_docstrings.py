"""Every public name of the front door has an example in its docstring, which runs."""

from __future__ import annotations

import doctest
from pathlib import Path

import pytest

import softneck

NAMES = ("Recording", "Robot", "VirtualNeck", "build_fmu", "calibrate", "design_controller", "family",
         "frequency_response", "identify", "import_log", "linearize", "load", "observer", "read_recording", "record",
         "simulate", "study", "tune", "validate", "verify")  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_example_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    thing = getattr(softneck, name)
    (found,) = [test for test in doctest.DocTestFinder(recurse=False).find(thing, name, globs={}) if test.examples]
    said: list[str] = []
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(found, out=said.append)
    assert result.attempted >= 4
    assert result.failed == 0, "".join(said)


def test_no_name_is_left_out() -> None:
    rooms = {name for name in vars(softneck)["__all__"] if type(getattr(softneck, name)).__name__ == "module"}
    assert set(vars(softneck)["__all__"]) - rooms == set(NAMES)
