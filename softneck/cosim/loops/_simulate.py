"""Run a loop and time it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from softneck.core import require_one_of
from softneck.loop import Loop, LoopState, run_loop
from softneck.loop._run import StepCallback

from ._result import Result


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LoopSetup:
    """A loop with what is asked of it; a loop file describes one.

    Attributes:
        loop: the parts, the reference, the order.
        limits: metric -> upper limit, such as "pitch.overshoot_pct": 5.0.
        files: what was read for it: role -> (path, SHA-256).
        angle: which angle the metrics judge: "true" (where the plant offers it) or "measured".
    """

    loop: Loop
    limits: Mapping[str, float] = field(default_factory=dict)
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    angle: str = "true"

    def __post_init__(self) -> None:
        require_one_of("angle", self.angle, ("true", "measured"))


def simulate(
    loop: Loop | LoopSetup,
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
        loop: a plain loop, or one with limits as `load_loop` returns it.
        report: called now and then with the done fraction.
        on_step: called after each row with a `LoopStep`; it stops the run by returning True.
        pace: run at this multiple of real time; as fast as possible if not given.
        resume: go on from this state instead of t = 0.
        keep: leave the FMUs loaded, so that the next run of the same loop resets them; `loop.close()` ends it.
        compiled: run loops whose parts are all blocks (softneck files, the virtual neck, no FMUs) as one compiled
            function: the same bits, sooner after a second of compiling, which is kept.

    Raises:
        SettingsError: parts that do not fit together.
        DataError: a part returned what is not a number.
        FmuError: an FMU refused a call.
    """
    setup = loop if isinstance(loop, LoopSetup) else LoopSetup(loop=loop)
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
