"""Drive models, from motor set-point to measured position, and noise models of prediction errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector, compute_once
from softneck.robot import Scaling
from softneck.runtime import load_functions
from softneck.signals import Recording

# 0.2 s at 20 ms; the paper's drives answer sooner.
_MAX_DELAY_SAMPLES = 10


@dataclass(frozen=True, slots=True, eq=False)
class DriveModel:
    """`m(k+1) = a m(k) + (1 - a) u(k+1-d)`: pole a, delay d [samples] of each motor; d = 0 without logged positions."""

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
    """Return pole and delay [samples] with the smallest simulation error."""
    runs = [(run.set_points[:, motor], run.motor_positions[:, motor]) for run in recording.runs()]
    # The first measured position, or the first set-point where none was measured.
    firsts = [float(m[np.argmax(np.isfinite(m))] if np.isfinite(m).any() else u[0]) for u, m in runs]

    def squared_error(a: float, d: int) -> float:
        errors = [_simulate(u, m0, a, d) - m for (u, m), m0 in zip(runs, firsts, strict=True)]
        return sum(float(np.nansum(e**2)) for e in errors)

    candidates = [(_fit_pole(runs, d), d) for d in range(1, _MAX_DELAY_SAMPLES + 1)]
    return min(candidates, key=lambda fit: squared_error(*fit))


def _fit_pole(runs: list[tuple[Vector, Vector]], d: int) -> float:
    """Fit `m(k+1) - u = a (m(k) - u)` with u = u(k+1-d) by least squares."""
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


def _simulate(u: Vector, start: float, a: float, d: int) -> Vector:
    from scipy.signal import lfilter

    if d == 0:
        return u.copy()
    # The drive is at rest at `start` before the recording.
    delayed = np.concatenate([np.full(min(d, u.size), start), u[: max(u.size - d, 0)]])
    return lfilter([1.0 - a], [1.0, -a], delayed, zi=[a * start])[0]


FUNCTIONS = "softneck.identification.models._bank_fit_runtime"
# A limit that no set-point reaches.
NO_LOAD = np.array([0.0, 1e9, 0.0, 0.0])
# Starts of the simplex (logit of the pole of q, c, c1, c2): a drive behind a fast lag, one that stalls at a fixed
# tension, and one between them.
_SIMPLEX_STARTS = ((2.0, 0.2, 0.9, 1.0), (4.0, 2.0, 0.3, 0.3), (2.0, 0.5, 0.8, 0.5))
_MAX_EVALUATIONS = 500
# Mean squared error [rad^2] below which no limit is fitted: an encoder's step is 1e-4 rad.
_NEGLIGIBLE_ERROR = 1e-7
# A limit must bring the error below this share of that without one; else it explains noise.
_MAX_ERROR_RATIO = 0.95
# A minute or two of motion determine five parameters.
_MAX_ROWS = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class LoadedDrive:
    """A drive (motors, 2): pole, delay; its load limit (4,): pole of q, c, c1, c2 of `_bank_runtime` or `NO_LOAD`.

    Of valves the load has two numbers more, their poles while a chamber fills and while it vents.
    """

    drive: Matrix
    load: Vector

    def with_valves(self, poles: Vector) -> LoadedDrive:
        """Return it with chambers that follow their set-points by these poles (2,), of filling and of venting."""
        drive = np.tile([float(poles.mean()), 1.0], (len(self.drive), 1))
        return LoadedDrive(drive, np.concatenate([self.load[:4], poles]))

    def simulate(self, set_points: Matrix, start: Vector) -> Matrix:
        """Return motor positions (time, motors) for set-points (time, motors), from `start` (motors,)."""
        motors, inputs = np.empty(set_points.shape), np.ascontiguousarray(set_points)
        load_functions(FUNCTIONS).drive_run(self.drive, self.load, inputs, np.ascontiguousarray(start), motors)
        return motors


def load_in_si(load: Vector, scaling: Scaling) -> Vector:
    """Convert pole of q, c, c1, c2 of scaled motors, which rest at zero or have no limit, to SI."""
    return load * [1.0, scaling.motor_unit, 1.0, 1.0, 1.0, 1.0][: load.size]


def fit_loaded_drive(recording: Recording, *, limited: bool = True) -> LoadedDrive:
    """Identify drives from logged positions, if `limited` with the load limit where it explains part of the error."""
    plain = LoadedDrive(fit_drive(recording).array, NO_LOAD)
    if not recording.has_motor_positions or not limited:
        return plain
    # Of a robot every kind asks for it.
    runs = _first_runs(recording)
    return compute_once(lambda: _fit_limit(runs, plain), runs, plain.drive)


def drive_delays(recording: Recording, *, limited: bool = True) -> Vector:
    """Return the dead times [samples] of `fit_loaded_drive` (motors,), which seldom needs the load limit for them."""
    plain = fit_drive(recording)
    if recording.has_motor_positions and limited:
        slack = _fit_slack_drive(_first_runs(recording), plain.array)
        if (slack[:, 1] != plain.delay).any():
            return fit_loaded_drive(recording).drive[:, 1]
    return plain.delay


def _first_runs(recording: Recording) -> list[tuple[Matrix, Matrix]]:
    """Return set-points and motor positions of the runs of the first rows."""
    left, runs = _MAX_ROWS, []
    for run in recording.runs():
        part = run.rows(0, min(len(run), left))
        runs.append((np.ascontiguousarray(part.set_points), part.motor_positions))
        left -= len(part)
        if left < 2:
            break
    return runs


def _fit_limit(runs: list[tuple[Matrix, Matrix]], plain: LoadedDrive) -> LoadedDrive:
    """Return the drive with a load limit if that explains part of the error of `plain`."""
    from scipy.optimize import minimize
    from scipy.special import expit, logit

    error = _mean_squared_error(runs, plain)
    if error < _NEGLIGIBLE_ERROR:
        return plain
    slack = _fit_slack_drive(runs, plain.drive)

    def decode(x: Vector) -> LoadedDrive:
        poles = expit(logit(np.clip(slack[:, 0], 1e-3, 1.0 - 1e-3)) + x[0])
        return LoadedDrive(np.column_stack([poles, slack[:, 1]]), np.array([expit(x[1]), *x[2:]]))

    best, smallest = plain, _MAX_ERROR_RATIO * error
    options = {"maxfev": _MAX_EVALUATIONS, "xatol": 1e-4, "fatol": 1e-10}
    for start in _SIMPLEX_STARTS:
        x0 = np.array([0.0, *start])
        found = minimize(lambda x: _mean_squared_error(runs, decode(x)), x0, method="Nelder-Mead", options=options)
        if found.fun < smallest:
            best, smallest = decode(found.x), float(found.fun)
    return best


def drive_start(run: Recording) -> Vector:
    """Return the first motor positions (motors,) of a run; set-points where a position was missed."""
    logged = run.motor_positions[0]
    return np.where(np.isfinite(logged), logged, run.set_points[0])


def _fit_slack_drive(runs: list[tuple[Matrix, Matrix]], fallback: Matrix) -> Matrix:
    """Fit pole and delay of each motor to its moves that slacken the tendon, which no load limits."""
    drive = fallback.copy()
    for j in range(len(drive)):
        best = np.inf
        for d in range(1, _MAX_DELAY_SAMPLES + 1):
            long = [(u[: len(u) - d, j], m[d - 1 : -1, j], m[d:, j]) for u, m in runs if len(u) > d + 1]
            gaps = np.concatenate([np.zeros(0), *(target - now for target, now, _ in long)])
            moves = np.concatenate([np.zeros(0), *(ahead - now for _, now, ahead in long)])
            slack = (gaps < -0.02) & np.isfinite(moves)
            if slack.sum() < 50:
                continue
            rate = float(moves[slack] @ gaps[slack] / (gaps[slack] @ gaps[slack]))
            error = float(np.mean((moves[slack] - rate * gaps[slack]) ** 2))
            if error < best and 0.001 < rate < 1.0:
                best, drive[j] = error, (1.0 - rate, d)
    return drive


def _mean_squared_error(runs: list[tuple[Matrix, Matrix]], drive: LoadedDrive) -> float:
    above, count = 0.0, 0
    for u, m in runs:
        start = np.where(np.isfinite(m[0]), m[0], u[0])
        error = (drive.simulate(u, start) - m).ravel()
        there = np.isfinite(error)
        above += float(error[there] @ error[there])
        count += int(there.sum())
    return above / max(count, 1)


# Time constant with which a disturbance decays without measurements [s]: twice that of the neck.
_DISTURBANCE_DECAY_S = 0.4
_CORRECTION_GAINS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
# The largest gain may cost this much of the smallest hold-out error: errors last longer where the network extrapolates.
_MAX_HOLD_OUT_RATIO = 1.4
# Errors on new motions are larger than in training. On two necks that no test was recorded on, this factor cost 0.02
# points of the one-step fit on the trained excitation and gained 0.05 to 0.2 on another one.
NEW_MOTION_FACTOR = 3.0
# Poles beyond this would remember a measurement for minutes.
_MAX_POLE_RADIUS = 0.995


def fit_noise_model(errors: list[Vector], order: int, *, beyond: float = 1.0) -> Vector:
    """Fit c (order,) of `e(k+1) = sum_i c_i e(k+1-i)` by Yule and Walker (Stoica and Moses 2005, sec. 3.4).

    On new motions errors are assumed `beyond` times larger, with the same measurement noise.
    """
    r = np.zeros(order + 1)
    counts = np.zeros(order + 1)
    for e in errors:
        for lag in range(min(order + 1, e.size)):
            products = e[lag:] * e[: e.size - lag]
            there = np.isfinite(products)
            r[lag] += products[there].sum()
            counts[lag] += there.sum()
    # One common divisor keeps the matrix positive definite, and so the filter stable.
    r /= max(counts[0], 1.0)
    if r[0] <= 1e-20:
        return np.zeros(order)
    if beyond > 1.0 and order > 1:
        # Noise is the part of r(0) above the line through the next two lags; only the smooth rest grows.
        noise = float(np.clip(r[0] - (2.0 * r[1] - r[2]), 0.0, r[0]))
        r *= beyond**2
        r[0] -= (beyond**2 - 1.0) * noise
    R = r[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    c = np.linalg.solve(R + 1e-9 * r[0] * np.eye(order), r[1:])
    radius = float(np.abs(np.roots(np.concatenate([[1.0], -c]))).max(initial=0.0))
    if radius > _MAX_POLE_RADIUS:  # missed samples spoil the matrix: draw the poles in
        c = c * (_MAX_POLE_RADIUS / radius) ** np.arange(1, order + 1)
    return c


def fit_correction(errors: list[Vector], sample_time: float) -> Vector:
    """Fit memory and gain (2,) of `d(k+1) = memory (d + gain (e - d))`, which predicts the next error e.

    It takes the largest gain whose squared error is at most 1.4 times the smallest.
    """
    from scipy.signal import lfilter

    memory = float(np.exp(-sample_time / _DISTURBANCE_DECAY_S))
    powers = []
    for gain in _CORRECTION_GAINS:
        d = [lfilter([0.0, memory * gain], [1.0, -memory * (1.0 - gain)], np.nan_to_num(e)) for e in errors]
        left = np.concatenate([e - x for e, x in zip(errors, d, strict=True)])
        powers.append(float(np.nanmean(left**2)) if np.isfinite(left).any() else 0.0)
    limit = _MAX_HOLD_OUT_RATIO * min(powers)
    return np.array(
        [memory, max(gain for gain, power in zip(_CORRECTION_GAINS, powers, strict=True) if power <= limit)]
    )
