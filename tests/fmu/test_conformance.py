"""The table of `make conformance`, and its host in C: compiled FMUs where there is no Python, every kind."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from ..data import slow_but
from . import conformance
from .conformance import BACKENDS, KINDS, TOOLS, c_host, case, compared, table

needs_cc = pytest.mark.skipif(shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here")


@needs_cc
@pytest.mark.parametrize("kind", slow_but(KINDS, ("rls",)))
def test_a_host_without_python_computes_the_same(kind: str, tmp_path: Path) -> None:
    made = case(kind, BACKENDS[1], tmp_path)
    assert c_host(made) == ""
    # And would say so if it did not.
    off = made.expected.copy()
    off[-1, 0] += 1e-6
    assert "is off by" in compared(made, off)


def test_what_is_absent_is_not_run_and_never_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    here = {tool.name: tool.found() for tool in TOOLS}
    wrong = {(tool.name, backend): list[str]() for tool in TOOLS for backend in BACKENDS}
    wrong["fmpy", BACKENDS[0]] = ["rls: pitch is off by 1e-3"]
    lines = table(here, wrong, ["rls", "pi"]).splitlines()
    rows = {line.split(" | ")[0].strip("| "): line for line in lines if line.startswith("| ")}
    for name in ("fmusim", "fmuCheck", "vdmcheck2", "vdmcheck3", "OMSimulator", "our host in C"):
        assert "not run" in rows[name]
        assert " of " not in rows[name]
    assert "1 of 2 | 2 of 2 | 2 of 2" in rows["fmpy"]
    assert lines[-1] == "- fmpy, python 2.0: rls: pitch is off by 1e-3"


def test_what_a_tool_throws_is_wrong(tmp_path: Path) -> None:
    def broken(_: conformance.Case) -> str:
        raise OSError("nobody there")

    tool = conformance.Tool("broken", lambda: "1", BACKENDS, broken)
    made = conformance.Case(conformance.block_of("rls"), tmp_path, None, None)  # type: ignore[arg-type]
    assert conformance.asked(tool, made) == "OSError: nobody there"
