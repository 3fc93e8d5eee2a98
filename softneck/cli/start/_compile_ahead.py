"""Compile what later steps of `start` call, in a process beside the steps before them."""

from __future__ import annotations

import gc
import hashlib
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import softneck
from softneck.core import load
from softneck.robot import Robot
from softneck.runtime import cache_folder

from .._main import GARBAGE_THRESHOLDS
from ._plan import AUTO, FAMILY, PI, linear_model


def compile_ahead(*recordings: str) -> None:
    """Compile what the steps after the models call, in a process that no step waits for, with the lowest priority.

    Run are an observer and the loops of one controller, over the model of the draws and over the best model if that is
    nonlinear, when they are there, and the predictions of the report; the steps then load the functions from the cache.
    """
    from softneck import estimation, signals, tuning

    getattr(os, "nice", int)(19)
    gc.set_threshold(*GARBAGE_THRESHOLDS)
    family = _await(FAMILY)
    observer = estimation.KalmanSettings().design(family)
    fitted = estimation.fit_observer(observer, [signals.read_recording(name) for name in recordings], set())
    estimation.consistency(fitted.observer, signals.read_recording(recordings[0]))
    bare = replace(family, draws=None)  # with draws, margins would be those of 59
    for model in [] if family.draws is None else [family.draws.model, None]:
        if model is None:
            _await(PI)
            if linear_model() == AUTO:
                break
        task = tuning.task_of([bare, model or load(AUTO)], None, 0)
        for level in reversed(tuning.LEVELS):  # margins first: the search needs their loops last
            tuning.judge_candidate(task, "pi", {}, level)
    _await(PI)  # the models are there then
    first = signals.read_recording(recordings[0])
    for name in dict.fromkeys((AUTO, linear_model())):
        load(name).predict(first, 2)  # any horizon but one sample
    compiled_before().touch()


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
