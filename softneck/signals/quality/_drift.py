"""Slow drift of an output that no motion of the motors explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._recording import Recording

# Time constants of the low-passed set-points that explain an output, in rows of a run of at most as many.
_TIME_CONSTANTS, _MOST_ROWS = (0.0, 4.0, 16.0, 64.0, 256.0, 1024.0), 20_000
# Time constants and the rows left out at the start, where the robot still comes to rest, as shares of a run.
_SLOWEST, _START = 0.05, 0.1
# The trend of ten means has eight degrees of freedom, so that chance exceeds 6 standard errors in 3 of 10,000.
_BLOCKS, _ROWS_PER_BLOCK, _SURE = 10, 20, 6.0
# Means of the first 70 % and the rest of a run lie half a drift apart: at this share of the motion a model without
# drift loses 10 points of its fit on the rest.
_LEAST_SHARE = 0.2
# Where the motors themselves follow time so closely, their effect and a drift cannot be told apart.
_LEAST_FREE = 0.25
# Of the variance that is left beside lags and a trend: where the set-points' integral explains more, the robot
# integrates, as a pump fills a tank, and a constant set-point is its trend.
_INTEGRATES = 0.5


@dataclass(frozen=True, slots=True)
class Drift:
    """The drift of an output over its longest run.

    Attributes:
        change: of the output from the run's start to its end, in SI.
        share: of `change` in the standard deviation of the other motion.
    """

    change: float
    share: float


def find_drifts(recording: Recording) -> dict[str, Drift]:
    """Return output -> drift of the outputs that drift in the longest run."""
    run = max(recording.runs(), key=len)
    every = -(-len(run) // _MOST_ROWS)
    inputs = run.set_points[::every]
    found = {}
    for axis, name in enumerate(recording.robot.outputs.names):
        drift = _find_drift(inputs, run.outputs[::every, axis])
        if drift is not None:
            found[name] = drift
    return found


def _find_drift(inputs: Matrix, y: Vector) -> Drift | None:
    time = np.linspace(0.0, 1.0, y.size)
    lags, integral = _explained_by(inputs)
    rows = np.isfinite(y) & (time >= _START)
    X, both = lags[rows], np.column_stack([time, y])[rows]
    if len(X) < max(4 * (X.shape[1] + integral.shape[1] + 1), _BLOCKS * _ROWS_PER_BLOCK):
        return None
    left = _left(both, X)
    if left[:, 0].var() < _LEAST_FREE * time[rows].var():
        return None
    X = np.column_stack([X, both[:, 0]])
    beside, integrated = _left(both[:, 1:], X), _left(both[:, 1:], np.column_stack([X, integral[rows]]))
    if integrated.var() < (1.0 - _INTEGRATES) * beside.var():
        return None
    t, e = np.array([block.mean(axis=0) for block in np.array_split(left, _BLOCKS)]).T
    slope = float(t @ e / (t @ t))
    error = float(np.sqrt(((e - slope * t) ** 2).sum() / (_BLOCKS - 2) / (t @ t)))
    motion = float((both[:, 1] - slope * both[:, 0]).std())
    if abs(slope) <= max(_SURE * error, _LEAST_SHARE * motion):
        return None
    return Drift(slope, abs(slope) / motion if motion > 0.0 else np.inf)


def _left(y: Matrix, X: Matrix) -> Matrix:
    return y - X @ np.linalg.lstsq(X, y, rcond=1e-9)[0]


def _explained_by(inputs: Matrix) -> tuple[Matrix, Matrix]:
    """Return what motors may cause: a level and lags of each and of its square (time, n), and their integrals."""
    from scipy.signal import lfilter

    moved = inputs - inputs.mean(axis=0)
    size = np.abs(moved).max(axis=0)
    moved = moved[:, size > 0.0] / size[size > 0.0]
    both = np.column_stack([moved, moved**2])
    columns = [np.ones((len(inputs), 1))]
    for rows in _TIME_CONSTANTS:
        if rows <= _SLOWEST * len(inputs):
            pole = np.exp(-1.0 / rows) if rows else 0.0
            start = pole * both[:1]  # at rest where the run begins
            columns.append(np.asarray(lfilter([1.0 - pole], [1.0, -pole], both, axis=0, zi=start)[0]))
    return np.column_stack(columns), np.cumsum(moved, axis=0) / len(inputs)
