"""The drive model: from motor set-point to measured position, first order plus delay, one per motor.

And the same with a limit: what a motor that pulls against its current limit does (see `_bank_runtime`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Scaling
from softneck.runtime import load_functions
from softneck.signals import Recording

# Samples: 0.2 s at 20 ms; a drive that answers later than that is not the paper's.
_MAX_DELAY = 10


@dataclass(frozen=True, slots=True, eq=False)
class DriveModel:
    """`m(k+1) = a m(k) + (1 - a) u(k+1-d)` per motor.

    Attributes:
        pole: (motors,) a.
        delay: (motors,) d in samples; 0 says that the position is the set-point (no positions were logged).
    """

    pole: Vector
    delay: Vector

    @property
    def array(self) -> Matrix:
        """(motors, 2): pole and delay, as the runtime reads them."""
        return np.column_stack([self.pole, self.delay])

    def simulate(self, set_points: Matrix, start: Vector) -> Matrix:
        """Return motor positions (time, motors) [rad] for set-points (time, motors), from `start` (motors,)."""
        columns = zip(set_points.T, start, self.pole, self.delay, strict=True)
        return np.column_stack([_simulate(u, m0, a, int(d)) for u, m0, a, d in columns])


def fit_drive(recording: Recording) -> DriveModel:
    """Identify the drives from logged positions; the identity where none were logged."""
    motors = recording.set_points.shape[1]
    if not recording.has_motor_positions:
        return DriveModel(np.zeros(motors), np.zeros(motors))
    fits = [_fit_motor(recording, motor) for motor in range(motors)]
    return DriveModel(np.array([a for a, _ in fits]), np.array([float(d) for _, d in fits]))


def _fit_motor(recording: Recording, motor: int) -> tuple[float, int]:
    runs = [(run.set_points[:, motor], run.motor_positions[:, motor]) for run in recording.runs()]
    candidates = [(_pole(runs, d), d) for d in range(1, _MAX_DELAY + 1)]
    return min(candidates, key=lambda fit: _error(runs, *fit))


def _pole(runs: list[tuple[Vector, Vector]], d: int) -> float:
    """Least squares of `m(k+1) - u = a (m(k) - u)` with u = u(k+1-d)."""
    above = below = 0.0
    for u, m in runs:
        if u.size <= d:
            continue
        target = u[: u.size - d]
        ahead, now = m[d:] - target, m[d - 1 : -1] - target
        there = np.isfinite(ahead) & np.isfinite(now)
        above += float(ahead[there] @ now[there])
        below += float(now[there] @ now[there])
    return float(np.clip(above / below, 0.0, 0.999)) if below > 0 else 0.0


def _error(runs: list[tuple[Vector, Vector]], a: float, d: int) -> float:
    return sum(float(np.nansum((_simulate(u, _first(m, u), a, d) - m) ** 2)) for u, m in runs)


def _first(m: Vector, u: Vector) -> float:
    """Return the first position that was not missed; the first set-point where all were."""
    there = np.isfinite(m)
    return float(m[np.argmax(there)]) if there.any() else float(u[0])


def _simulate(u: Vector, start: float, a: float, d: int) -> Vector:
    from scipy.signal import lfilter

    if d == 0:
        return u.copy()
    # Before the record began the drive had reached its position.
    delayed = np.concatenate([np.full(min(d, u.size), start), u[: max(u.size - d, 0)]])
    return lfilter([1.0 - a], [1.0, -a], delayed, zi=[a * start])[0]


FUNCTIONS = "softneck.identification.models._bank_fit_runtime"
# A limit that no set-point reaches.
NO_LOAD = np.array([0.0, 1e9, 0.0, 0.0])
# The simplex starts here: a drive that follows a fast lag closely, and one that stops at a fixed tension.
# (logit of the pole of q, c, c1, c2)
_STARTS = ((2.0, 0.2, 0.9, 1.0), (4.0, 2.0, 0.3, 0.3), (2.0, 0.5, 0.8, 0.5))
_EVALUATIONS = 500
# A plain lag this close [rad^2] leaves nothing to explain: an encoder's step is 1e-4 rad.
_EXACT = 1e-7
# A limit that explains less of the error than this is noise.
_WORTH = 0.95
# A minute or two of motion say all there is to say about five numbers.
_MOST_ROWS = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class LoadedDrive:
    """A lag with dead time for each motor, and the limit they share.

    Attributes:
        drive: (motors, 2) pole and delay, as in `DriveModel`.
        load: (4,) pole of q, c, c1, c2 of `_bank_runtime`; `NO_LOAD` for none.
    """

    drive: Matrix
    load: Vector

    def simulate(self, set_points: Matrix, start: Vector) -> Matrix:
        """Return motor positions (time, motors) for set-points (time, motors), from `start` (motors,)."""
        motors = np.empty(set_points.shape)
        load_functions(FUNCTIONS).drive_run(
            self.drive, self.load, np.ascontiguousarray(set_points), np.ascontiguousarray(start), motors
        )
        return motors


def load_in_si(load: Vector, scaling: Scaling) -> Vector:
    """Return pole of q, c, c1, c2 of scaled motors, which rest at zero or have no limit, in SI."""
    return load * [1.0, scaling.motor_unit, 1.0, 1.0]


def fit_loaded_drive(recording: Recording, *, limited: bool = True) -> LoadedDrive:
    """Identify drives from logged positions, where `limited` with a common limit; none where it explains nothing."""
    from scipy.optimize import minimize

    plain = LoadedDrive(fit_drive(recording).array, NO_LOAD)
    if not recording.has_motor_positions or not limited:
        return plain
    runs = _longest(recording)
    error = _loaded_error(runs, plain)
    if error < _EXACT:
        return plain
    released = _released(runs, plain.drive)
    best, least = plain, _WORTH * error
    for start in _STARTS:
        found = minimize(
            lambda x: _loaded_error(runs, _from(x, released)),
            np.concatenate([[0.0], start]),
            method="Nelder-Mead",
            options={"maxfev": _EVALUATIONS, "xatol": 1e-4, "fatol": 1e-10},
        )
        if found.fun < least:
            best, least = _from(found.x, released), float(found.fun)
    return best


def drive_start(run: Recording) -> Vector:
    """Return the first motor positions (motors,) of a run; set-points where a position was missed."""
    logged = run.motor_positions[0]
    return np.where(np.isfinite(logged), logged, run.set_points[0])


def _longest(recording: Recording) -> list[tuple[Matrix, Matrix]]:
    left, runs = _MOST_ROWS, []
    for run in recording.runs():
        part = run.rows(0, min(len(run), left))
        runs.append((np.ascontiguousarray(part.set_points), part.motor_positions))
        left -= len(part)
        if left < 2:
            break
    return runs


def _released(runs: list[tuple[Matrix, Matrix]], fallback: Matrix) -> Matrix:
    """Return pole and delay of each motor from its moves away from the tension, which no load hinders."""
    drive = fallback.copy()
    for j in range(len(drive)):
        best = np.inf
        for d in range(1, _MAX_DELAY + 1):
            gaps, moves = _gaps(runs, j, d)
            slack = (gaps < -0.02) & np.isfinite(moves)
            if slack.sum() < 50:
                continue
            rate = float(moves[slack] @ gaps[slack] / (gaps[slack] @ gaps[slack]))
            error = float(np.mean((moves[slack] - rate * gaps[slack]) ** 2))
            if error < best and 0.001 < rate < 1.0:
                best, drive[j] = error, (1.0 - rate, d)
    return drive


def _gaps(runs: list[tuple[Matrix, Matrix]], j: int, d: int) -> tuple[Vector, Vector]:
    """Return how far the set-point was, and how far the motor went, over all samples of all runs."""
    parts = [(u[: len(u) - d, j] - m[d - 1 : -1, j], m[d:, j] - m[d - 1 : -1, j]) for u, m in runs if len(u) > d + 1]
    if not parts:
        return np.zeros(0), np.zeros(0)
    gaps, moves = zip(*parts, strict=True)
    return np.concatenate(gaps), np.concatenate(moves)


def _from(x: Vector, drive: Matrix) -> LoadedDrive:
    from scipy.special import expit, logit

    poles = expit(logit(np.clip(drive[:, 0], 1e-3, 1.0 - 1e-3)) + x[0])
    return LoadedDrive(np.column_stack([poles, drive[:, 1]]), np.array([expit(x[1]), *x[2:]]))


def _loaded_error(runs: list[tuple[Matrix, Matrix]], drive: LoadedDrive) -> float:
    above, count = 0.0, 0
    for u, m in runs:
        start = np.where(np.isfinite(m[0]), m[0], u[0])
        error = (drive.simulate(u, start) - m).ravel()
        there = np.isfinite(error)
        above += float(error[there] @ error[there])
        count += int(there.sum())
    return above / max(count, 1)


# How long a disturbance is remembered where nothing is measured any more [s]: twice the neck's time constant.
_MEMORY = 0.4
_GAINS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
# A faster correction than the hold-out asks for may cost it this much of the error: where the network has to
# extrapolate, its errors last longer than there.
_PRICE = 1.4
# Motions that are new leave larger errors than those of the training. On two necks that no test was recorded on this
# factor cost 0.02 points of the one-step fit on the excitation trained on, and gained 0.05 to 0.2 on another one.
NEW_MOTION_FACTOR = 3.0
# Poles beyond this would remember a measurement for minutes.
_RADIUS = 0.995


def fit_noise_model(errors: list[Vector], order: int, *, beyond: float = 1.0) -> Vector:
    """Return c (order,) of `e(k+1) = sum_i c_i e(k+1-i)` by Yule and Walker (Stoica and Moses 2005, sec. 3.4).

    Args:
        errors: one sequence a run; NaN where nothing was measured.
        order: how many errors back.
        beyond: how many times larger than these, beside the same noise, errors are taken to be on motions that are new.
    """
    r = np.zeros(order + 1)
    counts = np.zeros(order + 1)
    for e in errors:
        for lag in range(min(order + 1, e.size)):
            products = e[lag:] * e[: e.size - lag]
            there = np.isfinite(products)
            r[lag] += products[there].sum()
            counts[lag] += there.sum()
    # Dividing by one number keeps the matrix positive definite, and so the filter stable.
    r /= max(counts[0], 1.0)
    if r[0] <= 1e-20:
        return np.zeros(order)
    if beyond > 1.0 and order > 1:
        # What the line through the next two lags leaves of the first is noise; larger errors are as smooth.
        noise = float(np.clip(r[0] - (2.0 * r[1] - r[2]), 0.0, r[0]))
        r *= beyond**2
        r[0] -= (beyond**2 - 1.0) * noise
    R = r[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    c = np.linalg.solve(R + 1e-9 * r[0] * np.eye(order), r[1:])
    radius = float(np.abs(np.roots(np.concatenate([[1.0], -c]))).max(initial=0.0))
    if radius > _RADIUS:  # missed samples spoil the matrix: draw the poles in
        c = c * (_RADIUS / radius) ** np.arange(1, order + 1)
    return c


def fit_correction(errors: list[Vector], sample_time: float) -> Vector:
    """Return memory and gain (2,) of `d(k+1) = memory (d + gain (e - d))`, which foretells the next error e.

    The largest gain is taken whose squared error is at most 1.4 times the least.
    """
    from scipy.signal import lfilter

    memory = float(np.exp(-sample_time / _MEMORY))
    powers = []
    for gain in _GAINS:
        d = [lfilter([0.0, memory * gain], [1.0, -memory * (1.0 - gain)], np.nan_to_num(e)) for e in errors]
        left = np.concatenate([e - x for e, x in zip(errors, d, strict=True)])
        powers.append(float(np.nanmean(left**2)) if np.isfinite(left).any() else 0.0)
    allowed = [gain for gain, power in zip(_GAINS, powers, strict=True) if power <= _PRICE * min(powers)]
    return np.array([memory, max(allowed)])
