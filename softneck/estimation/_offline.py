"""The filter over recordings: filterpy as the engine, what surrounds it (gate, delays, gaps) in plain numpy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.core._shown import Shown
from softneck.robot import Robot
from softneck.signals import Recording
from softneck.signals.recording._recording import require_same_robot

from ._kalman_parts_runtime import (
    KALMAN_DIVIDER,
    KALMAN_FROZEN,
    KALMAN_GAP,
    KALMAN_GATE,
    KALMAN_KEEP,
    KALMAN_LEAD,
    KALMAN_REJECTIONS,
    KALMAN_STILL,
    KALMAN_TIMEOUT,
    KalmanArrays,
    kalman_lag,
)


class Filter(Protocol):
    """What an observer says of the recordings that it takes."""

    @property
    def form(self) -> str: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def sample_time(self) -> float: ...


class LinearFilter(Filter, Protocol):
    """What filtering a recording needs of a Kalman observer."""

    @property
    def arrays(self) -> tuple[Matrix, ...]: ...
    @property
    def noise(self) -> tuple[float, float, float]: ...
    @property
    def order(self) -> str: ...
    def filterpy(self) -> Any: ...


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Estimates(Shown):
    """What the filter made of a recording, row by row; angles of another robot are its outputs, in SI.

    Attributes:
        time: (time,) [s].
        outputs: (time, outputs) estimates at the time of the row: of a neck pitch and roll [rad].
        rates: (time, outputs) [rad/s].
        innovation: (time,) normalised innovation squared; 0 where nothing was measured.
        accepted: (time,) bool, whether the measurement was taken in.
        healthy: (time,) bool.
        judged: (time,) bool, whether there was a measurement to judge.
        aligned: (time, outputs) at the instant of the measurement; differs where the sensor is late.
        covariance: (time, outputs, outputs) of `aligned` [rad^2].
        log_det: (time,) log det of the innovation's covariance; 0 where nothing was measured.
    """

    time: Vector
    outputs: Matrix
    rates: Matrix
    innovation: Vector
    accepted: np.ndarray
    healthy: np.ndarray
    judged: np.ndarray
    aligned: Matrix
    covariance: np.ndarray
    log_det: Vector

    @property
    def pitch(self) -> Vector:
        """Of a neck: the estimates of pitch (time,) [rad]."""
        return self.outputs[:, 0]

    @property
    def roll(self) -> Vector:
        """Of a neck: the estimates of roll (time,) [rad]."""
        return self.outputs[:, 1]

    @property
    def pitch_rate(self) -> Vector:
        """Of a neck: the rates of pitch (time,) [rad/s]."""
        return self.rates[:, 0]

    @property
    def roll_rate(self) -> Vector:
        """Of a neck: the rates of roll (time,) [rad/s]."""
        return self.rates[:, 1]


@dataclass(slots=True)
class _Pass:
    """One run filtered: what each row had after its measurement."""

    sources: Matrix
    x: list[Vector] = field(default_factory=list)
    P: list[Matrix] = field(default_factory=list)
    # innovation, accepted, healthy, judged, log det
    flags: list[tuple[float, ...]] = field(default_factory=list)


def filter_recording(observer: LinearFilter, recording: Recording) -> Estimates:
    """Return what the filter makes of each run."""
    check_recording(observer, recording)
    columns: list[tuple[np.ndarray, ...]] = []
    for run in recording.runs():
        columns.append(_told(observer, _forward(observer, run)))
    stacked = [np.concatenate(parts) for parts in zip(*columns, strict=True)]
    angle, rate, flags, aligned, covariance = stacked
    innovation, accepted, healthy, judged, log_det = flags.T.copy()
    return Estimates(
        time=recording.time,
        outputs=angle,
        rates=rate,
        innovation=innovation,
        accepted=accepted > 0.5,
        healthy=healthy > 0.5,
        judged=judged > 0.5,
        aligned=aligned,
        covariance=covariance,
        log_det=log_det,
    )


def measured_angles(run: Recording) -> Matrix:
    """Return the measured outputs (time, outputs): `pitch_measured` where a simulation logged it, else `pitch`."""
    return np.column_stack([run.channels[name] for name in measured_names(run)])


def measured_names(run: Recording) -> list[str]:
    """Return the channels of the measured outputs: `pitch` beside `pitch_measured` is the truth."""
    axes = run.robot.outputs.names
    return [f"{axis}_measured" if f"{axis}_measured" in run.channels else axis for axis in axes]


def source_rows(observer: LinearFilter, run: Recording) -> tuple[Matrix, np.ndarray]:
    """Return what the filter's sources say in each row (time, sources), and where the gyro said nothing (time,)."""
    if observer.form != "gyro":
        # The set-points of t_k are commanded after the measurement of t_k: the filter knows those before.
        return run.set_points[np.maximum(np.arange(len(run)) - 1, 0)], np.zeros(len(run), dtype=bool)
    rates = np.column_stack([_rate(run, axis) for axis in run.robot.outputs.names])
    lost = np.asarray(~np.isfinite(rates).all(axis=1))
    known = np.maximum.accumulate(np.where(lost, -1, np.arange(len(run))))
    return np.where(known[:, None] < 0, 0.0, rates[known]), lost


def check_recording(observer: Filter, recording: Recording) -> None:
    """Raise DataError for another sample time, missing rates or another robot."""
    if not math.isclose(recording.sample_time, observer.sample_time, rel_tol=1e-6):
        raise DataError(
            f"the recording has sample time {recording.sample_time:g} s, the observer {observer.sample_time:g} s; "
            "resample it or design the observer for it."
        )
    require_same_robot(observer.robot, recording.robot, "the recording and the observer")
    if observer.form == "gyro":
        for axis in recording.robot.outputs.names:
            _rate(recording, axis)


def _rate(run: Recording, axis: str) -> Vector:
    for name in (f"{axis}_rate_measured", f"{axis}_rate"):
        if name in run.channels:
            return run.channels[name]
    raise DataError(
        f"the recording has no channel `{axis}_rate`, which a filter with gyro needs; record it, or design the "
        "observer without the gyro."
    )


def _forward(observer: LinearFilter, run: Recording) -> _Pass:
    """Filter one run with filterpy."""
    p = KalmanArrays(observer.arrays)
    H, c = p.H, p.constants
    kf: Any = observer.filterpy()
    kf.x = np.zeros((H.shape[1], 1))
    raw, lost = source_rows(observer, run)
    passed = _Pass(sources=raw @ p.sources.T)
    z = measured_angles(run)
    usable, frozen = _usable(z, c, observer.noise[0])
    gap = c[KALMAN_GAP] ** 2 * p.first_noise / p.first_noise.max()
    length = math.ceil(max(_lags(observer))) + 1
    misses, rejections = c[KALMAN_TIMEOUT], 0
    for k in range(len(run)):
        kf.predict(_input(observer, passed.sources, k)[:, None])
        forced = rejections >= c[KALMAN_REJECTIONS]
        kf.P = kf.P + (gap if lost[k] else 0.0) + (p.P0 if k < length else p.PF if forced else 0.0)
        nis, log_det, accepted = 0.0, 0.0, False
        if usable[k]:
            e = z[k][:, None] - H @ kf.x
            S = H @ kf.P @ H.T + kf.R
            nis, log_det = float((e.T @ np.linalg.solve(S, e))[0, 0]), float(np.linalg.slogdet(S)[1])
            accepted = forced or nis <= c[KALMAN_GATE]
            rejections = 0 if accepted else rejections + 1
        kf.update(z[k][:, None] if accepted else None)
        misses = 0 if accepted else misses + 1
        passed.x.append(kf.x[:, 0].copy())
        passed.P.append(kf.P.copy())
        passed.flags.append((nis, accepted, misses < c[KALMAN_TIMEOUT] and not frozen[k], usable[k], log_det))
    return passed


def _told(observer: LinearFilter, passed: _Pass) -> tuple[np.ndarray, ...]:
    """Return outputs and rates (time, outputs) ahead by the sensor's delay, flags, aligned outputs, covariances."""
    x, P = np.array(passed.x), np.array(passed.P)
    p = KalmanArrays(observer.arrays)
    H, c = p.H, p.constants
    whole = int(c[KALMAN_LEAD])
    part = c[KALMAN_LEAD] - whole
    size = len(x)
    # ahead[i, k]: the angles i samples after the filter's time of row k.
    ahead = np.empty((whole + 2, size, len(H)))
    for k in range(size):
        state = x[k]
        ahead[0, k] = H @ state
        for i in range(1, whole + 2):
            state = p.F @ state + p.B @ _input(observer, passed.sources, k, i)
            ahead[i, k] = H @ state
    angle = ahead[whole] + part * (ahead[whole + 1] - ahead[whole])
    rate = (ahead[whole + 1] - ahead[whole]) / observer.sample_time
    return angle, rate, np.array(passed.flags, dtype=float), ahead[0].copy(), H @ P @ H.T


def _lags(observer: LinearFilter) -> list[float]:
    """Return the lags of the inputs; what a Jacobi loop adds, a recording does not have."""
    late = float(observer.order == "jacobi" and observer.form == "model")
    c = KalmanArrays(observer.arrays).constants
    return [kalman_lag(c, axis) - late for axis in range(len(observer.robot.outputs.names))]


def _input(observer: LinearFilter, sources: Matrix, k: int, ahead: int = 0) -> Vector:
    """Return the inputs (outputs,) that act `ahead` samples after the filter's time of row k, from what row k knows."""
    u = np.empty(sources.shape[1])
    for axis, lag in enumerate(_lags(observer)):
        place = max(k - max(lag - ahead, 0.0), 0.0)
        u[axis] = (
            np.interp(place, np.arange(k + 1), sources[: k + 1, axis]) if place % 1.0 else sources[int(place), axis]
        )
    return u


def _usable(z: Matrix, c: Vector, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where a new measurement of a living sensor came, and where the sensor is frozen (time,)."""
    usable, frozen = np.zeros(len(z), dtype=bool), np.zeros(len(z), dtype=bool)
    last, age, repeats, scatter = np.full(z.shape[1], np.nan), math.inf, 0, 0.0
    for k, angles in enumerate(z):
        age += 1
        same = bool((angles == last).all())
        new = bool(np.isfinite(angles).all()) and not (same and age < c[KALMAN_DIVIDER])
        if new:
            if not same and np.isfinite(last).all():
                scatter = KALMAN_KEEP * scatter + (1.0 - KALMAN_KEEP) * float(np.mean((angles - last) ** 2))
            age, repeats, last = 0, repeats + 1 if same else 0, angles
        frozen[k] = 0 < c[KALMAN_FROZEN] <= repeats + 1 and scatter > (KALMAN_STILL * noise) ** 2
        usable[k] = new and not frozen[k]
    return usable, frozen
