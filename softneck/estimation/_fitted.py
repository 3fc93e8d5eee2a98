"""An observer's numbers from recordings: noise levels, dead time and the sensor's delay, kept only where they help."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.identification import known_rows
from softneck.signals import Recording, concatenate

from ._consistency import look_ahead_error
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_LEAD, KALMAN_MORE_LAGS, kalman_lag
from ._noise import NoiseFit, cost_of, fit_noise
from ._nonlinear import NonlinearObserver
from ._offline import measured_angles

AnyObserver = KalmanObserver | NonlinearObserver

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

    observer: AnyObserver
    kept: str
    checks: dict[str, float]
    fit: NoiseFit
    untold: tuple[str, ...]
    rows: int


def fitted_observer(
    observer: AnyObserver, recordings: Sequence[Recording], *, fixed: Sequence[str] = (), delay: bool = True
) -> FittedObserver:
    """Return the observer with the numbers under which the recordings are most likely, where they are better.

    Noise levels, and of form "model" the dead time of the set-points, have the greatest likelihood on the first 70 % of
    each run. From set-points and angles only the sum of what drives and sensor delay can be told; `sensor_delay` says
    what motor positions and rates tell of the latter. Over a nonlinear model what it misses is not told by rows that it
    was trained on. All are judged by `look_ahead_error` on the rest, and nothing is taken that is not better there.

    Args:
        observer: with the numbers to start from.
        recordings: of its sample time.
        fixed: names of noise levels that stay as they are.
        delay: whether the delays may change as well.

    Raises:
        SettingsError: nothing is left to be told by rows that the model was trained on.
        SettingsError, DataError: as `fit_noise` and `look_ahead_error`.
    """
    parts = [recording.split(_FITTED) for recording in recordings]
    heads, rest = [head for head, _ in parts], concatenate([tail for _, tail in parts])
    unseen = () if not isinstance(observer, NonlinearObserver) else _of_the_model(observer, recordings)
    if unseen and observer.noise_names[0] in fixed:
        raise SettingsError(
            "the model was trained on these rows, which tell no more than the sensor's noise, and that is given; "
            "take a recording that the model has not seen."
        )
    fixed = (*fixed, *unseen)
    told, source = sensor_delay(observer, heads) if delay else (None, "")
    start = observer if told is None else _leading(observer, told, source)
    fit = fit_noise(start, heads, fixed=fixed)
    candidates = {"default": observer, "noise": fit.observer.with_constants(observer.constants)}
    # A nonlinear model's dead time is its own.
    later = likeliest_later(fit.observer, heads) if observer.form == "model" and delay else 0
    if later:
        fit = fit_noise(delayed(start, later), heads, fixed=fixed)
    if later or told is not None:
        candidates["noise and delay"] = fit.observer
    untold = (*fit.at_bound, *unseen, *(("sensor_delay",) if told is None else ()))
    # One yardstick: each is asked for the same angles, as late as the sensor is said to be.
    checks = {name: look_ahead_error(item, rest, start.lead) for name, item in candidates.items()}
    kept = min(checks, key=lambda name: checks[name])
    return FittedObserver(observer=candidates[kept], kept=kept, checks=checks, fit=fit, untold=untold, rows=len(rest))


def _of_the_model(observer: NonlinearObserver, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the levels that recordings cannot tell which the model is from: there it is better than anywhere else."""
    seen = observer.model.training_rows
    return observer.noise_names[1:] if any(known_rows(item, seen).any() for item in recordings) else ()


def delayed(observer: AnyObserver, later: int) -> AnyObserver:
    """Return the same filter whose set-points act some samples later."""
    constants = observer.constants.copy()
    constants[KALMAN_LAG : KALMAN_LAG + 2] += later
    constants[KALMAN_MORE_LAGS:] += later
    return observer.with_constants(constants)


def _leading(observer: AnyObserver, lead: float, source: str) -> AnyObserver:
    """Return the same filter of a sensor that is `lead` [s] late."""
    constants = observer.constants.copy()
    if observer.form == "gyro":
        # The rates stay as late as they are, so the angles are later behind them.
        constants[KALMAN_LAG : KALMAN_LAG + 2] += lead / observer.sample_time - constants[KALMAN_LEAD]
        constants[KALMAN_MORE_LAGS:] += lead / observer.sample_time - constants[KALMAN_LEAD]
    constants[KALMAN_LEAD] = lead / observer.sample_time
    return replace(observer.with_constants(constants), delay_source=source)


def likeliest_later(observer: AnyObserver, recordings: Sequence[Recording]) -> int:
    """Return by how many samples more than the model says set-points act late, by the likelihood at these levels."""
    runs = [run for recording in recordings for run in recording.runs()]
    level = np.log10(observer.noise)
    return int(np.argmin([cost_of(delayed(observer, later), runs).of(level) for later in range(_MOST_LATER + 1)]))


def sensor_delay(observer: AnyObserver, recordings: Sequence[Recording]) -> tuple[float | None, str]:
    """Return how late the angles are [s], None where nothing tells, and by what: the gyro's rates or the motors.

    A gyro may be late itself, most of all one of the same sensor: it tells by how much more the angles are, which is
    what form "gyro" needs, and its own delay comes on top. Over a model motors tell the most that it can be, as the
    link lags as well: that holds where it is less than the filter thinks.
    """
    runs = [run for recording in recordings for run in recording.runs()]
    source, reference = ("gyro", _turned) if observer.form == "gyro" else ("motor positions", _pulled)
    pairs = [(measured_angles(run), reference(observer, run)) for run in runs]
    known = [(z, way) for z, way in pairs if way is not None]
    lag = _lag(known, observer.sample_time) if known else None
    if lag is None or (observer.form != "gyro" and lag >= observer.lead):
        return None, ""
    if observer.form == "gyro":
        # In the filter the rates act half a sample, and what they are newer than the angles, ago.
        newer = (kalman_lag(observer.constants, 0) - 0.5) * observer.sample_time
        lag += max(observer.lead - newer, 0.0)
    return lag, source


def _turned(observer: AnyObserver, run: Recording) -> Matrix | None:
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


def _pulled(observer: AnyObserver, run: Recording) -> Matrix | None:
    """Return what the motors' positions add up to in each axis (time, outputs)."""
    if observer.form not in ("model", "nonlinear") or not run.has_motor_positions:
        return None
    return run.motor_positions @ observer.directions.T


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
