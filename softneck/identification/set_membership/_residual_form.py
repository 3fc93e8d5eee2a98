"""Set membership on what a linear base leaves over: a regressor of simulated signals, so no feedback to drift."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording

from ..models._model import Model

# How far back the neck's state shows in its inputs [s]: the newest sample, then about one, two and four of its
# time constants of 0.2 s. Denser or longer ones moved no free run by more than 2 points (virtual neck, `paper`).
_LOOKS_BACK = (0.02, 0.2, 0.4, 0.8)


def residual_lags(sample_time: float) -> tuple[int, ...]:
    """Return the lags [samples] of the motors and of both angles of the base, where none were asked for."""
    return tuple(sorted({max(round(seconds / sample_time), 1) for seconds in _LOOKS_BACK}))


def residual_rows(
    recording: Recording, base: Model, table: Matrix, axis: int, *, measured: bool = False
) -> tuple[Matrix, Vector]:
    """Return regressors (n, N) and y(k) less the base's free run (N,), no row of a run before the base settled.

    Args:
        recording: what the set is made of.
        base: the linear model.
        table: the regressor; source 3 is the base's free run.
        axis: 0 pitch, 1 roll.
        measured: take logged motor positions instead of the drive model's.

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
        motors = run.motor_positions if measured else simulated[:, 2:5]
        sources = {1: run.set_points, 2: motors, 3: simulated[:, :2]}
        columns = np.array([sources[int(s)][settled - int(lag) : len(run) - int(lag), int(c)] for s, c, lag in table])
        target = run.outputs[settled:, axis] - simulated[settled:, axis]
        there = np.isfinite(target) & np.isfinite(columns).all(axis=0)
        parts.append(columns[:, there])
        left.append(target[there])
    if sum(part.size for part in left) < 2:
        raise DataError("every run is too short for form `residual`; record runs of several seconds.")
    return np.concatenate(parts, axis=1), np.concatenate(left)
