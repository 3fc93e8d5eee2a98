"""The page of a closed loop, which plays: one slider moves the outputs beside the signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np

from softneck.core import METRICS, metric_of, to_si
from softneck.cosim import Result
from softneck.plots import Chart, Level, Script, Section, Table, cell, in_display_unit, loop_chart, page

# Positions of the slider; longer runs skip rows.
_MAX_FRAMES = 1_500
# [s] A run of another length is played in this time.
_PLAYED_S = (4.0, 30.0)
_CURSOR = Level(0.0, colour="#3b7dd8", dashed=False, vertical=True)


def loop_page(name: str, result: Result, *, faults: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return the HTML page of a simulated loop; `faults` are as from `fault_values`."""
    time, robot = result.signals.time, result.robot
    chart = loop_chart(time, result.signals.signals, "Reference, outputs and motors", limits=result.bounds, robot=robot)
    values = player_values(result, chart, faults)
    chart = replace(chart, panels=[replace(panel, levels=(*panel.levels, _CURSOR)) for panel in chart.panels])
    what = "angle" if to_si(robot.outputs.unit)[1] == "rad" else "output"
    method = [
        "Play or move the slider: outputs and the upright line follow. The strip below it marks faults (purple), times "
        "of limits (black) and where an overshoot exceeds its limit (red).",
        f"Order {result.order}, metrics of the {result.angle} {what}, {result.real_time_factor:,.1f} times real time.",
    ]
    tables = [Table("Metrics", ["metric", "value"], _metrics(result))]
    if result.limits:
        tables.insert(0, Table("Limits", ["metric", "value", "limit", "verdict"], _limits(result)))
    parts = (files("softneck.report").joinpath(f"_loop.{end}").read_text(encoding="utf-8") for end in ("html", "js"))
    html, script = parts
    return page(
        "Closed loop" if name == "loop" else f"Closed loop: {name.replace('_', ' ')}",
        [Section("Response", charts=[chart], tables=tables, method=method, html=html)],
        verdict=loop_decision(result.limits), holds=result.holds if result.limits else None,
        footer="Written by softneck simulate.", script=Script(script, values),
    )  # fmt: skip


def fault_values(faults: Sequence[Any]) -> list[dict[str, Any]]:
    """Return the JSON values of faults: kind, start [s], and end [s], None for the rest of the run."""
    return [
        {"kind": one.kind, "start_s": one.start,
         "end_s": one.start + one.duration if np.isfinite(one.duration) else None}
        for one in faults
    ]  # fmt: skip


def loop_decision(limits: Sequence[Mapping[str, Any]]) -> str:
    """Return the decision on a loop, from `limits` of its JSON."""
    if not limits:
        return "The loop file states no limits, so nothing was judged; add [limits] to judge it."
    broken = [row for row in limits if not row["holds"]]
    if broken:
        each = "; ".join(f"{_title(row['metric'])} {_value(row)}, limit {row['limit']:.4g}" for row in broken)
        return f"Do not run this loop: {len(broken)} of {len(limits)} limits broken: {each}."
    upper = [row for row in limits if row["metric"] != "validity.min" and row["limit"]] or list(limits)
    nearest = max(upper, key=lambda row: row["value"] / row["limit"] if row["limit"] else 0.0)
    count = f"all {len(limits)} limits hold" if len(limits) > 1 else "the limit holds"
    return (
        f"In this run {count}; the nearest is {_title(nearest['metric'])}, {_value(nearest)} of {nearest['limit']:.4g}."
    )


def _title(metric: str) -> str:
    """Return a metric in words: "settling time of pitch (pitch.settling_s)"."""
    part, _, name = metric.rpartition(".")
    known = any(f"{name}_".startswith(f"{key}_") for key in METRICS)
    if not known:
        return metric
    title = metric_of(metric).title
    return f"{title}{'' if title.endswith(part) else f' of {part}'} ({metric})"


def _value(row: Mapping[str, Any]) -> str:
    return "not reached" if row["value"] is None else f"{row['value']:.3g}"


def _metrics(result: Result) -> list[list[str]]:
    return [
        [_title(f"{part}.{name}"), cell(value, ".3f")]
        for part, values in result.metrics.items() for name, value in values.items()
        if name != "slack_s" or result.robot.tendon_angles is not None
    ]  # fmt: skip


def _limits(result: Result) -> list[list[str]]:
    return [
        [_title(row["metric"]), cell(row["value"], ".3f"), f"{row['limit']:.4g}", "holds" if row["holds"] else "fails"]
        for row in result.limits
    ]


def player_values(result: Result, chart: Chart, faults: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the values that the page plays: outputs in display units over time, and marks on the time line."""
    time, signals, robot = result.signals.time, result.signals.signals, result.robot
    every = slice(None, None, max(1, -(-time.size // _MAX_FRAMES)))
    outputs = []
    for i, name in enumerate(robot.outputs.names):
        y = in_display_unit(result.signals.angle(name), robot)
        r = signals.get(f"{name}_reference")
        shown = None if r is None else in_display_unit(r, robot)
        low, high = _range(robot.outputs, i, y if shown is None else np.concatenate([y, shown]))
        outputs.append({"name": name, "unit": robot.outputs.display_unit, "value": _numbers(y[every]), "low": low,
                        "high": high, "reference": None if shown is None else _numbers(shown[every])})  # fmt: skip
    length = float(time[-1] - time[0]) if time.size > 1 else 1.0
    return {
        "time": _numbers(time[every]), "outputs": outputs,
        "bends": robot.directions.kind == "tendons" and to_si(robot.outputs.unit)[1] == "rad",
        "marks": [*_fault_marks(faults, float(time[-1])), *_limit_marks(result, chart)],
        "pace": length / min(max(length, _PLAYED_S[0]), _PLAYED_S[1]),
    }  # fmt: skip


def _range(outputs: Any, number: int, values: np.ndarray) -> tuple[float, float]:
    """Return the ends of an output's bar: its range in the robot file if it is stated, else that of the run."""
    factor = to_si(outputs.unit)[0] / to_si(outputs.display_unit)[0]
    ends = () if outputs.min is None or outputs.max is None else (outputs.min, outputs.max)
    stated = [factor * float(np.broadcast_to(end, len(outputs.names))[number]) for end in ends]
    seen = values[np.isfinite(values)]
    low, high = (min(0.0, *seen, *stated[:1]), max(0.0, *seen, *stated[1:])) if seen.size else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


def _numbers(values: np.ndarray) -> list[float | None]:
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values.tolist()]


def _fault_marks(faults: Sequence[Mapping[str, Any]], last: float) -> list[dict[str, Any]]:
    return [
        {"kind": "fault", "label": f"fault: {one['kind'].replace('_', ' ')}", "start": one["start_s"],
         "end": last if one["end_s"] is None else min(one["end_s"], last)}
        for one in faults if one["start_s"] <= last
    ]  # fmt: skip


def _limit_marks(result: Result, chart: Chart) -> list[dict[str, Any]]:
    """Return the times of limits, and the time in which an output is beyond the limit of its overshoot."""
    time, marks = result.signals.time, []
    for name, panel in zip(result.robot.outputs.names, chart.panels, strict=False):
        y = in_display_unit(result.signals.angle(name), result.robot)
        for level in panel.levels:
            if level.vertical:
                marks.append({"kind": "limit", "label": f"limit: {name} {level.label}", "start": level.value,
                              "end": level.value})  # fmt: skip
                continue
            reference = in_display_unit(result.signals.signals[f"{name}_reference"], result.robot)
            rising = level.value > reference[0]
            beyond = np.flatnonzero((y > level.value) if rising else (y < level.value))
            for rows in np.split(beyond, np.flatnonzero(np.diff(beyond) > 1) + 1) if beyond.size else ():
                marks.append({"kind": "broken", "label": f"broken: {name} {level.label}", "start": float(time[rows[0]]),
                              "end": float(time[rows[-1]])})  # fmt: skip
    return marks
