"""Run a loop and time it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from softneck.loop import Loop, run_loop

from ._result import Result


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LoopSetup:
    """A loop with what is asked of it; a loop file describes one.

    Attributes:
        loop: the parts, the reference, the order.
        limits: metric -> upper limit, such as "pitch.overshoot_pct": 5.0.
        files: what was read for it: role -> (path, SHA-256).
    """

    loop: Loop
    limits: Mapping[str, float] = field(default_factory=dict)
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def simulate(loop: Loop | LoopSetup, *, report: Callable[[float], None] | None = None) -> Result:
    """Run a loop from t = 0 to its end.

    Args:
        loop: a plain loop, or one with limits as `load_loop` returns it.
        report: called now and then with the done fraction.

    Raises:
        SettingsError: parts that do not fit together.
        DataError: a part returned what is no number.
        FmuError: an FMU refused a call.
    """
    setup = loop if isinstance(loop, LoopSetup) else LoopSetup(loop=loop)
    begin = time.perf_counter()
    signals = run_loop(setup.loop, report)
    wall = time.perf_counter() - begin
    return Result(signals=signals, bounds=setup.limits, wall_time=wall, files=setup.files, order=setup.loop.order)
