"""Set membership on what a linear base leaves over: a regressor of simulated signals, so no feedback to drift."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording

from ._model import Model

# How far back the neck's state shows in its inputs [s]: the newest sample, then about one, two and four of its
# time constants of 0.2 s. Denser or longer ones moved no free run by more than 2 points (virtual neck, `paper`).
_LOOKS_BACK = (0.02, 0.2, 0.4, 0.8)
# A radian of motor tilts the neck by about 0.2 rad: this weight makes the two equal in the norm.
ANGLE_WEIGHT = 5.0


def residual_table(sample_time: float) -> Matrix:
    """Return the regressor: rows (source, channel, lag) of the three motors and both angles of the base."""
    lags = sorted({max(round(seconds / sample_time), 1) for seconds in _LOOKS_BACK})
    motors = [[2.0, float(channel), float(lag)] for lag in lags for channel in range(3)]
    return np.array(motors + [[3.0, float(channel), float(lag)] for lag in lags for channel in range(2)])


def residual_points(
    recording: Recording, base: Model, table: Matrix, scale: Vector, axis: int
) -> tuple[Matrix, Vector]:
    """Return scaled regressors (n, N) and y(k) less the base's free run (N,), rows of no run before the base settled.

    Raises:
        DataError: every run is too short.
    """
    parts, left = [], []
    for run in recording.runs():
        # Its start is forgotten at the far end of the regressor: a base of 4 rad/s keeps 3 % of it after 0.8 s.
        settled = 2 * int(table[:, 2].max())
        if len(run) <= settled:
            continue
        simulated = base.simulate(run, warm_up=1)
        sources = {2: simulated[:, 2:5], 3: simulated[:, :2]}
        columns = [sources[int(s)][settled - int(lag) : len(run) - int(lag), int(c)] for s, c, lag in table]
        target = run.outputs[settled:, axis] - simulated[settled:, axis]
        there = np.isfinite(target)
        parts.append((np.array(columns) * scale[:, None])[:, there])
        left.append(target[there])
    if sum(part.size for part in left) < 2:
        raise DataError("every run is too short for form `residual`; record runs of several seconds.")
    return np.ascontiguousarray(np.concatenate(parts, axis=1)), np.concatenate(left)
