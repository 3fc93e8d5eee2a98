"""Run a loop and time it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import SettingsError, silent
from softneck.core._progress import shown_progress
from softneck.loop import Loop as Loop  # the room hands it on
from softneck.loop import LoopState, run_loop
from softneck.loop._run import StepCallback
from softneck.loop._system import System

from ._loop_file import LoopSetup, load_loop, load_ssp, make_loop
from ._result import Result
from ._validity import reach_beyond, validity_remarks


def simulate(
    loop: Loop | LoopSetup | System | Mapping[str, Any] | str | Path,
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
        loop: a plain loop, one with limits as `load_loop` returns it, a loop file, an SSP archive, a system as
            `load_ssp` returns it, or a table of a loop file's keys, whose relative paths start at the working folder
            and which may hold objects (see `make_loop`).
        report: called now and then with the done fraction; a bar in a terminal if not given.
        on_step: called after each row with a `LoopStep`; it stops the run by returning True.
        pace: run at this multiple of real time; as fast as possible if not given.
        resume: go on from this state instead of t = 0.
        keep: leave the FMUs loaded, so that the next run of the same loop resets them; `loop.close()` ends it.
        compiled: run loops whose parts are all blocks (softneck files, the virtual neck, no FMUs) as one compiled
            function: the same bits, sooner after a second of compiling, which is kept.

    Where the plant's `validity` falls under 0.5 it warns once (`Result.remarks`).

    Raises:
        SettingsError: parts that do not fit together, or what `make_loop` refuses.
        DataError: a part returned what is not a number.
        FmuError: an FMU refused a call.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> controller = softneck.design_controller("pi", softneck.identify("rls", recording))
        >>> step = {"kind": "step", "pitch_deg": 10.0, "at_s": 0.5}
        >>> loop = {"duration_s": 3.0, "plant": "paper", "controller": controller, "reference": step}
        >>> result = softneck.simulate({**loop, "limits": {"pitch.overshoot_pct": 20.0}})
        >>> result.holds, list(result.to_pandas())[:2]
        (True, ['pitch', 'roll'])
    """
    with shown_progress("simulate", None if report is None else lambda done, _: report(done)) as tell:
        result = run_setup(
            _opened(loop), report=None if tell is silent else lambda done: tell(done, ""), on_step=on_step, pace=pace,
            resume=resume, keep=keep, compiled=compiled,
        )  # fmt: skip
    # A plant without validity is told in `remarks` and by the command: no warning for every model made by hand.
    for remark in result.remarks if np.any(result.signals.signals.get("validity", 0.0)) else ():
        warnings.warn(remark, stacklevel=2)
    return result


def run_setup(
    setup: LoopSetup | System,
    *,
    report: Callable[[float], None] | None = None,
    on_step: StepCallback | None = None,
    pace: float | None = None,
    resume: LoopState | None = None,
    keep: bool = False,
    compiled: bool = False,
) -> Result:
    """Run a loop as `simulate` does, whose remarks the caller tells."""
    plain = setup if isinstance(setup, System) else setup.loop
    begin = time.perf_counter()
    signals = run_loop(plain, report, on_step=on_step, pace=pace, resume=resume, keep=keep, compiled=compiled)
    wall = time.perf_counter() - begin
    if isinstance(setup, System):
        return Result(signals=signals, wall_time=wall, order=plain.order, closed=False)
    loop = setup.loop
    beyond = reach_beyond(loop.controller, loop.controller_parameters, loop.robot)
    return Result(
        signals=signals,
        bounds=setup.limits,
        wall_time=wall,
        files=setup.files,
        order=plain.order,
        angle=setup.angle,
        remarks=(*([f"{beyond}."] if beyond else []), *validity_remarks(signals, loop.plant)),
    )


def _opened(loop: Any) -> LoopSetup | System:
    if isinstance(loop, LoopSetup | System):
        return loop
    if isinstance(loop, Loop):
        return LoopSetup(loop=loop)
    if isinstance(loop, Mapping):
        return make_loop(loop)
    if isinstance(loop, str | Path):
        return load_ssp(loop) if Path(loop).suffix == ".ssp" else load_loop(loop)
    raise SettingsError(f"`loop` must be a Loop, a loop file or a table of its keys; got a {type(loop).__name__}.")
