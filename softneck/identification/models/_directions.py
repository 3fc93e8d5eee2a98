"""Which way a robot's motors move its outputs, and how fast: known of a neck, found from data for other robots.

A neck's redefined inputs are theta_i and phi_i, and its time constant is 0.2 s: what is in seconds in the estimators was
chosen for that. For another robot each output is fitted by one low-pass filter over all motors (least squares for each
of a ladder of time constants): its weights are the output's direction where the robot gives none, and its time constant
by 0.2 s is what those seconds are stretched by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording, redefinition_matrix

# The neck's time constant [s], for which the seconds in the estimators' defaults were chosen.
NECK_SECONDS = 0.2
# Time constants tried: from half a sample to a third of the longest run, beyond which all is drift.
_TRIED = 40
# Motors whose filtered motions repeat each other to this share are told apart by nothing: the least weights are taken.
_ALIKE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """How a robot answers to its motors.

    Attributes:
        names: of the outputs.
        weights: (outputs, motors) of the motors in the redefined input of each output.
        seconds: (outputs,) time constants [s].
        learned: whether the weights were found from data.
    """

    names: tuple[str, ...]
    weights: Matrix
    seconds: Vector
    learned: bool

    @property
    def stretch(self) -> float:
        """By how much the robot is slower than a neck."""
        return float(np.exp(np.mean(np.log(self.seconds)))) / NECK_SECONDS

    def findings(self) -> dict[str, object]:
        """Return what a model's findings say of it; nothing of a neck, which needs no finding."""
        return {
            "time_constants_s": self.seconds.tolist(),
            "directions": self.weights.tolist(),
            "directions_from": "data" if self.learned else "robot",
        }


def directions_of(recording: Recording, motors: list[Matrix]) -> Directions:
    """Return the directions of a recording's robot.

    Args:
        recording: to learn from.
        motors: what drives the outputs, (time, motors) of each run.

    Raises:
        DataError: an output follows no motor.
    """
    robot = recording.robot
    names = robot.outputs.names
    if robot.is_neck:
        return Directions(names, redefinition_matrix()[:2], np.full(2, NECK_SECONDS), False)
    outputs = [run.outputs for run in recording.runs()]
    given = robot.weights()
    found, seconds = [], []
    for axis, name in enumerate(names):
        inputs = motors if given is None else [U @ given[[axis]].T for U in motors]
        tau, weights = _first_order(inputs, [Y[:, axis] for Y in outputs], recording.sample_time)
        size = float(np.linalg.norm(weights))
        if not size > 0.0:
            raise DataError(f"`{name}` follows no motor; is its sensor connected, and did the motors move?")
        found.append(weights / size if given is None else given[axis])
        seconds.append(tau)
    return Directions(names, np.array(found), np.array(seconds), given is None)


def _first_order(
    inputs: Sequence[Matrix], outputs: Sequence[Vector], sample_time: float) -> tuple[float, Vector]:
    """Return time constant [s] and weights (motors,) of the low-pass filter over all inputs that fits an output best."""
    longest = max(len(U) for U in inputs) * sample_time
    y = np.concatenate(outputs)
    there = np.isfinite(y)
    scale = np.concatenate(inputs).std(axis=0)
    scale = np.where(scale > 0.0, scale, np.inf)  # a motor that never moves has no say
    best: tuple[float, float, Vector] | None = None
    for tau in np.geomspace(0.5 * sample_time, longest / 3.0, _TRIED):
        X = np.vstack([_block_of_starts(_filtered(U / scale, np.exp(-sample_time / tau)), i, len(inputs))
                       for i, U in enumerate(inputs)])[there]  # fmt: skip
        theta = np.linalg.lstsq(X, y[there], rcond=_ALIKE)[0]
        cost = float(np.sum((y[there] - X @ theta) ** 2))
        if best is None or cost < best[0]:
            best = (cost, float(tau), theta[: inputs[0].shape[1]] / scale)
    if best is None or not np.isfinite(best[0]):
        raise DataError("nothing was measured that a time constant could be found from.")
    return best[1], best[2]


def _filtered(U: Matrix, pole: float) -> tuple[Matrix, Vector]:
    """Return `U` (time, n) behind a low-pass filter that had settled at its first row, and how a start decays."""
    from scipy.signal import lfilter

    late = np.vstack([U[:1], U[:-1]])  # y(k+1) answers to u(k)
    X = lfilter([1.0 - pole], [1.0, -pole], late, axis=0, zi=pole * late[:1])[0]
    return np.asarray(X), pole ** np.arange(len(U))


def _block_of_starts(filtered: tuple[Matrix, Vector], run: int, runs: int) -> Matrix:
    """Return the regressors of one run: inputs, a constant of all, and the run's own start."""
    X, decay = filtered
    starts = np.zeros((len(X), runs))
    starts[:, run] = decay
    return np.column_stack([X, np.ones(len(X)), starts])
