"""Compile what later steps of `start` call, in a process beside the steps before them."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import softneck
from softneck.core import DataError, load
from softneck.robot import Robot
from softneck.runtime import cache_folder

from .._main import GARBAGE_THRESHOLDS
from ._plan import AUTO, FAMILY, KINDS_BESIDE_DRAWS, PI, linear_model

if TYPE_CHECKING:
    from softneck.identification import Family

# Enough for a linear model; the names and sizes of what is compiled do not depend on them.
_ROWS = 2000


def compile_ahead(*recordings: str) -> None:
    """Compile what the steps after the models call, in a process that no step waits for.

    Run are an observer over a model of few rows, which needs nothing that the steps beside it compile, loops of the
    first controllers over the family, then over the best model if that is nonlinear, and the predictions of the report;
    the steps then load the functions from the cache.
    """
    from softneck import estimation, identification, signals

    gc.set_threshold(*GARBAGE_THRESHOLDS)
    first = signals.read_recording(recordings[0])
    few = first.rows(0, _ROWS)
    with contextlib.suppress(DataError):
        model = identification.Rls().fit(few)
        estimation.fit_observer(estimation.KalmanSettings().design(model), [few], set())
    family = _await(FAMILY)
    if family.draws is not None:
        _judge_kinds(family, family.draws.model)
    _await(PI)  # the models are there then
    if family.draws is not None and linear_model() != AUTO:
        _judge_kinds(family, load(AUTO))
    for name in dict.fromkeys((AUTO, linear_model())):
        load(name).predict(first, 2)  # any horizon but one sample
    compiled_before().touch()


def _judge_kinds(family: Family, model: Any) -> None:
    """Judge the first candidates that `start` tunes, over one model."""
    from softneck import tuning

    bare = replace(family, draws=None)  # with draws, margins would be those of 59
    task = tuning.task_of([bare, model], None, 0)
    for kind in KINDS_BESIDE_DRAWS.split(","):
        for level in reversed(tuning.LEVELS):  # margins first: the search needs their loops last
            tuning.judge_candidate(task, kind, {}, level)


def _await(name: str) -> Any:
    """Return the content of a file when it is there; end if the process that began this one ended before."""
    parent = os.getppid()
    while not Path(name).is_file():
        time.sleep(0.2)
        if os.getppid() != parent:
            sys.exit(1)
    return load(name)


def compiled_before() -> Path:
    """Return a file that is there if a run for as many motors and outputs has compiled these runtimes."""
    robot = Robot.read("robot.toml")
    content = [path.read_bytes() for path in sorted(Path(softneck.__file__).parent.rglob("*_runtime.py"))]
    sizes = f"{len(robot.motors.names)}_{len(robot.outputs.names)}"
    return cache_folder() / f"start_{sizes}_{hashlib.sha256(b''.join(content)).hexdigest()[:16]}"
