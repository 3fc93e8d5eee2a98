"""Motions that nobody recorded, by the set-points of a record: as large, as fast, but otherwise.

Levels that are held, many tones, one motor after the other: set-points stay within those that were trained on, and move
together as much. No measurement says what is right there.
"""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix
from softneck.signals import Recording, signal
from softneck.signals.excitation._signals import SAMPLE_TIME

# Where `mixed` moves one tendon at a time: from which to which part of its length.
_ALONE = (0.88, 0.95)
# So many times the seconds of a motion, `mixed` moves one tendon at a time for two thirds of them.
_MIXED = 10.0
# Of the trained set-points: what lies outside was hardly trained on.
_RANGE = (0.01, 0.99)
# [s] in which a motion goes from where the record began to where it begins.
_RAMP = 2.0
# How often a motor of Eq. 22 crosses its mean per second: the speed that the signals are meant for.
_CROSSINGS = 0.34
# A record is at most so many times slower or faster than that; beyond, it hardly moves or its set-points are noise.
_MOST_STRETCH = 100.0


def unrecorded(train: Recording, seconds: float, *, seed: int = 0) -> list[Recording]:
    """Return motions along the set-points of a record, of so many seconds of a neck; outputs are NaN but for the start.

    Args:
        train: the record.
        seconds: of each motion, before it is made as slow or fast as the record is.
        seed: of levels and phases.
    """
    length = _MIXED * seconds
    start, stop = (round(share * length / SAMPLE_TIME) for share in _ALONE)
    alone = signal("mixed", duration=length, seed=seed).set_points[start:stop]
    moves = [signal(name, duration=seconds, seed=seed).set_points for name in ("aprbs", "multisine")]
    return [_mapped(train, own) for own in (*moves, alone)]


def _mapped(train: Recording, own: Matrix) -> Recording:
    """Return a neck's set-points (time, 3) at 20 ms mapped onto the trained ones and their speed."""
    Ts, first = train.sample_time, train.runs()[0]
    P = on_motors(own, train.set_points.shape[1])
    # Slower or faster by as much as the record is.
    rows = np.arange(0.0, len(P) - 1.0, Ts / (SAMPLE_TIME * _stretch(train)))
    P = np.column_stack([np.interp(rows, np.arange(len(P)), column) for column in P.T])
    U = train.set_points
    P = U.mean(axis=0) + (P - P.mean(axis=0)) @ _root(P, -0.5) @ _root(U, 0.5)
    P = np.clip(P, *np.quantile(U, _RANGE, axis=0))
    share = np.linspace(0.0, 1.0, max(round(_RAMP * _stretch(train) / Ts), 2))[:, None]
    U = np.vstack([first.set_points[0] + share * (P[0] - first.set_points[0]), P])
    Y = np.full((len(U), train.outputs.shape[1]), np.nan)
    Y[0] = np.nan_to_num(first.outputs[0])
    robot = train.robot
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*U.T, *Y.T), strict=True))
    return Recording(np.arange(len(U)) * Ts, Ts, channels, robot=robot)


def _root(P: Matrix, power: float) -> Matrix:
    """Return a power of the covariance (motors, motors), which says how much motors move together."""
    variances, axes = np.linalg.eigh(np.atleast_2d(np.cov(P.T)))
    return axes * np.maximum(variances, 1e-12 * variances[-1]) ** power @ axes.T


def on_motors(P: Matrix, motors: int) -> Matrix:
    """Return the signal for as many motors (time, motors); those beyond three play it with another delay."""
    late = len(P) // (motors + 1)
    return np.column_stack([np.roll(P[:, j % P.shape[1]], late * (j // P.shape[1])) for j in range(motors)])


def _stretch(train: Recording) -> float:
    """Return by how much the record is slower than Eq. 22, by how often set-points cross their mean."""
    crossings = [(np.diff(np.sign(run.set_points - run.set_points.mean(axis=0)), axis=0) != 0) for run in train.runs()]
    rate = float(np.concatenate(crossings).mean()) / train.sample_time
    return float(np.clip(_CROSSINGS / max(rate, 1e-9), 1.0 / _MOST_STRETCH, _MOST_STRETCH))
