"""The Kalman filter by filterpy, what surrounds it (gate, delays, gaps) in plain numpy: what the runtime must equal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import Estimates, KalmanObserver
from softneck.estimation._kalman_parts_runtime import (
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
from softneck.estimation._offline import _rate, measured_angles
from softneck.signals import Recording


@dataclass(slots=True)
class _Pass:
    """One run filtered: what each row had after its measurement."""

    sources: Matrix
    x: list[Vector] = field(default_factory=list)
    P: list[Matrix] = field(default_factory=list)
    # innovation, accepted, healthy, judged, log det
    flags: list[tuple[float, ...]] = field(default_factory=list)


def by_filterpy(observer: KalmanObserver, recording: Recording) -> Estimates:
    """Return what the filter makes of each run."""
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


def _source_rows(observer: KalmanObserver, run: Recording) -> tuple[Matrix, np.ndarray]:
    """Return what the filter's sources say in each row (time, sources), and where the gyro said nothing (time,)."""
    if observer.form != "gyro":
        # The set-points of t_k are commanded after the measurement of t_k: the filter knows those before.
        return run.set_points[np.maximum(np.arange(len(run)) - 1, 0)], np.zeros(len(run), dtype=bool)
    rates = np.column_stack([_rate(run, axis) for axis in run.robot.outputs.names])
    lost = np.asarray(~np.isfinite(rates).all(axis=1))
    known = np.maximum.accumulate(np.where(lost, -1, np.arange(len(run))))
    return np.where(known[:, None] < 0, 0.0, rates[known]), lost


def _forward(observer: KalmanObserver, run: Recording) -> _Pass:
    """Filter one run with filterpy."""
    p = KalmanArrays(observer.arrays)
    H, c = p.H, p.constants
    kf: Any = observer.filterpy()
    kf.x = np.zeros((H.shape[1], 1))
    raw, lost = _source_rows(observer, run)
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


def _told(observer: KalmanObserver, passed: _Pass) -> tuple[np.ndarray, ...]:
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


def _lags(observer: KalmanObserver) -> list[float]:
    """Return the lags of the inputs; what a Jacobi loop adds, a recording does not have."""
    late = float(observer.order == "jacobi" and observer.form == "model")
    c = KalmanArrays(observer.arrays).constants
    return [kalman_lag(c, axis) - late for axis in range(len(observer.robot.outputs.names))]


def _input(observer: KalmanObserver, sources: Matrix, k: int, ahead: int = 0) -> Vector:
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
