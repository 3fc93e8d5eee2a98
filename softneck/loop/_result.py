"""The result of a loop: its signals with their units, its metrics, and limits on these."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import DataError, ReprMixin, SettingsError, Vector, metric_of, require_one_of, to_si
from softneck.robot import Robot


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopResult(ReprMixin):
    """All signals of one run, named as in a recording.

    Row k has the outputs of the plant at t_k, and the outputs of observer and controller from t_k on.

    Attributes:
        time: (N,) [s].
        signals: name -> (N,), in SI; `pitch` is of the plant, `pitch_estimate` of the observer.
        units: name -> unit.
        sample_time: [s].
        robot: that was controlled.
        ended: why the run is shorter than it was meant, if a part ended it.
    """

    time: Vector
    signals: Mapping[str, Vector]
    units: Mapping[str, str]
    sample_time: float
    robot: Robot = field(default_factory=Robot.preset)
    ended: str = ""

    def summary(self) -> str:
        """Return one line on duration, step and signals."""
        length, step = len(self.time) * self.sample_time, 1e3 * self.sample_time
        return f"{length:g} s in steps of {step:g} ms, {len(self.signals)} signals of {self.robot.name}"

    def __getitem__(self, name: str) -> Vector:
        """Return one signal (N,); raise DataError with the known names if there is none."""
        try:
            return self.signals[self.robot.own(name)]
        except KeyError:
            raise DataError(f"the result has no signal `{name}`; it has {', '.join(self.signals)}.") from None

    def angle(self, axis: str, which: str = "true") -> Vector:
        """Return an output (N,), of a neck "pitch" or "roll"; if the plant has no such signal, the other `which`.

        Args:
            axis: name of the output.
            which: "true" or "measured".
        """
        names = (axis, f"{axis}_measured") if which == "true" else (f"{axis}_measured", axis)
        return self.signals[names[0]] if names[0] in self.signals else self[names[1]]


# Settling is to 5 % of the step, as in the lab's reports.
SETTLING_BAND = 0.05
# Largest deviation among some hundred samples of noise, in standard deviations.
_NOISE_SIGMAS = 4.0
# A tendon with less tension than this is slack [N]: 0.1 g, far below any pretension.
_SLACK_TENSION_N = 1e-3
# Rise time is from 10 to 90 % of the step.
_RISE_LEVELS = (0.1, 0.9)
# The steady state is the last quarter of the time after the step.
_STEADY_SHARE = 0.25

_AXIS_METRICS = ("rise_s", "settling_s", "overshoot_pct", "rms_error_deg", "iae", "ise", "itae", "steady_rms_deg")
_MOTOR_METRICS = ("max_rad", "max_rate_rad_s", "effort", "total_variation_rad", "limit_violation_s", "slack_s")
Metrics = dict[str, dict[str, float | None]]


def shows_settling(noise: float, size: float) -> bool:
    """Return whether a sensor's noise (standard deviation) stays within the settling band of a step of a size."""
    return _NOISE_SIGMAS * noise <= SETTLING_BAND * size


def metrics(result: LoopResult, *, angle: str = "true") -> Metrics:
    """Return the metrics of a run: a table each for `pitch`, `roll` and `motors`, `validity` of an identified plant.

    For an axis:

    - `rise_s`: from 10 to 90 % of the step [s], first samples at or above; `settling_s`: from the step to the
      first sample from which the error stays below 5 % of it [s]; `overshoot_pct`: of the step, zero if none.
      All three are None unless the reference is one step, and where the level is never reached.
    - `rms_error_deg`, `iae` [rad s], `ise` [rad^2 s]: of reference minus output, over the whole run.
    - `itae` [rad s^2]: the error's size times the time since the step (since the start without one).
    - `steady_rms_deg`: rms error over the last quarter of the time after the step (of the run without one).

    For the motors, of the set-points: `max_rad`, `max_rate_rad_s` between samples, `effort` = integral of
    P1^2 + P2^2 + P3^2 [rad^2 s], `total_variation_rad` = sum of all moves, `limit_violation_s` = time with a
    set-point beyond 6 rad [s]; `slack_s` = time with a tendon without tension [s], None where no tension is known.

    `validity.min` is the minimum of the plant's output `validity`, if it has one.

    Another robot has a table for each of its outputs. Metrics in deg and rad above have the display unit of its outputs
    and the unit of its motors, also in their names (`rms_error_mm`, `max_bar`); angles stay in deg.

    Args:
        result: of a run.
        angle: "true" (measured if the plant has no true one) or "measured"; missing samples are left out.

    Raises:
        SettingsError: another `angle`.
    """
    require_one_of("angle", angle, ("true", "measured"))
    robot = result.robot
    unit = robot.motors.unit
    P = np.column_stack([result[name] for name in robot.set_points]) / to_si(unit)[0]
    moves = np.abs(np.diff(P, axis=0))
    return {
        **{name: _axis_metrics(result, name, angle) for name in robot.outputs.names},
        "motors": {
            f"max_{_word(unit)}": float(np.abs(P).max()),
            f"max_rate_{_word(unit)}_s": float(moves.max(initial=0.0)) / result.sample_time,
            "effort": float(np.sum(P**2) * result.sample_time),
            f"total_variation_{_word(unit)}": float(moves.sum()),
            "limit_violation_s": float(_outside_range(P, robot) * result.sample_time),
            "slack_s": _slack(result),
        },
        # Only an identified plant has it.
        **({"validity": {"min": float(result["validity"].min())}} if "validity" in result.signals else {}),
    }


def metric_names(robot: Robot) -> tuple[str, ...]:
    """Return the names of all metrics of a robot's loops, as in [limits]."""
    unit, motor = error_unit(robot)[0], _word(robot.motors.unit)
    ends = [name.removesuffix("_deg") + f"_{unit}" if name.endswith("_deg") else name for name in _AXIS_METRICS]
    moved = [name.replace("_rad", f"_{motor}") for name in _MOTOR_METRICS]
    return (*(f"{axis}.{end}" for axis in robot.outputs.names for end in ends), *(f"motors.{name}" for name in moved))


def _outside_range(P: np.ndarray, robot: Robot) -> int:
    """Return the number of rows with a set-point (time, motors) outside the range of its motor."""
    low, high = robot.motors.setpoint_min, robot.motors.setpoint_max
    if low is None or high is None:
        return 0
    rounding = 1e-9 * np.abs([low, high]).max()
    inside = (np.array(low) - rounding <= P) & (np.array(high) + rounding >= P)
    return int((~inside).any(axis=1).sum())


def _word(unit: str) -> str:
    """Return a unit as the end of a name."""
    return unit.replace("/", "_")


def check_limits(values: Mapping[str, Any], limits: Mapping[str, float]) -> list[dict[str, Any]]:
    """Compare metrics with limits named as in a loop file, such as "pitch.overshoot_pct" or "validity.min".

    The limit of a validity is a lower one; all others are upper ones.

    Returns:
        For each limit {"metric", "limit", "value", "holds"}; a metric that is None does not hold.

    Raises:
        SettingsError: no such metric, or a limit that is not a number.
    """
    known = {f"{group}.{name}": value for group, table in values.items() for name, value in table.items()}
    rows = []
    for name, limit in limits.items():
        if name == "validity.min" and name not in known:
            raise SettingsError("limit on `validity.min`, but the plant has no output `validity`: identify a model.")
        if name not in known:
            raise SettingsError(f"limit on unknown metric `{name}`; use one of {', '.join(known)}.")
        if isinstance(limit, bool) or not isinstance(limit, int | float) or math.isnan(limit):
            raise SettingsError(f"the limit of `{name}` must be a number; got {limit!r}.")
        value = known[name]
        holds = value is not None and (value >= limit if metric_of(name).larger else value <= limit)
        rows.append({"metric": name, "limit": float(limit), "value": value, "holds": bool(holds)})
    return rows


def _axis_metrics(result: LoopResult, axis: str, angle: str) -> dict[str, float | None]:
    r, y = result[f"{axis}_reference"], result.angle(axis, angle)
    step = _find_step(r)
    if step is not None and step[0] == 0:
        outputs = result.robot.outputs
        at = outputs.names.index(axis)
        rest = float(_fill_missing(y)[0]) if outputs.rest is None else to_si(outputs.unit)[0] * outputs.rest[at]
        step = (0, rest, step[2])
    first = 0 if step is None else step[0]
    error = r - y
    # Missing samples are NaN; an infinite one is an error without bound.
    known = ~np.isnan(error)
    tail = error[first + math.floor((1.0 - _STEADY_SHARE) * (r.size - first)) :]
    shape: dict[str, float | None] = {"rise_s": None, "settling_s": None, "overshoot_pct": None}
    if step is not None and known[step[0] :].any() and step[2] != step[1]:
        k, low, high = step
        response = (y[k:] - low) / (high - low)
        shape = _step_shape(_fill_missing(response), result.sample_time)
    size, since = np.abs(error[known]), result.time[known] - result.time[first]
    unit, factor = error_unit(result.robot)
    integrals = {"iae": size, "ise": size**2, "itae": size[since > 0.0] * since[since > 0.0]}
    return {
        **shape,
        f"rms_error_{unit}": _rms(error, factor),
        **{name: float(np.sum(part) * result.sample_time) if size.size else None for name, part in integrals.items()},
        f"steady_rms_{unit}": _rms(tail, factor),
    }


def _fill_missing(y: Vector) -> Vector:
    """Return `y` (n,) with missing samples filled by the last known one, at the start by the first known one."""
    known = np.flatnonzero(~np.isnan(y))
    return y[known[np.maximum(np.searchsorted(known, np.arange(y.size), side="right") - 1, 0)]]


def _slack(result: LoopResult) -> float | None:
    motors = range(1, len(result.robot.motors.names) + 1)
    names = [f"tension_{j}" for j in motors if f"tension_{j}" in result.signals]
    if not names:
        return None
    slack = ~np.all([result[name] > _SLACK_TENSION_N for name in names], axis=0)
    return float(slack.sum() * result.sample_time)


def _find_step(r: Vector) -> tuple[int, float, float] | None:
    """Return (row, level before, level after) if the reference makes exactly one step, else None.

    A constant reference other than zero is a step from zero at the first row.
    """
    jumps = np.flatnonzero(np.diff(r))
    if jumps.size == 0:
        return (0, 0.0, float(r[0])) if r[0] != 0.0 else None
    if jumps.size == 1 and jumps[0] + 2 < r.size:
        k = int(jumps[0]) + 1
        return k, float(r[0]), float(r[k])
    return None


def _step_shape(y: Vector, sample_time: float) -> dict[str, float | None]:
    """Return rise, settling and overshoot of a response `y` (n,) to a step from 0 to 1."""
    if not np.isfinite(y).all():
        return {"rise_s": None, "settling_s": None, "overshoot_pct": None}
    low, high = (np.flatnonzero(y >= level) for level in _RISE_LEVELS)
    outside = np.flatnonzero(np.abs(y - 1.0) >= SETTLING_BAND)
    settled = 0 if outside.size == 0 else int(outside[-1]) + 1
    return {
        "rise_s": float(high[0] - low[0]) * sample_time if high.size else None,
        "settling_s": settled * sample_time if settled < y.size else None,
        "overshoot_pct": max(0.0, 100.0 * (float(y.max()) - 1.0)),
    }


def error_unit(robot: Robot) -> tuple[str, float | None]:
    """Return the unit of errors as the end of a name, and its factor to SI; "deg" and None for angles."""
    factor, si = to_si(robot.outputs.display_unit)
    return ("deg", None) if si == "rad" else (_word(robot.outputs.display_unit), factor)


def _rms(error: Vector, factor: float | None) -> float | None:
    known = error[~np.isnan(error)]
    if not known.size:
        return None
    rms = math.sqrt(float(np.mean(known**2)))
    return math.degrees(rms) if factor is None else rms / factor
