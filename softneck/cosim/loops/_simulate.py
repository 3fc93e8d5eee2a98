"""Run a loop and time it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from softneck.core import SettingsError
from softneck.loop import Loop, LoopState, run_loop
from softneck.loop._run import StepCallback

from ._loop_file import LoopSetup, load_loop, make_loop
from ._result import Result


def simulate(
    loop: Loop | LoopSetup | Mapping[str, Any] | str | Path,
    *,
    report: Callable[[float], None] | None = None,
    on_step: StepCallback | None = None,
    pace: float | None = None,
    resume: LoopState | None = None,
    keep: bool = False,
    compiled: bool = False,
) -> Result:
    """Run a loop from t = 0 to its end.

    Args:
        loop: a plain loop, one with limits as `load_loop` returns it, a loop file, or a table of its keys, whose
            relative paths start at the working folder and which may hold objects (see `make_loop`).
        report: called now and then with the done fraction.
        on_step: called after each row with a `LoopStep`; it stops the run by returning True.
        pace: run at this multiple of real time; as fast as possible if not given.
        resume: go on from this state instead of t = 0.
        keep: leave the FMUs loaded, so that the next run of the same loop resets them; `loop.close()` ends it.
        compiled: run loops whose parts are all blocks (softneck files, the virtual neck, no FMUs) as one compiled
            function: the same bits, sooner after a second of compiling, which is kept.

    Raises:
        SettingsError: parts that do not fit together, or what `make_loop` refuses.
        DataError: a part returned what is not a number.
        FmuError: an FMU refused a call.
    """
    setup = _opened(loop)
    begin = time.perf_counter()
    signals = run_loop(setup.loop, report, on_step=on_step, pace=pace, resume=resume, keep=keep, compiled=compiled)
    wall = time.perf_counter() - begin
    return Result(
        signals=signals,
        bounds=setup.limits,
        wall_time=wall,
        files=setup.files,
        order=setup.loop.order,
        angle=setup.angle,
    )


def _opened(loop: Any) -> LoopSetup:
    if isinstance(loop, LoopSetup):
        return loop
    if isinstance(loop, Loop):
        return LoopSetup(loop=loop)
    if isinstance(loop, Mapping):
        return make_loop(loop)
    if isinstance(loop, str | Path):
        return load_loop(loop)
    raise SettingsError(f"`loop` must be a Loop, a loop file or a table of its keys; got a {type(loop).__name__}.")
