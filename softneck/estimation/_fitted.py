"""An observer's numbers from recordings: noise levels, dead time and the sensor's delay, kept only where they help."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording, concatenate

from ._consistency import look_ahead_error
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_LEAD, KALMAN_MORE_LAGS, kalman_lag
from ._noise import Cost, NoiseFit, fit_noise
from ._offline import measured_angles

# Part of each run to fit to; the rest checks.
_FITTED = 0.7
# Dead times that are tried beyond the model's own [samples].
_MOST_LATER = 8
# The sensor's delay is looked for up to here [s], a quarter of a sample at a time, over changes within so many samples.
_LONGEST, _PARTS, _WITHIN = 0.2, 4, 5
# What the reference must explain of the changes for its delay to be believed.
_EXPLAINED = 0.8


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FittedObserver:
    """What recordings make of an observer.

    Attributes:
        observer: the best of those that were checked.
        kept: what it is: "default", or what was fitted: "noise", "noise and delay".
        checks: name -> look-ahead error on rows held out [SI].
        fit: of the noise levels.
        untold: names of numbers that the data do not tell.
        rows: held out.
    """

    observer: KalmanObserver
    kept: str
    checks: dict[str, float]
    fit: NoiseFit
    untold: tuple[str, ...]
    rows: int


def fitted_observer(
    observer: KalmanObserver, recordings: Sequence[Recording], *, fixed: Sequence[str] = (), delay: bool = True
) -> FittedObserver:
    """Return the observer with the numbers under which the recordings are most likely, where they are better.

    Noise levels, and of form "model" the dead time of the set-points, have the greatest likelihood on the first 70 % of
    each run. From set-points and angles only the sum of what drives and sensor delay can be told; `sensor_delay` says
    what motor positions and rates tell of the latter. All are judged by `look_ahead_error` on the rest, and nothing is
    taken that is not better there.

    Args:
        observer: with the numbers to start from.
        recordings: of its sample time.
        fixed: names of noise levels that stay as they are.
        delay: whether the delays may change as well.

    Raises:
        SettingsError, DataError: as `fit_noise` and `look_ahead_error`.
    """
    parts = [recording.split(_FITTED) for recording in recordings]
    heads, rest = [head for head, _ in parts], concatenate([tail for _, tail in parts])
    told, source = sensor_delay(observer, heads) if delay else (None, "")
    start = observer if told is None else _leading(observer, told, source)
    fit = fit_noise(start, heads, fixed=fixed)
    candidates = {"default": observer, "noise": fit.observer.with_constants(observer.constants)}
    later = likeliest_later(fit.observer, heads) if observer.form == "model" and delay else 0
    if later:
        fit = fit_noise(delayed(start, later), heads, fixed=fixed)
    if later or told is not None:
        candidates["noise and delay"] = fit.observer
    untold = (*fit.at_bound, *(("sensor_delay",) if told is None else ()))
    # One yardstick: each is asked for the same angles, as late as the sensor is said to be.
    checks = {name: look_ahead_error(item, rest, start.lead) for name, item in candidates.items()}
    kept = min(checks, key=lambda name: checks[name])
    return FittedObserver(observer=candidates[kept], kept=kept, checks=checks, fit=fit, untold=untold, rows=len(rest))


def delayed(observer: KalmanObserver, later: int) -> KalmanObserver:
    """Return the same filter whose set-points act some samples later."""
    constants = observer.constants.copy()
    constants[KALMAN_LAG : KALMAN_LAG + 2] += later
    constants[KALMAN_MORE_LAGS:] += later
    return observer.with_constants(constants)


def _leading(observer: KalmanObserver, lead: float, source: str) -> KalmanObserver:
    """Return the same filter of a sensor that is `lead` [s] late."""
    constants = observer.constants.copy()
    if observer.form == "gyro":
        # The rates stay as late as they are, so the angles are later behind them.
        constants[KALMAN_LAG : KALMAN_LAG + 2] += lead / observer.sample_time - constants[KALMAN_LEAD]
        constants[KALMAN_MORE_LAGS:] += lead / observer.sample_time - constants[KALMAN_LEAD]
    constants[KALMAN_LEAD] = lead / observer.sample_time
    return replace(observer.with_constants(constants), delay_source=source)


def likeliest_later(observer: KalmanObserver, recordings: Sequence[Recording]) -> int:
    """Return by how many samples more than the model says set-points act late, by the likelihood at these levels."""
    runs = [run for recording in recordings for run in recording.runs()]
    level = np.log10(observer.noise)
    return int(np.argmin([Cost(delayed(observer, later), runs).of(level) for later in range(_MOST_LATER + 1)]))


def sensor_delay(observer: KalmanObserver, recordings: Sequence[Recording]) -> tuple[float | None, str]:
    """Return how late the angles are [s], None where nothing tells, and by what: the gyro's rates or the motors.

    A gyro may be late itself, most of all one of the same sensor: it tells by how much more the angles are, which is
    what form "gyro" needs, and its own delay comes on top. In form "model" motors tell the most that it can be, as the
    link lags as well: that holds where it is less than the filter thinks.
    """
    runs = [run for recording in recordings for run in recording.runs()]
    source, reference = ("gyro", _turned) if observer.form == "gyro" else ("motor positions", _pulled)
    pairs = [(measured_angles(run), reference(observer, run)) for run in runs]
    known = [(z, way) for z, way in pairs if way is not None]
    lag = _lag(known, observer.sample_time) if known else None
    if lag is None or (observer.form == "model" and lag >= observer.lead):
        return None, ""
    if observer.form == "gyro":
        # In the filter the rates act half a sample, and what they are newer than the angles, ago.
        newer = (kalman_lag(observer.constants, 0) - 0.5) * observer.sample_time
        lag += max(observer.lead - newer, 0.0)
    return lag, source


def _turned(observer: KalmanObserver, run: Recording) -> Matrix | None:
    """Return the angle that the gyro's rates add up to (time, outputs)."""
    rates = []
    for axis in run.robot.outputs.names:
        found = [run.channels[name] for name in (f"{axis}_rate_measured", f"{axis}_rate") if name in run.channels]
        if not found:
            return None
        rates.append(np.nan_to_num(found[0]))
    # The mean of the rates at both ends of a sample.
    rate = np.column_stack(rates)
    steps = 0.5 * (rate + np.vstack([rate[:1], rate[:-1]])) * observer.sample_time
    return np.cumsum(steps, axis=0)


def _pulled(observer: KalmanObserver, run: Recording) -> Matrix | None:
    """Return what the motors' positions add up to in each axis (time, outputs)."""
    names = [f"motor_position_{j + 1}" for j in range(len(run.robot.motors.names))]
    if observer.form != "model" or not set(names) <= set(run.channels):
        return None
    return np.column_stack([run.channels[name] for name in names]) @ observer.directions.T


def _lag(pairs: Sequence[tuple[Matrix, Matrix]], period: float) -> float | None:
    """Return by how much the angles' changes are later than a reference's [s]; None where it explains too little."""
    lags = np.arange(0, round(_LONGEST / period * _PARTS) + 1) / _PARTS
    missed = [_unexplained(pairs, float(lag)) for lag in lags]
    best = int(np.argmin(missed))
    if best == len(lags) - 1 or missed[best] > 1.0 - _EXPLAINED:
        return None
    return float(lags[best]) * period


def _unexplained(pairs: Sequence[tuple[Matrix, Matrix]], lag: float) -> float:
    """Return the part of the angles' changes that a gain times the reference's, `lag` samples before, leaves over."""
    left, whole = 0.0, 0.0
    for axis in range(pairs[0][0].shape[1]):
        changes = [(_changes(z[:, axis]), _changes(_late(way[:, axis], lag))) for z, way in pairs]
        y, x = (np.concatenate(parts) for parts in zip(*changes, strict=True))
        known = np.isfinite(y) & np.isfinite(x)
        y, x = y[known] - np.mean(y[known]), x[known] - np.mean(x[known])
        left += float(y @ y) - float(x @ y) ** 2 / max(float(x @ x), 1e-300)
        whole += float(y @ y)
    return left / whole if whole > 0.0 and math.isfinite(whole) else 1.0


def _changes(values: Vector) -> Vector:
    return values[_WITHIN:] - values[:-_WITHIN]


def _late(values: Vector, lag: float) -> Vector:
    rows = np.arange(len(values), dtype=float)
    return np.interp(rows - lag, rows, values)
