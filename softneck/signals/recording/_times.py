"""What the times of a recording must hold, and the sample time that they tell."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError, Vector

# A logger's jitter; above it the samples are not equidistant and a discrete-time fit would be wrong.
MAX_JITTER = 0.02
# [s]; rounding of printed times is no jitter.
_ROUNDING = 1e-9


def uneven(time: Vector, sample_time: float, run: np.ndarray, *, tolerance: float = MAX_JITTER) -> np.ndarray:
    """Return (time - 1,) which steps inside a run are off `sample_time` [s] by more than `tolerance` of it."""
    off = np.abs(np.diff(time) - sample_time) > max(tolerance * sample_time, _ROUNDING)
    return off & (np.diff(run) == 0)


def check_times(time: Vector, sample_time: float, run: np.ndarray, *, tolerance: float = MAX_JITTER) -> None:
    """Raise DataError where `time` (time,) runs backwards or jumps inside a run.

    Args:
        time: [s].
        sample_time: [s].
        run: (time,) numbers of the runs.
        tolerance: how much of a sample time a step may be off.
    """
    check_rising(time, run)
    step = np.diff(time)
    jump = uneven(time, sample_time, run, tolerance=tolerance)
    if jump.any():
        row = int(np.argmax(jump)) + 1
        raise DataError(
            f"`time` jumps by {step[row - 1]:.6g} s at row {row} (t = {time[row]:g} s) where the "
            f"sample time is {sample_time:.6g} s; fill the gap, split the record there by "
            "the `run` column, or let `softneck import --guess` do it (it evens jitter out too)."
        )


def check_rising(time: Vector, run: np.ndarray, *, may_stand: bool = False) -> None:
    """Raise DataError where `time` (time,) is not finite or falls inside a run, or stands still there."""
    if not np.isfinite(time).all():
        raise DataError(f"`time` is not finite at row {int(np.argmax(~np.isfinite(time)))}.")
    step = np.diff(time)
    back = (np.diff(run) == 0) & ((step < 0) if may_stand else (step <= 0))
    if back.any():
        row = int(np.argmax(back)) + 1
        raise DataError(
            f"`time` runs backwards or stands still at row {row} ({time[row - 1]:g} to {time[row]:g} s); "
            "where a new experiment starts there, give it another number in the `run` column."
        )


def median_step(time: Vector, run: np.ndarray) -> float:
    """Return the sample time [s] of a time column: the mean step of its longest regular part."""
    if time.size < 2:
        raise DataError(f"a recording needs at least 2 rows; got {time.size}.")
    step = np.diff(time)
    inside = step[np.diff(run) == 0] if run.size else step
    positive = inside[inside > 0]
    if positive.size == 0:
        raise DataError("`time` never increases; it must rise by the sample time from row to row.")
    typical = float(np.median(positive))
    near = positive[np.abs(positive - typical) < 0.5 * typical]
    # The mean removes the rounding of printed times; ten digits are more than any clock has.
    return float(f"{near.mean():.10g}")
