"""Angles that jump by a full turn at the edge of a sensor's range, such as roll at 180 deg."""

from __future__ import annotations

import numpy as np

from softneck.core import Vector

# The range of one turn is overrun by rounding and noise of the last digit only.
_RANGE_TOLERANCE = 1e-3
# [turns] A jump is longer than half a turn; without it, the step is an ordinary one: at most this long, or a few times
# as long as nearly all other steps and at most the last: of longer ones nobody can say which way they went.
_JUMP, _STEP, _LONG_STEP_RATIO, _LONGEST_STEP = 0.5, 0.1, 3.0, 0.25
# So few samples do not tell an ordinary step.
_LEAST_SAMPLES = 50
# Smallest share of rows that move: a command held between steps may go from 0 to a full turn.
_MIN_MOVING = 0.3


def count_wraps(x: Vector, turn: float) -> int:
    """Return how often an angle (time,) of one run wraps within [0, turn] or [-turn/2, turn/2]; 0 for other jumps."""
    x = x[np.isfinite(x)]
    if x.size < _LEAST_SAMPLES:
        return 0
    step = np.diff(x)
    jumps = np.abs(step) > _JUMP * turn
    if not jumps.any() or jumps.mean() > _MIN_MOVING or np.mean(step != 0) < _MIN_MOVING:
        return 0
    slack = _RANGE_TOLERANCE * turn
    low, high = x.min(), x.max()
    if not ((low >= -slack and high <= turn + slack) or (low >= -0.5 * turn - slack and high <= 0.5 * turn + slack)):
        return 0
    rest = np.abs(step[jumps] - turn * np.sign(step[jumps]))
    usual = float(np.quantile(np.abs(step[~jumps]), 0.99))
    return (
        int(jumps.sum()) if rest.max() <= max(_STEP * turn, min(_LONG_STEP_RATIO * usual, _LONGEST_STEP * turn)) else 0
    )


def unwrap(x: Vector, run: np.ndarray, turn: float) -> tuple[Vector, int]:
    """Return an angle (time,) that is continuous within each run, and how many jumps of a full turn it had.

    Each run is shifted by whole turns, so that its median is the nearest to that of the first run.
    """
    y, jumps, middle = x.copy(), 0, np.nan
    for rows in np.split(np.arange(x.size), np.flatnonzero(np.diff(run)) + 1):
        rows = rows[np.isfinite(x[rows])]
        found = count_wraps(x[rows], turn)
        jumps += found
        if found:
            y[rows] = np.unwrap(x[rows], period=turn)
        if rows.size and jumps:
            here = float(np.median(y[rows]))
            middle = here if np.isnan(middle) else middle
            y[rows] += turn * np.round((middle - here) / turn)
    return (y, jumps) if jumps else (x, 0)
