"""Directions and time constant of a robot, from its robot file or estimated from data, and synthetic test motions.

Estimates are the weights and time constant of one low-pass filter with dead time over all motors for each output.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Matrix, Vector
from softneck.robot import TIME_CONSTANT as NECK_SECONDS
from softneck.robot import Robot, Scaling
from softneck.signals import BANDWIDTH, SAMPLE_TIME, Recording, signal

if TYPE_CHECKING:
    from ._model import Model

# Number of time constants tried, from half a sample to a third of the longest run (beyond that all is drift).
_TIME_CONSTANT_COUNT = 40
# Then dead times are tried up to 1.5 of the time constant found without any, in at most 20 steps, and on while the
# last is the best.
_MAX_DEAD_TIME, _MAX_DEAD_TIME_STEPS = 1.5, 20
# Relative singular value below which motions count as dependent; least squares then takes the smallest weights.
_RANK_TOLERANCE = 1e-6
# Below this it is taken for rounding of set-points, as of four tendons whose pairs always add up to one pretension,
# unless the error of the fit without it is this many times as large.
_ROUNDING, _WORTH = 0.02, 1.25
# Singular value below which directions of length 1 count as nearly a combination of others.
_PARALLEL = 0.1
# After so many time constants what was at the start is below rounding.
_DECAYED = 37.0


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Weights (outputs, motors) of the redefined inputs and time constants `seconds` (outputs,) of a robot.

    learned: whether from data; given: (inputs, motors) T of Eq. 9-11 from the robot file, co-contraction last;
    dead_time: the longest that was estimated [s].
    """

    names: tuple[str, ...]
    weights: Matrix
    seconds: Vector
    learned: bool
    given: Matrix | None = None
    dead_time: float = 0.0

    @property
    def redefinition(self) -> Matrix:
        """(inputs, motors) map from motors to redefined inputs; those of the outputs are first."""
        return self.weights if self.given is None else self.given

    @property
    def time_constant(self) -> float:
        """The geometric mean of the outputs' time constants [s]."""
        return _geometric_mean(self.seconds)

    def all_inputs(self, set_points: Matrix) -> Matrix:
        """Complete `redefinition` to T (inputs, motors) by the other principal motions of set-points (time, motors).

        Those that are rounding at most are left out: nothing is known of them.
        """
        if self.given is not None and len(self.given) == len(self.given.T) and self.given[-1].any():
            return self.given
        rows = _independent(self.weights)
        taken = np.vstack([rows, _never_moved(set_points).T])
        _, sizes, basis = np.linalg.svd(taken)
        across = basis[int((sizes > _PARALLEL).sum()) :]
        # Principal axes of the motion that moves no output: nothing else distinguishes one basis from another.
        _, axes = np.linalg.eigh(across @ np.atleast_2d(np.cov(set_points.T)) @ across.T)
        return np.vstack([rows, axes.T[::-1] @ across])

    def findings(self) -> dict[str, object]:
        """Return the directions as findings of a model."""
        return {
            "time_constants_s": self.seconds.tolist(),
            "directions": self.weights.tolist(),
            "directions_from": "data" if self.learned else "robot",
        }


def directions_of(recording: Recording, motors: list[Matrix], robot: Robot | None = None) -> Directions:
    """Return the directions and time constants of a robot; estimate those that its file does not give.

    Motors are set-points or positions (time, motors) of each run. DataError: an output follows no motor.
    """
    robot = robot or recording.robot
    names, given = robot.outputs.names, robot.weights()
    weights, seconds, late = given, np.full(len(names), robot.time_constant_s or NECK_SECONDS), 0.0
    if given is None or robot.time_constant_s is None:
        found = [_fit_direction(recording, motors, axis, given) for axis in range(len(names))]
        weights = np.array([row for row, *_ in found]) if given is None else given
        late = recording.sample_time * max(late for *_, late in found)
        if robot.time_constant_s is None:
            seconds = recording.sample_time * np.array([samples for _, samples, _ in found])
    T = None if given is None else robot.redefinition()[0]
    return Directions(names, np.asarray(weights), seconds, given is None, T, late)


def _fit_direction(
    recording: Recording, motors: list[Matrix], axis: int, given: Matrix | None
) -> tuple[Vector, float, int]:
    """Estimate the weights (motors,) of length 1 that an output follows, its time constant and dead time in samples."""
    inputs = motors if given is None else [U @ given[[axis]].T for U in motors]
    samples, weights, late = _fit_low_pass(inputs, [run.outputs[:, axis] for run in recording.runs()])
    size = float(np.linalg.norm(weights))
    if not size > 0.0:
        name = recording.robot.outputs.names[axis]
        raise DataError(f"`{name}` follows no motor; is its sensor connected, and did the motors move?")
    return weights / size, samples, late


def time_constant_of(source: Recording | Model) -> float | None:
    """Return the time constant [s] of a recording's robot or of a model; None where an output follows no motor."""
    if source.robot.time_constant_s is not None:
        return source.robot.time_constant_s
    if isinstance(source, Recording):
        try:
            return directions_of(source, [run.set_points for run in source.runs()]).time_constant
        except DataError:
            return None
    return _geometric_mean(source.findings.get("time_constants_s", [NECK_SECONDS]))


def _geometric_mean(seconds: ArrayLike) -> float:
    return float(np.exp(np.mean(np.log(np.sort(seconds)))))  # sorted: the same bits for any order of the outputs


def bandwidth_of(recording: Recording) -> float | None:
    """Return the bandwidth [rad/s], a neck's 4 (section 3.1) over the time constant; None as of that."""
    seconds = time_constant_of(recording)
    return None if seconds is None else BANDWIDTH * (NECK_SECONDS / seconds)


def _fit_low_pass(inputs: Sequence[Matrix], outputs: Sequence[Vector]) -> tuple[float, Vector, int]:
    """Fit a low-pass filter over all inputs; return time constant, weights (motors,) and dead time, in samples."""
    from scipy.optimize import minimize_scalar

    longest = max(len(U) for U in inputs)
    scale = np.concatenate(inputs).std(axis=0)
    scale = np.where(scale > 0.0, scale, np.inf)  # a motor that never moves gets no weight
    y = np.concatenate(outputs)
    mean = y[np.isfinite(y)].sum() / y.size  # nearly so; without it less is lost to rounding
    runs = [((U / scale).T.copy(), run - mean) for U, run in zip(inputs, outputs, strict=True)]

    def fit(tau: float, late: int, tolerance: float = _RANK_TOLERANCE) -> tuple[float, Vector]:
        # Normal equations: the rows of a long recording are read once for each filter, and none is copied.
        products: Any = sum(_low_pass_products(U, run, tau, late) for U, run in runs)
        theta = np.linalg.lstsq(products[:-1, :-1], products[:-1, -1], rcond=tolerance**2)[0]
        return float(products[-1, -1] - products[:-1, -1] @ theta), theta[:-1] / scale

    ladder = np.geomspace(0.5, longest / 3.0, _TIME_CONSTANT_COUNT)
    tau = float(min(ladder, key=lambda tau: fit(tau, 0)[0]))
    most = int(min(_MAX_DEAD_TIME * tau, longest / 3.0))
    best, late, step = (np.inf, tau, 0), 0, max(most // _MAX_DEAD_TIME_STEPS, 1)
    while late <= most or (late <= longest / 3.0 and best[2] == late - step):
        # With dead time the time constant is shorter than the one found without.
        bounds = np.log(tau / 8.0), np.log(2.0 * tau)
        found: Any = minimize_scalar(
            lambda x, late=late: fit(np.exp(x), late)[0], method="bounded", bounds=bounds, options={"xatol": 1e-3}
        )
        best = min(best, (float(found.fun), float(np.exp(found.x)), late))
        late += step
    (least, weights), (error, fewer) = (fit(best[1], best[2], rank) for rank in (_RANK_TOLERANCE, _ROUNDING))
    never = _never_moved(np.concatenate(inputs))
    return best[1], weights if error > _WORTH * least else fewer - never @ (never.T @ fewer), best[2]


def _never_moved(set_points: Matrix) -> Matrix:
    """Return an orthonormal basis (motors, n) of motions that set-points (time, motors) hold as rounding at most."""
    centred = set_points - set_points.mean(axis=0)
    moved = centred.T @ centred
    scale = np.sqrt(np.diag(moved))
    scale = np.where(scale > 0.0, scale, 1.0)
    sizes, axes = np.linalg.eigh(moved / np.outer(scale, scale))
    return np.linalg.qr(axes[:, sizes < _ROUNDING**2 * sizes[-1]] / scale[:, None])[0]


def _low_pass_products(U: Matrix, y: Vector, tau: float, late: int) -> Matrix:
    """Return the inner products of one run's regressors and output, without the part that decays from its start.

    The regressors are the low-passed inputs U (motors, time) and a constant; the output y (time,) comes last.
    """
    from scipy.signal import lfilter

    pole, missing = np.exp(-1.0 / tau), ~np.isfinite(y)
    shift = min(late + 1, y.size)  # y(k+1) depends on u(k - late)
    Z = np.ones((len(U) + 2, y.size))
    Z[:-2, :shift] = U[:, :1]
    Z[:-2, shift:] = lfilter([1.0 - pole], [1.0, -pole], U, zi=pole * U[:, :1])[0][:, : y.size - shift]
    Z[-1] = y
    Z[:, missing] = 0.0
    start = pole ** np.arange(min(y.size, 1 + int(_DECAYED * tau)))
    start[missing[: start.size]] = 0.0
    decayed = Z[:, : start.size] @ start / np.sqrt(max(start @ start, np.finfo(float).tiny))
    return Z @ Z.T - np.outer(decayed, decayed)


def _independent(weights: Matrix) -> Matrix:
    """Return the rows that are not nearly a combination of the rows before them."""
    kept: list[Vector] = []
    for row in weights / np.linalg.norm(weights, axis=1, keepdims=True):
        if np.linalg.matrix_rank(np.array([*kept, row]), tol=_PARALLEL) > len(kept):
            kept.append(row)
    return np.array(kept)


#: The tests of section 4, which the paper's models never saw.
PAPER_TESTS = ("steps", "sine", "rotation")
# The part of the signal `mixed` that moves one tendon at a time, as shares of its length.
_SINGLE_TENDON_SHARE = (0.88, 0.95)
# Length of `mixed` for a motion of one second: two thirds of the motion then move one tendon at a time.
_MIXED_PER_MOTION = 10.0
# Quantiles of the training's set-points that limit test motions; beyond them there was hardly any training.
_RANGE_QUANTILES = (0.01, 0.99)
# Time of a neck to move from the recording's start to that of the motion [s].
_RAMP_S = 2.0
# Mean crossings per second of a motor in Eq. 22: the speed that the signals are designed for.
_EQ22_CROSSINGS_PER_S = 0.34
# Limits of crossings per sample; outside, the recording hardly moves or its set-points are noise.
_MIN_CROSSINGS, _MAX_CROSSINGS = 6.8e-5, 0.68


def make_test_motions(train: Recording, seconds: float, *, seed: int = 0) -> list[Recording]:
    """Generate motions of `seconds`, before scaling to a recording's speed, with NaN outputs after the start."""
    length = _MIXED_PER_MOTION * seconds
    start, stop = (round(share * length / SAMPLE_TIME) for share in _SINGLE_TENDON_SHARE)
    moves = [_set_points(name, seconds, seed) for name in ("aprbs", "multisine")]
    alone = _set_points("mixed", length, seed)[start:stop]
    return [_map_to_training(train, motion) for motion in (*moves, alone)]


# To draw phases of a low crest factor takes longer than most that is done with a motion.
@lru_cache(maxsize=8)
def _set_points(name: str, seconds: float, seed: int) -> Matrix:
    return signal(name, duration=seconds, seed=seed).set_points


def _map_to_training(train: Recording, motion: Matrix) -> Recording:
    """Map a neck's set-points (time, 3) at 20 ms to the mean, covariance, range and speed of the training."""
    slowness, U = _slowness(train), train.set_points
    P = _resampled(motion, train, slowness)
    P = U.mean(axis=0) + (P - P.mean(axis=0)) @ _covariance_power(P, -0.5) @ _covariance_power(U, 0.5)
    return _from_start(train, np.clip(P, *np.quantile(U, _RANGE_QUANTILES, axis=0)), slowness)


def make_paper_tests(train: Recording) -> list[Recording]:
    """Generate the paper's steps, sine and rotation in the units and time of a robot, with NaN outputs after the start.

    They begin at its rest and stay within the set-points of the training. Those of a neck are the paper's own.
    """
    scaling = Scaling.of(train.robot, set_points=train.set_points, time_constant=time_constant_of(train))
    low, high = np.quantile(train.set_points, _RANGE_QUANTILES, axis=0)
    rest, found = np.clip(scaling.motor_rest, low, high), []
    for name in PAPER_TESTS:
        P = _resampled(signal(name).set_points, train, scaling.second)
        # A motor that was recorded to one side of its rest alone moves to that side.
        up, down = (np.maximum(side, 1e-9) for side in (P.max(axis=0), -P.min(axis=0)))
        most = np.maximum((high - rest) / up, (rest - low) / down)
        P = np.clip(rest + np.minimum(scaling.motor_unit, most) * P, low, high)
        found.append(_from_start(train, P, scaling.second))
    return found


def _resampled(motion: Matrix, train: Recording, slowness: float) -> Matrix:
    """Return a neck's set-points (time, 3) at 20 ms, slowed down, for the motors and the sample time of a training."""
    P = on_motors(motion, train.set_points.shape[1])
    rows = np.arange(0.0, len(P) - 1.0, train.sample_time / (SAMPLE_TIME * slowness))
    return np.column_stack([np.interp(rows, np.arange(len(P)), column) for column in P.T])


def _from_start(train: Recording, P: Matrix, slowness: float) -> Recording:
    """Return set-points `P` (time, motors) after a way there from the first row of the training, which has outputs."""
    Ts, first, robot = train.sample_time, train.runs()[0], train.robot
    share = np.linspace(0.0, 1.0, max(round(_RAMP_S * slowness / Ts), 2))[:, None]
    U = np.vstack([first.set_points[0] + share * (P[0] - first.set_points[0]), P])
    Y = np.full((len(U), train.outputs.shape[1]), np.nan)
    Y[0] = np.nan_to_num(first.outputs[0])
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*U.T, *Y.T), strict=True))
    return Recording(np.arange(len(U)) * Ts, Ts, channels, robot=robot)


def _covariance_power(P: Matrix, power: float) -> Matrix:
    """Return a power of the covariance (motors, motors) of set-points."""
    variances, axes = np.linalg.eigh(np.atleast_2d(np.cov(P.T)))
    return axes * np.maximum(variances, 1e-12 * variances[-1]) ** power @ axes.T


def on_motors(P: Matrix, motors: int) -> Matrix:
    """Extend a signal of three motors to (time, motors); those beyond three repeat it with another delay."""
    late = len(P) // (motors + 1)
    return np.column_stack([np.roll(P[:, j % P.shape[1]], late * (j // P.shape[1])) for j in range(motors)])


def _slowness(train: Recording) -> float:
    """Return how many times slower than Eq. 22 a recording is, by the mean crossings of its set-points."""
    crossings = [(np.diff(np.sign(run.set_points - run.set_points.mean(axis=0)), axis=0) != 0) for run in train.runs()]
    rate = float(np.clip(np.concatenate(crossings).mean(), _MIN_CROSSINGS, _MAX_CROSSINGS)) / train.sample_time
    return _EQ22_CROSSINGS_PER_S / rate
