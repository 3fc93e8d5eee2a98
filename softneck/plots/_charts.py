"""Charts of recordings, validations and loops, and some of them as matplotlib figures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, Matrix, Vector, to_si
from softneck.robot import Robot, Scaling
from softneck.signals import NECK, Recording

from ._chart import (
    ALL_MOTOR_COLOURS,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    SKY,
    Chart,
    Curve,
    Level,
    Panel,
    chart_figure,
    curve_styles,
    in_display_unit,
    least_spans,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Space between two runs that both start at zero, as a share of the whole time.
_RUN_SPACING = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Positions of rows on the time axis.

    `x`: (rows + breaks,) [s]; each segment has one more point, a sample after its last row. `breaks`: first rows of all
    segments but the first. `starts`: x of these rows. `moved`: whether segments were moved because their times overlap.
    """

    x: Vector
    breaks: np.ndarray
    starts: Vector
    moved: bool

    @property
    def x_label(self) -> str:
        """Title of the axis."""
        return "time [s], runs in sequence" if self.moved else "time [s]"

    def spread(self, values: Vector) -> Vector:
        """Return `values` (rows,) with a NaN after each segment: (rows + breaks,)."""
        return np.insert(np.asarray(values, dtype=np.float64), self.breaks, np.nan)


def timeline(time: Vector, run: np.ndarray | None = None) -> Timeline:
    """Place rows at `time` (rows,) [s], which may restart with a `run` (rows,), on a time axis that never runs back.

    A step that is no sample time starts a segment too.
    """
    time = np.asarray(time, dtype=np.float64)
    shape = time.shape if run is None else run.shape
    if time.ndim != 1 or time.size == 0 or shape != time.shape:
        raise DataError(f"a plot needs times (rows,) and runs of that shape; got {time.shape} and {shape}.")
    step = np.diff(time)
    forward = step[step > 0]
    usual = float(np.median(forward)) if forward.size else 1.0
    broken = (step > 1.5 * usual) | (step <= 0)
    if run is not None:
        broken |= np.diff(run) != 0
    breaks = np.flatnonzero(broken) + 1
    x, moved = _separate_segments(time, breaks, usual)
    return Timeline(np.insert(x, breaks, x[breaks - 1] + usual), breaks, x[breaks], moved)


def _separate_segments(time: Vector, breaks: np.ndarray, usual: float) -> tuple[Vector, bool]:
    """Move each segment that would overlap the one before it."""
    edges = [0, *breaks.tolist(), time.size]
    space = max(_RUN_SPACING * sum(time[b - 1] - time[a] for a, b in itertools.pairwise(edges)), 2 * usual)
    x, moved = time.copy(), False
    for start, stop in itertools.pairwise(edges[1:]):
        if x[start] <= x[start - 1]:
            x[start:stop] += x[start - 1] + space - x[start]
            moved = True
    return x, moved


BLACK, _BOUND_LABEL = "black", "99 % bounds"
_ZERO = Level(0.0, dashed=False)
# Smallest range of a panel in scaled outputs, 1 deg of the neck, so that noise at rest does not fill it.
_LEAST_RANGE = np.radians(1.0)
_OUTPUT_COLOURS = (BLUE, ORANGE, GREEN, SKY)


def recording_chart(recording: Recording, title: str) -> Chart:
    """Describe an experiment: set-points, held between samples, and outputs, both in display units."""
    robot, outputs = recording.robot, recording.outputs
    line = timeline(recording.time, recording.run)
    unit, drawn = robot.motors.unit, robot.outputs.display_unit
    sent = recording.set_points / to_si(unit)[0]
    motors = [
        Curve(line.x, line.spread(sent[:, j]), name.replace("_", " "), ALL_MOTOR_COLOURS[j], "step", 0.9)
        for j, name in enumerate(robot.motors.names)
    ]
    angles = [
        Curve(line.x, line.spread(in_display_unit(outputs[:, i], robot)), name, colour, width=0.9)
        for i, (name, colour) in enumerate(zip(robot.outputs.names, _OUTPUT_COLOURS, strict=False))
    ]
    borders = [Level(float(x), colour=GREY, vertical=True) for x in line.starts]
    what = "angle" if drawn == "deg" else "output"
    least = least_spans(Scaling.of(robot, set_points=recording.set_points, outputs=outputs), robot)
    panels = [
        Panel(motors, f"set-point [{unit}]", levels=borders, least_span=least[robot.set_points[0]]),
        Panel(angles, f"{what} [{drawn}]", levels=borders, least_span=least[robot.outputs.names[0]]),
    ]
    return Chart(title, panels, line.x_label)


def validation_chart(
    time: Vector,
    measured: Matrix,
    predictions: Mapping[str, Matrix],
    title: str,
    *,
    bounds: tuple[Matrix, Matrix] | None = None,
    run: np.ndarray | None = None,
    caption: str = "",
    robot: Robot = NECK,
) -> Chart:
    """Describe measured and predicted outputs, each with its error (measured - predicted) below.

    `time`: (time,) [s]. `measured`: (time, outputs) in SI; NaN for rows that are not scored. `predictions`: name ->
    (time, outputs); NaN for missing ones. `bounds`: lower and upper (time, outputs) of a model, drawn as a band. `run`:
    (time,) segment numbers, which no line connects; None breaks lines where the time jumps.
    """
    line = timeline(time, run)
    panels, unit, there = [], robot.outputs.display_unit, np.where(np.isfinite(measured).any(axis=0), measured, 0.0)
    scaling = Scaling.of(robot, outputs=there)
    least = in_display_unit(_LEAST_RANGE * scaling.output_unit, robot)
    spans = least_spans(scaling, robot)
    for i, axis in enumerate(robot.outputs.names):
        y = line.spread(in_display_unit(measured[:, i], robot))
        curves, errors = [], []
        if bounds is not None:
            lower, upper = (line.spread(in_display_unit(edge[:, i], robot)) for edge in bounds)
            curves.append(Curve(line.x, lower, "bounds", SKY, "band", upper=upper))
        curves.append(Curve(line.x, y, "measured", BLACK, width=1.2))
        for (name, values), (colour, style) in zip(predictions.items(), curve_styles(), strict=False):
            yhat = line.spread(in_display_unit(values[:, i], robot))
            curves.append(Curve(line.x, yhat, name, colour, style, 0.9))
            errors.append(Curve(line.x, y - yhat, name, colour, style, 0.8))
        limits = _range_for(y, curves, float(least[i]))
        panels.append(Panel(curves, f"{axis} [{unit}]", y_range=limits, least_span=spans[axis]))
        panels.append(Panel(errors, f"error [{unit}]", levels=(_ZERO,), legend=False, least_span=spans[axis]))
    return Chart(title, panels, line.x_label, caption=caption, row_height=1.9)


def _range_for(measured: Vector, curves: list[Curve], least: float) -> tuple[float, float] | None:
    """Return y limits for the measured values, at least `least` wide, if a curve leaves them by far; else None."""
    finite = measured[np.isfinite(measured)]
    if finite.size == 0:
        return None
    low, high = float(finite.min()), float(finite.max())
    span = max(high - low, least) or 1.0
    far = max((float(np.nanmax(np.abs(c.y), initial=0.0)) for c in curves), default=0.0)
    return (low - 0.5 * span, high + 0.5 * span) if far > max(abs(low), abs(high)) + 2.0 * span else None


def loop_chart(
    time: Vector,
    signals: Mapping[str, Vector],
    title: str,
    *,
    limits: Mapping[str, float] | None = None,
    robot: Robot = NECK,
) -> Chart:
    """Describe a closed loop: reference, true, measured and estimated outputs, motors, and tensions.

    `time`: (time,) [s]. `signals`: name -> (time,) in SI: outputs (and their _reference, _measured, _estimate),
    motor_setpoint_1..n, motor_position_1..n, tension_1..n [N]. `limits`: metric -> limit; those of overshoot and
    settling time are drawn for a step.
    """
    outputs = [signals.get(name, signals.get(f"{name}_measured", np.zeros(time.size))) for name in robot.outputs.names]
    sent = np.column_stack([signals[name] for name in robot.set_points])
    least = least_spans(Scaling.of(robot, set_points=sent, outputs=np.column_stack(outputs)), robot)
    panels = [_output_panel(time, signals, name, limits or {}, robot, least[name]) for name in robot.outputs.names]
    motors, unit = [], robot.motors.unit
    for j, (name, position) in enumerate(zip(robot.set_points, robot.motor_positions, strict=True)):
        called = _motor(robot, j)
        motors.append(Curve(time, signals[name] / to_si(unit)[0], f"set-point {called}", ALL_MOTOR_COLOURS[j], "step"))
        if position in signals:
            measured = signals[position] / to_si(unit)[0]
            motors.append(Curve(time, measured, f"position {called}", ALL_MOTOR_COLOURS[j], "dashed", 0.8))
    panels.append(Panel(motors, f"motor [{unit}]", least_span=least[robot.set_points[0]]))
    if "tension_1" in signals:
        pulls = [
            Curve(time, signals[f"tension_{j}"], f"tendon {j}", ALL_MOTOR_COLOURS[j - 1])
            for j in range(1, len(robot.motors.names) + 1)
            if f"tension_{j}" in signals
        ]
        panels.append(Panel(pulls, "tension [N]"))
    return Chart(title, panels)


def _motor(robot: Robot, number: int) -> str:
    """Return the short name of a motor for a legend."""
    return robot.motors.names[number].removeprefix("motor_").replace("_", " ")


def _output_panel(
    time: Vector, signals: Mapping[str, Vector], name: str, limits: Mapping[str, float], robot: Robot, least: float
) -> Panel:
    looks_of = (
        ("_lower", GREY, 0.7), ("_upper", GREY, 0.7), ("_measured", GREEN, 0.6), ("", BLUE, 1.4),
        ("_estimate", ORANGE, 0.9), ("_reference", BLACK, 1.0),
    )  # fmt: skip
    curves = [
        Curve(time, in_display_unit(signals[f"{name}{end}"], robot), end.strip("_") or "true", colour, width=width)
        for end, colour, width in looks_of
        if f"{name}{end}" in signals
    ]
    levels = _step_limits(time, signals.get(f"{name}_reference"), name, limits, robot)
    flat = [level.value for level in levels if not level.vertical]
    label = f"{name} [{robot.outputs.display_unit}]"
    return Panel(curves, label, levels=levels, y_range=_around(curves, flat), least_span=least)


def _around(curves: list[Curve], values: list[float]) -> tuple[float, float] | None:
    """Return y limits that include the curves and `values`; None without values."""
    if not values:
        return None
    finite = np.concatenate([*(curve.y[np.isfinite(curve.y)] for curve in curves), values])
    low, high = float(finite.min()), float(finite.max())
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _step_limits(
    time: Vector, reference: Vector | None, name: str, limits: Mapping[str, float], robot: Robot
) -> list[Level]:
    """Return lines for the limits on overshoot and settling time; none unless the reference is one step."""
    jumps = () if reference is None else np.flatnonzero(np.diff(reference))
    if reference is None or len(jumps) != 1:
        return []
    at = int(jumps[0]) + 1
    levels = []
    if (most := limits.get(f"{name}.overshoot_pct")) is not None:
        top = reference[at] + most / 100.0 * (reference[at] - reference[at - 1])
        levels.append(Level(float(in_display_unit(top, robot)), f"overshoot at most {most:g} %", RED))
    if (latest := limits.get(f"{name}.settling_s")) is not None:
        levels.append(Level(float(time[at]) + latest, f"settled after {latest:.3g} s", RED, vertical=True))
    return levels


def residual_chart(
    autocorrelation: tuple[np.ndarray, Matrix, Vector],
    cross_correlation: tuple[np.ndarray, Matrix, Matrix],
    title: str,
    *,
    caption: str = "",
    robot: Robot = NECK,
) -> Chart:
    """Describe residual tests as MATLAB's `resid` does, one column for each output.

    `autocorrelation`: of the one-step errors: lags (n,) [samples], values (outputs, n), bounds (outputs,); lag 0, which
    is 1, is not drawn. `cross_correlation`: with the motors' set-points: lags (m,) [samples], values (outputs, motors,
    m), bounds (outputs, motors).
    """
    lags, values, bounds = autocorrelation
    cross_lags, cross, cross_bounds = cross_correlation
    axes, motors = robot.outputs.names, len(robot.motors.names)
    if values.shape != (len(axes), len(lags)) or cross.shape != (len(axes), motors, len(cross_lags)):
        raise DataError(
            f"residual tests need correlations ({len(axes)}, lags) and ({len(axes)}, {motors}, lags); got "
            f"{values.shape} at {len(lags)} lags and {cross.shape} at {len(cross_lags)}."
        )
    kept = np.asarray(lags) != 0
    panels = [
        _stems(np.asarray(lags)[kept], values[i, kept], float(bounds[i]), f"{axis}: error with itself later")
        for i, axis in enumerate(axes)
    ]
    for j in range(motors):
        set_point = f"set-point {_motor(robot, j)}"
        panels += [
            _stems(cross_lags, cross[i, j], float(cross_bounds[i, j]), f"{axis}: error with {set_point} earlier")
            for i, axis in enumerate(axes)
        ]
    return Chart(title, panels, "lag [samples]", columns=len(axes), linked=False, caption=caption, row_height=1.9)


def _stems(lags: np.ndarray, values: Vector, bound: float, title: str) -> Panel:
    x = np.asarray(lags, dtype=np.float64)
    out = np.abs(values) > bound
    curves = [
        Curve(x, np.where(out, np.nan, values), "within", BLUE, "stems"),
        Curve(x, np.where(out, values, np.nan), "outside", RED, "stems"),
    ]
    levels = [Level(0.0, dashed=False)]
    if np.isfinite(bound):  # too few rows give no bound
        levels += [Level(bound, _BOUND_LABEL), Level(-bound)]
    edge = 1.15 * max(float(np.nan_to_num(bound)), float(np.nan_to_num(np.abs(values)).max(initial=0.0)), 1e-3)
    return Panel(curves, "correlation", levels=levels, title=title, legend=False, y_range=(-edge, edge))


def cover_chart(frequency: Vector, errors: Matrix, weight: Vector, title: str) -> Chart:
    """Describe relative errors of samples (n, m) under the weight (m,) over `frequency` (m,) [rad/s]."""
    curves = [
        Curve(frequency, np.maximum(row, 1e-4), "" if number else "samples", GREY, width=0.6)
        for number, row in enumerate(errors)
    ]
    curves.append(Curve(frequency, weight, "|W|", RED, width=1.6))
    panel = Panel(curves, "|G/G0 - 1|", log_x=True, log_y=True)
    return Chart(title, [panel], "frequency [rad/s]", row_height=4.0)


def frequency_response_chart(
    frequency: Vector, response: np.ndarray, radius: Vector, coherence: Vector, title: str, *, unit: str,
    models: Mapping[str, np.ndarray],
) -> Chart:  # fmt: skip
    """Describe gain, phase and coherence of one entry of a frequency response, beside models.

    All are (n,) over `frequency` [rad/s]: the complex `response` (NaN if unknown), the `radius` of its 95 % confidence
    circles, `coherence` from 0 to 1, and the complex responses of `models` by name.
    """
    size = np.abs(response)
    # A logarithmic axis has no zero, and the phase of a circle around zero is undefined.
    low, known = np.maximum(size - radius, 1e-3 * size), radius < size
    phase = np.full(response.shape, np.nan)
    phase[known] = np.degrees(np.unwrap(np.angle(response[known])))
    reach = np.degrees(np.arcsin(np.where(known, radius / size, 0.0)))
    gains = [
        Curve(frequency, low, "95 %", SKY, "band", upper=size + radius),
        Curve(frequency, size, "data", BLUE, "marked"),
    ]
    phases = [
        Curve(frequency, phase - reach, "95 %", SKY, "band", upper=phase + reach),
        Curve(frequency, phase, "data", BLUE, "marked"),
    ]
    for (name, values), colour in zip(models.items(), (ORANGE, GREEN, RED, GREY), strict=False):
        gains.append(Curve(frequency, np.abs(values), name, colour))
        phases.append(Curve(frequency, np.degrees(np.unwrap(np.angle(values))), name, colour))
    # Unknown frequencies would dominate the range.
    y_range = (0.3 * float(size[known].min()), 3.0 * float(size[known].max())) if known.any() else None
    panels = [
        Panel(gains, f"gain [{unit}]", log_x=True, log_y=True, y_range=y_range),
        Panel(phases, "phase [deg]", log_x=True, legend=False),
        Panel([Curve(frequency, coherence)], "coherence", log_x=True, y_range=(-0.05, 1.05), legend=False),
    ]
    return Chart(title, panels, "frequency [rad/s]")


def validation_figure(
    time: Vector,
    measured: Matrix,
    predictions: Mapping[str, Matrix],
    title: str,
    *,
    bounds: tuple[Matrix, Matrix] | None = None,
    run: np.ndarray | None = None,
    robot: Robot = NECK,
) -> Figure:
    """Draw `validation_chart`: measured and predicted outputs (time, outputs) in SI, each with its error below."""
    return chart_figure(validation_chart(time, measured, predictions, title, bounds=bounds, run=run, robot=robot))


_POINT_WIDTH = 1.6
_MAX_BINS = 40


def pareto_chart(
    groups: Mapping[str, tuple[Vector, Vector]],
    front: tuple[Vector, Vector],
    labels: tuple[str, str],
    title: str,
    *,
    caption: str = "",
) -> Chart:
    """Describe runs by two metrics, and their Pareto front.

    `groups` holds name -> (x, y) of its runs, of which finite ones are drawn; `front` is (x, y) by rising x.
    """
    curves = []
    for (name, (x, y)), (colour, _) in zip(groups.items(), curve_styles(), strict=False):
        known = np.isfinite(x) & np.isfinite(y)
        if known.any():
            curves.append(Curve(np.asarray(x)[known], np.asarray(y)[known], name, colour, "points", _POINT_WIDTH))
    if not curves:
        raise DataError(f"no run has both {labels[0]} and {labels[1]}.")
    curves.append(Curve(front[0], front[1], "Pareto front", RED, "marked", 1.4))
    return Chart(title, [Panel(curves, labels[1])], labels[0], caption=caption, row_height=4.0)


def distribution_chart(values: Mapping[str, Mapping[str, Vector]], title: str) -> Chart:
    """Describe distributions over runs, metric -> group -> (n,): a panel for each metric, a curve for each group."""
    panels = []
    for metric, groups in values.items():
        known = {name: np.asarray(v, float) for name, v in groups.items()}
        known = {name: v for name, v in known.items() if np.isfinite(v).any()}
        if known:
            panels.append(_shares(metric, known, legend=not panels))
    if not panels:
        raise DataError("no run has a metric to show.")
    return Chart(title, panels, linked=False, row_height=2.0)


def influence_chart(inputs: Mapping[str, Vector], metric: tuple[str, Vector], failed: np.ndarray, title: str) -> Chart:
    """Describe the influence of numeric settings on a metric: a panel for each setting, a point for each run.

    `inputs` holds key -> (n,) settings, `metric` a label and (n,) values, and `failed` (n,) marks runs that break a
    limit, which have another colour.
    """
    label, y = metric
    bad = np.asarray(failed, dtype=bool)
    panels = []
    for key, x in inputs.items():
        curves = []
        for mask, name, colour in ((~bad, "holds", BLUE), (bad, "breaks a limit", RED)):
            known = mask & np.isfinite(y) & np.isfinite(x)
            if known.any():
                curves.append(Curve(np.asarray(x, float)[known], y[known], name, colour, "points", _POINT_WIDTH))
        curves = curves or [Curve(np.zeros(0), np.zeros(0), "", GREY, "points")]
        panels.append(Panel(curves, label, x_label=key, legend=not panels))
    return Chart(title, panels, linked=False, row_height=2.0)


def pareto_figure(
    groups: Mapping[str, tuple[Vector, Vector]], front: tuple[Vector, Vector], labels: tuple[str, str], title: str
) -> Figure:
    """Draw `pareto_chart`: runs by two metrics and their Pareto front."""
    return chart_figure(pareto_chart(groups, front, labels, title))


def _shares(metric: str, groups: Mapping[str, Vector], *, legend: bool) -> Panel:
    """Return a panel with the share of each group's runs in common bins; no bin has what is not finite."""
    every = np.concatenate(list(groups.values()))
    every = every[np.isfinite(every)]
    low, high = float(every.min()), float(every.max())
    if high - low <= 1e-12 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    edges = np.linspace(low, high, int(np.clip(np.sqrt(every.size), 8, _MAX_BINS)) + 1)
    middles = 0.5 * (edges[:-1] + edges[1:])
    curves = []
    for (name, values), (colour, _) in zip(groups.items(), curve_styles(), strict=False):
        share = 100.0 * np.histogram(values[np.isfinite(values)], edges)[0] / values.size
        single = len(groups) == 1
        curves.append(Curve(middles, share, name, colour, "bars" if single else "marked"))
    return Panel(curves, "share of runs [%]", x_label=metric, legend=legend and len(groups) > 1)
