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
from softneck.signals import Recording

from ..models._model import Model
from ..models._scores import nrmse_fit
from ..models._unrecorded import unrecorded

_SECONDS = 30.0
# A model that is right to a percent weighs no more than that.
_LEAST_ERROR = 1.0
# With two there is no middle.
_LEAST_VOTES = 3


def exams(train: Recording) -> list[Recording]:
    """Return the motions of the exam, whose outputs are NaN but for the start."""
    return unrecorded(train, _SECONDS)


def free_runs(model: Model, motions: Sequence[Recording]) -> list[Matrix]:
    """Return the outputs (time, outputs) of a model on each motion, from the first row alone."""
    outputs = len(model.robot.outputs.names)
    return [model.simulate(motion, warm_up=1)[:, :outputs] for motion in motions]


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
