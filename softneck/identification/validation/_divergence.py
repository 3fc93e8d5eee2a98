"""When a free run is no longer a prediction: it has left the range of the data."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, Vector

# Three ranges from the middle is six amplitudes: no gain that is wrong by a factor of two gets there.
RANGES = 3.0
# Where the neck hardly moved, noise is all there is to compare with; within 15 deg no model has run away.
_LEAST_RANGE = np.radians(5.0)


def divergence(time: Vector, stretch: np.ndarray, free_run: Matrix, measured: Matrix) -> list[float | None]:
    """Return for each stretch the time [s] at which its free run left the data's range, or None.

    Left is: further than three times the measured range (the larger of the two axes', at least 5 deg) from its
    middle, further than half a turn from zero, or no finite number.

    Args:
        time: (time,) [s].
        stretch: (time,) number of the stretch.
        free_run: (time, 2) [rad].
        measured: (time, 2) [rad]; NaN where missed or not scored.
    """
    middle, reach = _range(measured)
    inside = (np.abs(free_run - middle) <= RANGES * reach) & (np.abs(free_run) < np.pi)
    gone = ~inside.all(axis=1)
    first = [np.flatnonzero(gone & (stretch == number)) for number in range(int(stretch[-1]) + 1)]
    return [float(time[rows[0]]) if rows.size else None for rows in first]


def _range(measured: Matrix) -> tuple[Vector, float]:
    middle, widths = np.zeros(2), [_LEAST_RANGE]
    for axis, y in enumerate(measured.T):
        there = y[np.isfinite(y)]
        if there.size:
            middle[axis] = 0.5 * (there.min() + there.max())
            widths.append(float(np.ptp(there)))
    return middle, float(max(widths))
