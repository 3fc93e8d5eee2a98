"""Motions that nobody recorded: where kinds that were trained alike part, most of them are wrong.

The exam's set-points stay within those that were trained on, move together as much and as fast, but otherwise: levels
that are held, many tones, one motor after the other. No measurement says what is right there. What says most is the
median of all models, each weighing by what it is worth on rows left out: a kind that leaves it alone has learnt the
record and not the robot. That is a comparison, no proof: kinds that share a bias agree (Ovadia et al. 2019).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording, signal
from softneck.signals.excitation._signals import SAMPLE_TIME

from ..models._model import Model
from ..models._scores import nrmse_fit
from ._left_out import simulated

_SECONDS = 30.0
# Where `mixed` moves one tendon at a time: from which to which part of so many seconds.
_ALONE, _MIXED_SECONDS = (0.88, 0.95), 300.0
# Of the trained set-points: what lies outside was hardly trained on.
_RANGE = (0.01, 0.99)
# [s] in which the exam goes from where the record began to where it begins.
_RAMP = 2.0
# A model that is right to a percent weighs no more than that.
_LEAST_ERROR = 1.0
# With two there is no middle.
_LEAST_VOTES = 3
# How often a motor of Eq. 22 crosses its mean per second: the speed that the signals are meant for.
_CROSSINGS = 0.34
# A record is at most so many times slower or faster than that; beyond, it hardly moves or its set-points are noise.
_MOST_STRETCH = 100.0


def exams(train: Recording) -> list[Recording]:
    """Return the motions of the exam, whose outputs are NaN but for the start."""
    start, stop = (round(share * _MIXED_SECONDS / SAMPLE_TIME) for share in _ALONE)
    alone = signal("mixed", duration=_MIXED_SECONDS).set_points[start:stop]
    moves = [signal(name, duration=_SECONDS).set_points for name in ("aprbs", "multisine")]
    return [_exam(train, own) for own in (*moves, alone)]


def free_runs(model: Model, motions: Sequence[Recording]) -> list[Matrix]:
    """Return the outputs (time, outputs) of a model on each motion, from the first row alone."""
    return [simulated(model, motion, warm_up=1) for motion in motions]


def agreement(runs: Mapping[str, Sequence[Matrix]], worth: Mapping[str, float]) -> dict[str, float]:
    """Return for each model how well it fits the weighted median, on the motion on which it fits least [%].

    Args:
        runs: name -> `free_runs`.
        worth: name of those that vote -> fit on rows left out [%]; they weigh by the inverse square of what is missing.

    Returns:
        Name -> fit [%], the mean of the outputs; nothing where fewer than three that vote run free.
    """
    there = [name for name in worth if np.isfinite(worth[name]) and all(np.isfinite(y).all() for y in runs[name])]
    if len(there) < _LEAST_VOTES:
        return {}
    weights = np.array([1.0 / max(100.0 - worth[name], _LEAST_ERROR) ** 2 for name in there])
    middles = [weighted_median(np.array(free), weights) for free in zip(*(runs[name] for name in there), strict=True)]
    return {name: min(map(_fit, middles, free)) for name, free in runs.items()}


def _fit(middle: Matrix, free: Matrix) -> float:
    if not np.isfinite(free).all():
        return float("-inf")
    return float(np.mean([nrmse_fit(y, yhat) for y, yhat in zip(middle.T, free.T, strict=True)]))


def weighted_median(values: np.ndarray, weights: Vector) -> Matrix:
    """Return the weighted median over the first axis of `values` (n, ...); `weights` (n,)."""
    order = np.argsort(values, axis=0)
    reached = np.cumsum(weights[order], axis=0)
    first = np.argmax(reached >= 0.5 * reached[-1], axis=0)
    return np.take_along_axis(np.take_along_axis(values, order, axis=0), first[None], axis=0)[0]


def _exam(train: Recording, own: Matrix) -> Recording:
    """Return a neck's set-points (time, 3) at 20 ms mapped onto the trained ones and their speed."""
    Ts, first = train.sample_time, train.runs()[0]
    P = _on_motors(own, train.set_points.shape[1])
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


def _on_motors(P: Matrix, motors: int) -> Matrix:
    """Return the signal for as many motors (time, motors); those beyond three play it with another delay."""
    late = len(P) // (motors + 1)
    return np.column_stack([np.roll(P[:, j % P.shape[1]], late * (j // P.shape[1])) for j in range(motors)])


def _stretch(train: Recording) -> float:
    """Return by how much the record is slower than Eq. 22, by how often set-points cross their mean."""
    crossings = [(np.diff(np.sign(run.set_points - run.set_points.mean(axis=0)), axis=0) != 0) for run in train.runs()]
    rate = float(np.concatenate(crossings).mean()) / train.sample_time
    return float(np.clip(_CROSSINGS / max(rate, 1e-9), 1.0 / _MOST_STRETCH, _MOST_STRETCH))
