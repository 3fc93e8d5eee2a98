"""The time axis of a plot: runs one behind the other, and nothing drawn across what was not recorded."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Vector

# Of the whole time: the space between two runs that both start at zero.
_SPACE = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Where rows lie on the time axis.

    Attributes:
        x: (rows + breaks,) [s]; one more point after each stretch, one sample behind its last row.
        breaks: rows before which a stretch ends.
        starts: x of the first row of each stretch but the first.
        moved: whether stretches were moved, since their times would lie on each other.
    """

    x: Vector
    breaks: np.ndarray
    starts: Vector
    moved: bool

    @property
    def x_label(self) -> str:
        """The title of the axis."""
        return "time [s], runs one behind the other" if self.moved else "time [s]"

    def spread(self, values: Vector) -> Vector:
        """Return `values` (rows,) with a NaN after each stretch: (rows + breaks,)."""
        return np.insert(np.asarray(values, dtype=np.float64), self.breaks, np.nan)


def timeline(time: Vector, run: np.ndarray | None = None) -> Timeline:
    """Lay rows out on a time axis that never runs back.

    Args:
        time: (rows,) [s]; may start anew where a run does.
        run: (rows,) number of the run or stretch of each row; a row after a step that is not a sample time starts a
            stretch as well.

    Raises:
        DataError: no rows, or another length of `run`.
    """
    time = np.asarray(time, dtype=np.float64)
    shape = time.shape if run is None else run.shape
    if time.ndim != 1 or time.size == 0 or shape != time.shape:
        raise DataError(f"a plot needs times (rows,) and runs of that shape; got {time.shape} and {shape}.")
    step = np.diff(time)
    forward = step[step > 0]
    usual = float(np.median(forward)) if forward.size else 1.0
    broken = (step > 1.5 * usual) | (step <= 0)
    if run is not None:
        broken |= np.diff(run) != 0
    breaks = np.flatnonzero(broken) + 1
    x, moved = _moved(time, breaks, usual)
    return Timeline(np.insert(x, breaks, x[breaks - 1] + usual), breaks, x[breaks], moved)


def _moved(time: Vector, breaks: np.ndarray, usual: float) -> tuple[Vector, bool]:
    """Push each stretch that would not start behind the one before it."""
    edges = [0, *breaks.tolist(), time.size]
    space = max(_SPACE * sum(time[b - 1] - time[a] for a, b in itertools.pairwise(edges)), 2 * usual)
    x, moved = time.copy(), False
    for start, stop in itertools.pairwise(edges[1:]):
        if x[start] <= x[start - 1]:
            x[start:stop] += x[start - 1] + space - x[start]
            moved = True
    return x, moved
