"""Make an observer over a model, and fit its noise levels, dead time and sensor delay to recordings."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, make_settings
from softneck.identification import Model, known_rows
from softneck.robot import Robot, load_for_robot
from softneck.signals import Recording, RecordingLike, concatenate, open_recording

from ._axis import HasTransferFunctions, robot_of
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_LEAD, KALMAN_MORE_LAGS, kalman_lag
from ._noise import NoiseFit, cost_of, fit_noise, look_ahead_error
from ._nonlinear import NonlinearObserver, is_nonlinear
from ._offline import measured_angles
from ._settings import KalmanSettings, find_sensor

AnyObserver = KalmanObserver | NonlinearObserver

# Part of each run that is fitted to; the rest is held out.
_FIT_SHARE = 0.7
# Largest dead time tried beyond the model's own [samples].
_MAX_EXTRA_DELAY = 8
# The sensor's delay is searched up to 0.2 s in quarters of a sample, from changes over five samples.
_MAX_DELAY_S, _STEPS_PER_SAMPLE, _CHANGE_SAMPLES = 0.2, 4, 5
# Share of the changes that the reference must explain for its delay to be accepted.
_MIN_EXPLAINED_SHARE = 0.8


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FittedObserver:
    """The best candidate on the rows held out.

    kept: "default", "noise" or "noise and delay"; checks: candidate -> look-ahead error [SI]; fit: of the noise levels;
    rows: held out.
    """

    observer: AnyObserver
    kept: str
    checks: dict[str, float]
    fit: NoiseFit
    not_identifiable: tuple[str, ...]
    rows: int


def fit_levels_and_delays(
    observer: AnyObserver, recordings: Sequence[Recording], *, fixed: Sequence[str] = (), delay: bool = True
) -> FittedObserver:
    """Return the observer of maximum likelihood, or the given one if that is better on rows held out.

    Noise levels, and in form "model" the dead time of the set-points, are fitted to the first 70 % of each run.
    Set-points and angles determine only the sum of drive and sensor delay; `estimate_sensor_delay` uses motor positions
    and rates. The errors of a nonlinear model are not fitted to its own training rows. All candidates are compared by
    `look_ahead_error` on the other 30 %. `fixed`: noise levels that stay as they are.
    """
    parts = [recording.split(_FIT_SHARE) for recording in recordings]
    heads, rest = [head for head, _ in parts], concatenate([tail for _, tail in parts])
    unseen = () if not isinstance(observer, NonlinearObserver) else _levels_not_identifiable(observer, recordings)
    if unseen and observer.noise_names[0] in fixed:
        raise SettingsError(
            "the model was trained on these rows: they determine only the sensor's noise, and that is given; "
            "use a recording that the model was not trained on."
        )
    fixed = (*fixed, *unseen)
    lead, source = estimate_sensor_delay(observer, heads) if delay else (None, "")
    start = observer if lead is None else _with_sensor_delay(observer, lead, source)
    fit = fit_noise(start, heads, fixed=fixed)
    candidates = {"default": observer, "noise": fit.observer.with_constants(observer.constants)}
    # A nonlinear model's dead time is its own.
    later = most_likely_extra_delay(fit.observer, heads) if observer.form == "model" and delay else 0
    if later:
        fit = fit_noise(with_extra_delay(start, later), heads, fixed=fixed)
    if later or lead is not None:
        candidates["noise and delay"] = fit.observer
    not_identifiable = (*fit.at_bound, *unseen, *(("sensor_delay",) if lead is None else ()))
    # All candidates are compared at the same delay of the sensor.
    checks = {name: look_ahead_error(item, rest, start.lead) for name, item in candidates.items()}
    kept = min(checks, key=lambda name: checks[name])
    return FittedObserver(
        observer=candidates[kept], kept=kept, checks=checks, fit=fit, not_identifiable=not_identifiable, rows=len(rest)
    )


def _levels_not_identifiable(observer: NonlinearObserver, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the levels that the model's own training rows do not determine: its errors are too small there."""
    seen = observer.model.training_rows
    return observer.noise_names[1:] if any(known_rows(item, seen).any() for item in recordings) else ()


def with_extra_delay(observer: AnyObserver, later: int) -> AnyObserver:
    """Return the filter whose set-points act some samples later."""
    constants = observer.constants.copy()
    constants[KALMAN_LAG : KALMAN_LAG + 2] += later
    constants[KALMAN_MORE_LAGS:] += later
    return observer.with_constants(constants)


def _with_sensor_delay(observer: AnyObserver, lead: float, source: str) -> AnyObserver:
    """Return the filter for a sensor that is `lead` [s] late."""
    constants = observer.constants.copy()
    if observer.form == "gyro":
        # Only the angles get later: the delay of the rates does not change.
        constants[KALMAN_LAG : KALMAN_LAG + 2] += lead / observer.sample_time - constants[KALMAN_LEAD]
        constants[KALMAN_MORE_LAGS:] += lead / observer.sample_time - constants[KALMAN_LEAD]
    constants[KALMAN_LEAD] = lead / observer.sample_time
    return replace(observer.with_constants(constants), delay_source=source)


def most_likely_extra_delay(observer: AnyObserver, recordings: Sequence[Recording]) -> int:
    """Return the dead time beyond the model's [samples] of maximum likelihood at the present levels."""
    runs = [run for recording in recordings for run in recording.runs()]
    level = np.log10(observer.noise)
    return int(
        np.argmin([cost_of(with_extra_delay(observer, later), runs).of(level) for later in range(_MAX_EXTRA_DELAY + 1)])
    )


def estimate_sensor_delay(observer: AnyObserver, recordings: Sequence[Recording]) -> tuple[float | None, str]:
    """Return the delay of the angles [s], None if unknown, and its source: "gyro" or "motor positions".

    A gyro may be late itself, so it gives only the difference, and its own delay is added. Motor positions give an
    upper bound, because the link lags as well: it is used if it is below the filter's value.
    """
    runs = [run for recording in recordings for run in recording.runs()]
    source, reference = (
        ("gyro", _integrate_gyro) if observer.form == "gyro" else ("motor positions", _project_motor_positions)
    )
    pairs = [(measured_angles(run), reference(observer, run)) for run in runs]
    known = [(z, way) for z, way in pairs if way is not None]
    lag = _estimate_lag(known, observer.sample_time) if known else None
    if lag is None or (observer.form != "gyro" and lag >= observer.lead):
        return None, ""
    if observer.form == "gyro":
        # In the filter the rates act half a sample ago, plus their lead over the angles.
        newer = (kalman_lag(observer.constants, 0) - 0.5) * observer.sample_time
        lag += max(observer.lead - newer, 0.0)
    return lag, source


def _integrate_gyro(observer: AnyObserver, run: Recording) -> Matrix | None:
    """Return the integral of the gyro's rates (time, outputs); None without a gyro."""
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


def _project_motor_positions(observer: AnyObserver, run: Recording) -> Matrix | None:
    """Return the redefined inputs (time, outputs) from motor positions; None where they were not logged."""
    if observer.form not in ("model", "nonlinear") or not run.has_motor_positions:
        return None
    return run.motor_positions @ observer.directions.T


def _estimate_lag(pairs: Sequence[tuple[Matrix, Matrix]], period: float) -> float | None:
    """Return the lag of the angles' changes [s] after the reference's; None if it explains too little."""
    lags = np.arange(0, round(_MAX_DELAY_S / period * _STEPS_PER_SAMPLE) + 1) / _STEPS_PER_SAMPLE
    missed = [_unexplained_share(pairs, float(lag)) for lag in lags]
    best = int(np.argmin(missed))
    if best == len(lags) - 1 or missed[best] > 1.0 - _MIN_EXPLAINED_SHARE:
        return None
    return float(lags[best]) * period


def _unexplained_share(pairs: Sequence[tuple[Matrix, Matrix]], lag: float) -> float:
    """Return the share of the angles' changes that the reference `lag` samples before does not explain."""
    left, whole = 0.0, 0.0
    for axis in range(pairs[0][0].shape[1]):
        changes = [(_difference(z[:, axis]), _difference(_delay_by(way[:, axis], lag))) for z, way in pairs]
        y, x = (np.concatenate(parts) for parts in zip(*changes, strict=True))
        known = np.isfinite(y) & np.isfinite(x)
        y, x = y[known] - np.mean(y[known]), x[known] - np.mean(x[known])
        left += float(y @ y) - float(x @ y) ** 2 / max(float(x @ x), 1e-300)
        whole += float(y @ y)
    return left / whole if whole > 0.0 and math.isfinite(whole) else 1.0


def _difference(values: Vector) -> Vector:
    return values[_CHANGE_SAMPLES:] - values[:-_CHANGE_SAMPLES]


def _delay_by(values: Vector, lag: float) -> Vector:
    rows = np.arange(len(values), dtype=float)
    return np.interp(rows - lag, rows, values)


def observer(
    model: Model | HasTransferFunctions | str | Path,
    *,
    data: RecordingLike | None = None,
    robot: Robot | str | Path | None = None,
    **settings: Any,
) -> AnyObserver:
    """Return a Kalman filter over a linear model; over a nonlinear one, its simulation with a disturbance estimate.

    Args:
        model: an identified model or its file, or any object with `tf` of each output.
        data: recordings for the noise levels (maximum likelihood), as `softneck.identify` takes them.
        robot: None reads `robot.toml` beside a file or above it, else what the files say.
        **settings: those of `KalmanSettings`, for instance `form="gyro"`.

    Raises:
        SettingsError: an unknown setting, or a model that it cannot be built on.
        FileFormatError: no such file, or no model.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> softneck.observer(softneck.identify("rls", recording)).block().kind
        'kalman'
    """
    made = design_observer(make_settings(KalmanSettings, settings), model, robot)
    if data is None:
        return made
    parts = data if isinstance(data, list | tuple) else [data]
    return fit_observer(made, [open_recording(part, robot) for part in parts], settings).observer


def design_observer(settings: KalmanSettings, model: Any, robot: Robot | str | Path | None) -> AnyObserver:
    """Return the observer with the noise levels of its settings, sensor and robot.

    It predicts over the delay of the sensor, else of the robot's file: set-points and angles determine only the sum of
    the drives' delay and the sensor's. `KalmanSettings.design` leaves that out over a linear model.
    """
    known = load_for_robot(model, None if hasattr(model, "tf") else "model", robot)
    if settings.sensor_delay is not None or settings.form != "model" or is_nonlinear(known):
        return settings.design(known)
    usual = find_sensor(settings.sensor).delay
    delay = robot_of(known).delay_s if usual is None else usual
    made = replace(settings, sensor_delay=delay).design(known)
    return replace(made, delay_source="robot" if usual is None else "sensor") if delay else made


def fit_observer(made: AnyObserver, recordings: list[Recording], named: Collection[str]) -> FittedObserver:
    """Fit an observer to recordings; settings of the sensor that the user `named` stay as they are."""
    fixed = (made.noise_names[0],) if "sensor" in named else ()
    return fit_levels_and_delays(made, recordings, fixed=fixed, delay="sensor_delay" not in named)
