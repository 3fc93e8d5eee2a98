"""Directions and time constant of a robot: from its robot file, else estimated from data.

Each output is fitted by one low-pass filter with dead time over all motors (least squares for each time constant and
dead time tried): its weights are the output's direction where the robot gives none, and its time constant is that of
the robot where it gives none.

Motions that nobody recorded, by the set-points of a record: as large, as fast, but otherwise.

Levels that are held, many tones, one motor after the other: set-points stay within those that were trained on, and move
together as much. No measurement says what is right there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.robot import TIME_CONSTANT as NECK_SECONDS
from softneck.robot import Robot
from softneck.signals import BANDWIDTH, SAMPLE_TIME, Recording, signal

if TYPE_CHECKING:
    from ._model import Model

# Time constants tried: from half a sample to a third of the longest run, beyond which all is drift.
_TRIED = 40
# Dead times tried then: up to one and a half of the time constant found without any, in so many steps at most.
_DEAD_TIME, _DEAD_TIMES = 1.5, 20
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
        given: (inputs, motors) T of Eq. 9-11 of a robot that gives its own: the weights, and co-contraction last.
    """

    names: tuple[str, ...]
    weights: Matrix
    seconds: Vector
    learned: bool
    given: Matrix | None = None

    @property
    def redefinition(self) -> Matrix:
        """(inputs, motors) to the redefined inputs, one for each output first."""
        return self.weights if self.given is None else self.given

    @property
    def time_constant(self) -> float:
        """Of the robot as a whole, the geometric mean of its outputs' [s]."""
        return float(np.exp(np.mean(np.log(np.sort(self.seconds)))))  # in one order, whatever that of the outputs

    def all_inputs(self, set_points: Matrix) -> Matrix:
        """Return T (motors, motors) with more rows than `redefinition`: how else the set-points (time, motors) move."""
        if self.given is not None and len(self.given) == len(self.given.T) and self.given[-1].any():
            return self.given
        rows = _independent(self.weights)
        _, _, basis = np.linalg.svd(rows)
        across = basis[len(rows) :]
        # The motion that moves no output, by its principal axes: no basis is told from another by anything else.
        _, axes = np.linalg.eigh(across @ np.atleast_2d(np.cov(set_points.T)) @ across.T)
        return np.vstack([rows, axes.T[::-1] @ across])

    def findings(self) -> dict[str, object]:
        """Return the findings of a model about its directions."""
        return {
            "time_constants_s": self.seconds.tolist(),
            "directions": self.weights.tolist(),
            "directions_from": "data" if self.learned else "robot",
        }


def directions_of(recording: Recording, motors: list[Matrix], robot: Robot | None = None) -> Directions:
    """Return the directions of a recording's robot.

    Args:
        recording: to learn from.
        motors: what drives the outputs, (time, motors) of each run.
        robot: what it says of directions and time constant is not learned; that of the recording if not given.

    Raises:
        DataError: an output follows no motor.
    """
    robot = robot or recording.robot
    names, given = robot.outputs.names, robot.weights()
    weights, seconds = given, np.full(len(names), robot.time_constant_s or NECK_SECONDS)
    if given is None or robot.time_constant_s is None:
        found = [_followed(recording, motors, axis, given) for axis in range(len(names))]
        weights = np.array([row for row, _ in found]) if given is None else given
        if robot.time_constant_s is None:
            seconds = recording.sample_time * np.array([samples for _, samples in found])
    T = None if given is None else robot.redefinition()[0]
    return Directions(names, np.asarray(weights), seconds, given is None, T)


def _followed(recording: Recording, motors: list[Matrix], axis: int, given: Matrix | None) -> tuple[Vector, float]:
    """Return the weights (motors,) of length 1 that an output follows, and its time constant in samples."""
    inputs = motors if given is None else [U @ given[[axis]].T for U in motors]
    samples, weights = _first_order(inputs, [run.outputs[:, axis] for run in recording.runs()])
    size = float(np.linalg.norm(weights))
    if not size > 0.0:
        name = recording.robot.outputs.names[axis]
        raise DataError(f"`{name}` follows no motor; is its sensor connected, and did the motors move?")
    return weights / size, samples


def time_constant_of(source: Recording | Model) -> float | None:
    """Return the time constant [s] of a recording's robot or of a model; None where an output follows no motor."""
    if source.robot.time_constant_s is not None:
        return source.robot.time_constant_s
    if isinstance(source, Recording):
        try:
            return directions_of(source, [run.set_points for run in source.runs()]).time_constant
        except DataError:
            return None
    return float(np.exp(np.mean(np.log(np.sort(source.findings.get("time_constants_s", [NECK_SECONDS]))))))


def bandwidth_of(recording: Recording) -> float | None:
    """Return up to where outputs follow set-points [rad/s]: a neck's 4 (section 3.1), of others by time constants.

    None where an output follows no motor.
    """
    seconds = time_constant_of(recording)
    return None if seconds is None else BANDWIDTH * (NECK_SECONDS / seconds)


def _first_order(inputs: Sequence[Matrix], outputs: Sequence[Vector]) -> tuple[float, Vector]:
    """Return time constant in samples and weights (motors,) of the low-pass filter over all inputs that fits best."""
    from scipy.optimize import minimize_scalar

    longest = max(len(U) for U in inputs)
    y = np.concatenate(outputs)
    there = np.isfinite(y)
    scale = np.concatenate(inputs).std(axis=0)
    scale = np.where(scale > 0.0, scale, np.inf)  # a motor that never moves has no say

    def fit(tau: float, late: int) -> tuple[float, Vector]:
        X = np.vstack([_block_of_starts(_filtered(U / scale, np.exp(-1.0 / tau), late), i, len(inputs))
                       for i, U in enumerate(inputs)])[there]  # fmt: skip
        theta = np.linalg.lstsq(X, y[there], rcond=_ALIKE)[0]
        return float(np.sum((y[there] - X @ theta) ** 2)), theta[: inputs[0].shape[1]] / scale

    ladder = np.geomspace(0.5, longest / 3.0, _TRIED)
    tau = float(min(ladder, key=lambda tau: fit(tau, 0)[0]))
    most = int(min(_DEAD_TIME * tau, longest / 3.0))
    best = (np.inf, tau, 0)
    for late in range(0, most + 1, max(most // _DEAD_TIMES, 1)):
        # Dead time takes from the time constant that was found without any.
        found: Any = minimize_scalar(lambda x, late=late: fit(np.exp(x), late)[0], method="bounded",
                                bounds=(np.log(tau / 8.0), np.log(2.0 * tau)), options={"xatol": 1e-3})  # fmt: skip
        best = min(best, (float(found.fun), float(np.exp(found.x)), late))
    return best[1], fit(best[1], best[2])[1]


def _independent(weights: Matrix) -> Matrix:
    """Return the rows that the rows before them do not make up, as far as can be told."""
    kept: list[Vector] = []
    for row in weights / np.linalg.norm(weights, axis=1, keepdims=True):
        if np.linalg.matrix_rank(np.array([*kept, row]), tol=0.1) > len(kept):
            kept.append(row)
    return np.array(kept)


def _filtered(U: Matrix, pole: float, late: int) -> tuple[Matrix, Vector]:
    """Return `U` (time, n) `late` samples later behind a low-pass that had settled at its first row, and its decay."""
    from scipy.signal import lfilter

    delayed = np.vstack([np.repeat(U[:1], late + 1, axis=0), U])[: len(U)]  # y(k+1) answers to u(k - late)
    X = lfilter([1.0 - pole], [1.0, -pole], delayed, axis=0, zi=pole * delayed[:1])[0]
    return np.asarray(X), pole ** np.arange(len(U))


def _block_of_starts(filtered: tuple[Matrix, Vector], run: int, runs: int) -> Matrix:
    """Return the regressors of one run: inputs, a constant of all, and the run's own start."""
    X, decay = filtered
    starts = np.zeros((len(X), runs))
    starts[:, run] = decay
    return np.column_stack([X, np.ones(len(X)), starts])


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
# By sample a record crosses at least and most so often; else it hardly moves or its set-points are noise.
_LEAST_RATE, _MOST_RATE = 6.8e-5, 0.68


def make_test_motions(train: Recording, seconds: float, *, seed: int = 0) -> list[Recording]:
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
    rows = np.arange(0.0, len(P) - 1.0, Ts / (SAMPLE_TIME * _slowness(train)))
    P = np.column_stack([np.interp(rows, np.arange(len(P)), column) for column in P.T])
    U = train.set_points
    P = U.mean(axis=0) + (P - P.mean(axis=0)) @ _root(P, -0.5) @ _root(U, 0.5)
    P = np.clip(P, *np.quantile(U, _RANGE, axis=0))
    share = np.linspace(0.0, 1.0, max(round(_RAMP * _slowness(train) / Ts), 2))[:, None]
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


def _slowness(train: Recording) -> float:
    """Return by how much the record is slower than Eq. 22, by how often set-points cross their mean."""
    crossings = [(np.diff(np.sign(run.set_points - run.set_points.mean(axis=0)), axis=0) != 0) for run in train.runs()]
    rate = float(np.clip(np.concatenate(crossings).mean(), _LEAST_RATE, _MOST_RATE)) / train.sample_time
    return _CROSSINGS / rate
