"""The table of `make conformance`, and its host in C: compiled FMUs where there is no Python, every kind."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from ..data import ROOT, slow_but
from . import conformance
from .conformance import (
    BACKENDS,
    KINDS,
    MARKS,
    TOOLS,
    c_host,
    case,
    compared,
    fmpy_exchange,
    in_events,
    place_of,
    table,
)

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
    places = [place_of(tool, *place) for tool in TOOLS for place in tool.places() if here[tool.name]]
    found = {kind: dict.fromkeys(places, "") for kind in ("rls", "pi")}
    found["rls"]["fmpy, compiled 2.0, ME"] = "pitch is off by 1e-3"
    lines = table(here, found).splitlines()
    rows = {
        tuple(line.split("|")[i] for i in (1, 3, 4)): line.split("|")[5:7] for line in lines if line.startswith("|")
    }
    for name in ("fmusim", "fmuCheck", "vdmcheck2", "vdmcheck3", "OMSimulator", "our host in C"):
        assert {one for (tool, *_), cells in rows.items() if tool == name for one in cells} == {"not run"}
    assert rows["fmpy", "compiled 2.0", "ME"] == ["fail", "pass"]
    assert rows["fmpy", "compiled 2.0", "CS"] == ["pass", "pass"]
    assert lines[-1] == "- rls: fmpy, compiled 2.0, ME: pitch is off by 1e-3"


def test_the_page_has_the_table_of_the_command() -> None:
    """Rows and columns of the command; `make conformance` writes the cells. Four tools at least ran."""
    text = (ROOT / "docs" / "howto" / "conformance.md").read_text(encoding="utf-8")
    lines = [line.split("|")[1:-1] for line in text.split(MARKS[0])[1].split(MARKS[1])[0].splitlines() if "|" in line]
    assert lines[0] == ["tool", "version", "FMU", "interface", *KINDS]
    rows = {(tool, backend, interface): cells for tool, _, backend, interface, *cells in lines[2:]}
    assert list(rows) == [(tool.name, *place) for tool in TOOLS for place in tool.places()]
    assert {cell for cells in rows.values() for cell in cells} <= {"pass", "fail", "not run"}
    for tool in ("fmpy", "libcosim", "ecos", "fmusim"):
        assert not any("not run" in cells for (name, *_), cells in rows.items() if name == tool)


@needs_cc
@pytest.mark.parametrize("kind", ["rls", "pi"])
def test_model_exchange_shows_a_plants_outputs_at_the_event_and_a_laws_behind_it(kind: str, tmp_path: Path) -> None:
    made = case(kind, BACKENDS[1], tmp_path)
    shown = in_events(made).expected
    if kind == "rls":
        assert (shown[1:] == made.expected[:-1]).all()
        assert (shown[0] == made.block.initial_state().outputs).all()
    else:
        assert (shown == made.expected).all()
    assert fmpy_exchange(made) == ""
    off = made.expected.copy()
    off[-2, 0] += 1e-6
    assert "is off by" in fmpy_exchange(replace(made, expected=off))


def test_what_a_tool_throws_is_wrong(tmp_path: Path) -> None:
    def broken(_: conformance.Case) -> str:
        raise OSError("nobody there")

    made = conformance.Case(conformance.block_of("rls"), tmp_path, None, None)  # type: ignore[arg-type]
    assert conformance.asked(broken, made) == "OSError: nobody there"
