"""Short plans of cheap commands, to see how a run goes on, stops and resumes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softneck.cli.start import _start
from softneck.cli.start._plan import Options, Step, Unmet
from softneck.cli.start._project_run import ProjectRun
from softneck.cli.start._start import _certified, _doubts


def short_plan(asked: Options) -> Iterator[Step]:
    """A robot, a copy of it, and a project of the virtual neck: plain commands, each of what the one before made."""
    first = ("softneck", "robot", "new", "robot.toml", "--preset", asked.robot or "neck", "--force")
    yield Step(stage="robot", command=first, makes=("robot.toml",), reads=asked.logs)
    second = ("softneck", "robot", "new", "copy.toml", "--preset", "robot.toml", "--force")
    yield Step(stage="quality", command=second, makes=("copy.toml",), reads=("robot.toml",))
    third = ("softneck", "new", "project", "--force")
    yield Step(stage="loop", command=third, makes=("project/loop.toml",), reads=("copy.toml",), unmet=Unmet.FINDING)


def facts_of(run: ProjectRun, folder: Path) -> dict[str, Any]:
    """What a run that ends before its models says of itself."""
    rows = [{"stage": key.partition(":")[0], "done_before": kept, **run.done[key]}
            for key, kept in run.ran.items()]  # fmt: skip
    more = {"models": {}, "report": "none", "doubts": _doubts(), **_certified(), "failed": [], "steps": rows}
    return {"folder": str(folder), **more}


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Let a run have the short plan; return a log."""
    monkeypatch.setattr(_start, "steps", short_plan)
    monkeypatch.setattr(_start, "_facts", facts_of)
    path = tmp_path / "log.csv"
    path.write_text("a,b\n1,2\n", encoding="utf-8")
    return path
