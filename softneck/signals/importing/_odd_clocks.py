"""Clocks that are no column of rising times: stamps in two columns, steps, whole seconds, days of a spreadsheet."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Vector

from ..recording._resampling import Samples
from ._layout import Column

# A column may fall or stand still in this part of its rows and still be a clock: a rare double stamp.
_RARE, _FEW_STEPS = 0.02, 20
# Rows of one stamp: at least so many, and each stamp has this part of the usual number at least.
_MIN_ROWS_OF_STAMP, _EVEN_STAMPS = 3, 0.8
# Days since 1899-12-30 (spreadsheets, 1982 to 2064) and since year 0 (MATLAB's datenum).
_SERIAL_DAYS = ((30_000.0, 60_000.0), (720_000.0, 760_000.0))
# A step between these [s] is one of a log; a column of steps varies by less than this ratio.
_STEP_SPREAD = 20.0


def is_serial_days(values: Vector) -> bool:
    """Return whether a clock counts days as spreadsheets and `datenum` do, with less than an hour in a step."""
    step = np.diff(values)
    small = step.size > 0 and bool((np.abs(step) < 1.0 / 24.0).mean() > 0.9)
    return small and any(low < values.min() and values.max() < high for low, high in _SERIAL_DAYS)


def find_split_stamp(columns: Mapping[Column, Vector]) -> tuple[Column, Column] | None:
    """Return neighbours that hold whole seconds and the nanoseconds behind them; None if there are none."""
    names = list(columns)
    for first, second in itertools.pairwise(names):
        seconds, rest = columns[first], columns[second]
        whole = np.array_equal(seconds, np.round(seconds)) and np.array_equal(rest, np.round(rest))
        if not whole or rest.min() < 0.0 or not 1e6 < rest.max() < 1e9 or (np.diff(seconds) < 0.0).any():
            continue
        step = np.diff(seconds - seconds[0] + 1e-9 * rest)
        if step.size and (step > 0.0).mean() > 1.0 - _RARE:
            return first, second
    return None


def find_uneven_clock(columns: Mapping[Column, Vector]) -> Column | None:
    """Return the only column that rises in every row, but for rare double stamps; None if several do."""
    rising = [name for name, values in columns.items() if (np.diff(values) >= 0.0).all() and rises(values)]
    return rising[0] if len(rising) == 1 else None


def rises(values: Vector) -> bool:
    """Return whether a column (time,) rises in all rows but rare ones."""
    step = np.diff(values)
    return step.size > _FEW_STEPS and bool((step > 0.0).mean() > 1.0 - _RARE)


def rows_of_stamp(values: Vector) -> int | None:
    """Return how many rows share each stamp of a coarse clock, such as 50 of each whole second; None for another."""
    step = np.diff(values)
    if step.size < 2 * _MIN_ROWS_OF_STAMP or not np.isfinite(step).all() or (step < 0.0).any():
        return None
    borders = np.flatnonzero(step > 0.0) + 1
    counts = np.diff(borders)
    if counts.size < 2:
        return None
    usual = int(np.median(counts))
    even = np.abs(counts - usual) <= max(1.0, 0.1 * usual)
    return usual if usual >= _MIN_ROWS_OF_STAMP and even.mean() >= _EVEN_STAMPS else None


def mean_of_steps(values: Vector) -> float | None:
    """Return the mean of a column that holds the time since the row before; None if it cannot."""
    known = values[1:][np.isfinite(values[1:])]
    if known.size < 2 or known.size < values.size - 2 or known.min() <= 0.0 or known.max() > _STEP_SPREAD * known.min():
        return None
    return float(known.mean())


def spread_double_stamps(samples: Samples) -> tuple[Samples, tuple[str, ...]]:
    """Give a row with the stamp of the row before the middle of its neighbours, where a row has no stamp instead.

    A clock that was read twice shows one stamp twice, and a step of two behind it. Other double stamps stay.
    """
    double = double_stamps(samples.time, samples.run)
    if not double.any():
        return samples, ()
    time = samples.time.copy()
    at = np.flatnonzero(double)
    time[at] = 0.5 * (time[at - 1] + time[at + 1])
    note = (
        f"{at.size} row(s) with the time stamp of the row before and a step of two behind: set between the neighbours"
    )
    return Samples(time, samples.run, samples.channels), (note,)


def double_stamps(time: Vector, run: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return (time,) whether a row has the stamp of the row before, and the next step is one of two; rare ones only."""
    found = np.zeros(time.size, dtype=bool)
    step, inside = np.diff(time), np.diff(np.asarray(run)) == 0
    usual = float(np.median(step[inside & (step > 0.0)])) if (inside & (step > 0.0)).any() else 0.0
    if usual > 0.0:
        twice = (step[:-1] == 0.0) & inside[:-1] & inside[1:] & (np.abs(step[1:] / usual - 2.0) < 0.5)
        found[1:-1] = twice
    return found if not found.any() or found.mean() < _RARE else np.zeros(time.size, dtype=bool)
