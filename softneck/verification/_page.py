"""The page of a verification: the verdict, then charts and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from softneck.core import Vector, to_si
from softneck.loop import error_unit
from softneck.plots import BLUE, GREEN, GREY, ORANGE, Chart, Curve, Level, Panel, Section, Table, cell, page

from ._decision import certificate_decision, certificate_values
from ._evidence import Evidence, LinearEvidence
from ._linear import inverse, loops
from ._metrics import Scale, metric_title
from ._neck_loops import LoopRun, direction
from ._plants import Plants, mixing_matrix
from ._steps import Steps
from ._verify import Verdict, Verification

RED, PURPLE = "#D55E00", "#CC79A7"
# Colours of up to 8 motors.
SERIES = (BLUE, ORANGE, GREEN, PURPLE, RED, GREY, "#56B4E9", "#F0E442")
# Responses in an envelope; more would not be visible.
_MAX_CURVES = 240
_FREQUENCY_LABEL = "frequency [rad/s]"
_CAPTION = (
    f"Band: an even choice of up to {_MAX_CURVES} plants; black: nominal; red: the plant with the least disk margin."
)
# Larger numbers in SI diverge: pressures have some 1e6 Pa.
_LARGEST_DRAWN = 1e9


def frequency_charts(part: LinearEvidence, w: Vector, gain: str = "rad/rad") -> list[Chart]:
    """Return Bode envelopes and the gang of four of each axis; `gain` is the SI unit of static gains."""
    back = "/".join(reversed(gain.split("/")))
    rows = _select_rows(part)
    P, L = loops(part.plants.take(rows), part.law, w)
    S = inverse(np.eye(len(part.plants.axes)) + L)
    PS, CS = S @ P, -part.law.feedback(w) @ S
    charts = [_bode(part, rows, S, w)]
    for i, axis in enumerate(part.plants.axes):
        own = S[..., i, i]
        gang = {
            "|S|, from load at the output": np.abs(own),
            "|T|, from reference to output": np.abs(1.0 - own),
            f"|PS|, from load at the input [{gain}]": np.abs(PS[..., i, i]),
            f"|CS|, from noise to input [{back}]": np.abs(CS[..., i, i]),
        }
        worst = _worst_in(part, rows, f"{axis}.disk_margin")
        panels = [_envelope(w, values, name, worst) for name, values in gang.items()]
        charts.append(_frequency_chart(f"Gang of four: {axis}", panels))
    return charts


def _frequency_chart(title: str, panels: list[Panel]) -> Chart:
    return Chart(title, panels, _FREQUENCY_LABEL, columns=2, row_height=2.6, caption=_CAPTION)


def _select_rows(part: LinearEvidence) -> np.ndarray:
    """Return the drawn rows: the first, an even choice, and the worst ones."""
    n = len(part.plants)
    rows = np.unique(np.linspace(0, n - 1, min(n, _MAX_CURVES)).astype(int))
    worst = [int(np.argmin(part.margins[f"{axis}.disk_margin"])) for axis in part.plants.axes]
    return np.unique(np.concatenate([[0], rows, worst]))


def _worst_in(part: LinearEvidence, rows: np.ndarray, metric: str) -> int:
    return int(np.argmin(part.margins[metric][rows]))


def _bode(part: LinearEvidence, rows: np.ndarray, S: np.ndarray, w: Vector) -> Chart:
    panels = []
    for i, axis in enumerate(part.plants.axes):
        L = 1.0 / S[..., i, i] - 1.0
        worst = _worst_in(part, rows, f"{axis}.disk_margin")
        phase = np.degrees(np.unwrap(np.angle(L), axis=1))
        # Start all near the phase of an integrator.
        phase -= 360.0 * np.round((phase[:, :1] + 90.0) / 360.0)
        panels.append(_envelope(w, np.abs(L), f"|L| of {axis}", worst, level=1.0))
        panels.append(
            _envelope(w, phase, f"phase of {axis} [deg]", worst, level=-180.0, log=False, y_range=(-540.0, 30.0))
        )
    return _frequency_chart("Bode envelopes of the open loops", panels)


def _envelope(
    w: Vector, values: np.ndarray, label: str, worst: int, *, level: float | None = None, log: bool = True,
    y_range: tuple[float, float] | None = None,
) -> Panel:  # fmt: skip
    shown = np.maximum(values, 1e-6) if log else values
    curves = [
        Curve(w, shown.min(axis=0), "all plants", "#56B4E9", "band", upper=shown.max(axis=0)),
        Curve(w, shown[worst], "worst", RED, width=1.2),
        Curve(w, shown[0], "nominal", "black", width=1.2),
    ]
    levels = () if level is None else (Level(level),)
    if log and y_range is None:
        top = float(shown.max())
        y_range = (max(float(shown.min()), 1e-3 * min(top, 1.0)), 1.3 * top)
    return Panel(curves, label, levels=levels, log_x=True, log_y=log, y_range=y_range)


def mu_charts(part: LinearEvidence) -> list[Chart]:
    """Return the bounds of the structured singular value over frequency, where they are finite."""
    panels, levels = [], [Level(1.0, "certain below", RED)]
    for row in (row for rows in part.structured for row in rows if np.isfinite(row.upper).all()):
        curves = [Curve(row.frequency, row.upper, "upper bound", BLUE, width=1.4)]
        top = max(1.1, 1.1 * row.mu)
        panels.append(Panel(curves, f"mu, {row.axes}", levels=levels, log_x=True, y_range=(0.0, top)))
    title = "Structured singular value for stability of the box"
    return [Chart(title, panels, _FREQUENCY_LABEL, row_height=2.4)] if panels else []


def step_chart(steps: Steps, plants: Plants, scale: Scale) -> Chart:
    """Return the steps of all plants with the worst ones, and its motors."""
    t = steps.time
    panels = []
    finite: np.ndarray = np.asarray(np.isfinite(steps.angles).all(axis=2))
    worst = int(np.argmax(steps.metrics["overshoot_pct"]))
    axis_of = int(steps.worse["overshoot_pct"][worst])
    robot, shown, unit = scale.robot, scale.shown, error_unit(scale.robot)[0]
    for i, axis in enumerate(plants.axes):
        y = shown(steps.angles[i][finite[i]]) if finite[i].any() else np.zeros((1, t.size))
        row = worst if i == axis_of else int(np.argmax(np.where(finite[i], np.max(steps.angles[i], axis=1), -np.inf)))
        settling = int(np.argmax(steps.metrics["load_rms_deg"]))
        curves = [
            Curve(t, y.min(axis=0), "all plants", "#56B4E9", "band", upper=y.max(axis=0)),
            Curve(t, shown(_drawable(steps.angles[i, settling])), "worst under the load", ORANGE),
            Curve(t, shown(_drawable(steps.angles[i, row])), "worst overshoot", RED, width=1.2),
            Curve(t, shown(_drawable(steps.angles[i, 0])), "nominal", "black", width=1.2),
        ]
        panels.append(Panel(curves, f"{axis} [{unit}]"))
    per = to_si(robot.motors.unit)[0]
    motors = [
        Curve(t, _drawable(steps.motors[axis_of, worst, :, j]) / per, f"motor {j + 1}", colour, "step")
        for j, colour in zip(range(len(robot.motors.names)), SERIES, strict=False)
    ]
    panels.append(Panel(motors, f"set-point [{robot.motors.unit}]", title=f"motors on {plants.names[worst]}"))
    return Chart("Steps against every plant, then a load", panels, row_height=2.6)


def _drawable(y: Vector) -> Vector:
    """Replace values that are too large to draw by NaN."""
    return np.where(np.isfinite(y) & (np.abs(y) < _LARGEST_DRAWN), y, np.nan)


def neck_chart(evidence: Evidence, scale: Scale) -> Chart:
    """Return the outputs of all simulated loops along the step, with the worst ones."""
    runs = [run for run in evidence.necks if run.result is not None]
    if not runs:
        raise ValueError("no simulated loop came to its end")
    worst = max(runs, key=lambda run: run.metrics["overshoot_pct"])
    slow = max(runs, key=lambda run: run.metrics["settling_s"])
    along = {id(run): scale.shown(_output_along_step(run)) for run in runs}
    table = np.array(list(along.values()))
    t = runs[0].result.time if runs[0].result is not None else np.zeros(0)
    curves = [
        Curve(t, table.min(axis=0), "all loops", "#56B4E9", "band", upper=table.max(axis=0)),
        Curve(t, along[id(slow)], f"slowest: {slow.name}", ORANGE),
        Curve(t, along[id(worst)], f"largest overshoot: {worst.name}", RED, width=1.2),
        Curve(t, table[0], runs[0].name, "black", width=1.2),
    ]
    title, unit = f"Steps of the virtual {scale.robot.name}", error_unit(scale.robot)[0]
    return Chart(title, [Panel(curves, f"true output along the step [{unit}]")], row_height=3.4)


def _output_along_step(run: LoopRun) -> Vector:
    if run.result is None:
        return np.zeros(0)
    robot = run.result.robot
    shares = zip(direction(run.orientation, robot), robot.outputs.names, strict=True)
    return np.asarray(np.sum([share * run.result.angle(name) for share, name in shares], axis=0))


_BOUNDS = {"min": ">=", "max": "<=", "below": "<"}


def verdict_table(found: Verification) -> Table:
    """Return a table of the requirements with value, limit, verdict and worst plant."""
    axes = found.controller.robot.outputs.names
    words = {True: "holds", False: "fails", None: "does not decide"}
    rows = [
        [
            metric_title(v.requirement.metric), cell(v.value), _limit(v),
            "not computed" if v.value is None else words[v.holds], _worst_plant(v, axes),
        ]
        for v in found.verdicts
    ]  # fmt: skip
    return Table("Requirements", ["metric", "value", "limit", "verdict", "worst plant"], rows)


def _limit(verdict: Verdict) -> str:
    return f"{_BOUNDS[verdict.requirement.bound]} {verdict.requirement.limit:g}"


def _worst_plant(verdict: Verdict, axes: tuple[str, ...]) -> str:
    if verdict.note:
        return verdict.note.removeprefix("not computed: ")
    worst = verdict.worst
    return str(worst.get("name", "")) + (f", {worst['axis']}" if worst.get("axis") in axes else "")


def verification_page(found: Verification, controller: str, certificate: str = "") -> str:
    """Return the HTML page of a verification; `controller` and `certificate` are names of their files."""
    evidence, scale = found.evidence, found.requirements.scale
    first, *others = scale.robot.outputs.names
    stepped = step_chart(evidence.steps, evidence.stepped, scale)
    sections = [_requirements_section(found, certificate, stepped)]
    for part in evidence.linear:
        sections += _linear_sections(found, part)
    each = f" and, in a run of its own, of {' and '.join(others)}" if others else ""
    text = [
        "The controller's own runtime with all its limits, against every plant with its delay and noisy outputs: a "
        f"step of {first}{each}; half way a load is added to the plant's input."
    ]
    size, unit = found.requirements.step["size_deg"], scale.robot.outputs.display_unit
    where = f"Steps of {size:.4g} {unit} on all {len(evidence.stepped)} linear plants"
    sections.append(Section("Steps", tables=[_spread(found, "step", where)], method=text))
    if evidence.necks:
        charts = [neck_chart(evidence, scale)] if any(run.result is not None for run in evidence.necks) else []
        size = found.requirements.sim["size_deg"]
        where = f"Steps of {size:.4g} {unit} of all simulation models and draws, in all directions, with all payloads"
        tables = [_spread(found, "sim", where), _runs_table(found)]
        sections.append(Section("Simulated loops", tables=tables, charts=charts))
    sections.append(_plants_section(found))
    words = "holds" if found.holds else "does not hold"
    return page(
        f"{controller} {words}", sections, verdict=verification_decision(found.contents(), certificate),
        holds=found.holds, footer="Written by softneck verify.",
    )  # fmt: skip


def verification_decision(contents: Mapping[str, Any], certificate: str) -> str:
    """Return the decision of `verify` from its JSON; `certificate` is the name of the file."""
    values = certificate_values(certificate or "its certificate", contents)
    plants, loops = contents["plants"]["count"], contents["virtual_neck_loops"]
    judged = f"Judged against {plants} linear plants and in {loops} simulated loops."
    return certificate_decision(values, judged=judged)


def _requirements_section(found: Verification, certificate: str, stepped: Chart) -> Section:
    text = [f"{found.summary()[0].upper()}{found.summary()[1:]}."]
    if certificate:
        text.append(f"Certificate: {certificate}. Each worst plant stands beside it as a loop for softneck simulate.")
    text += [f"Not computed: {name}: {why}." for name, why in found.evidence.not_computed.items()]
    table = replace(verdict_table(found), caption="Each at its worst plant")
    return Section("Requirements", charts=[stepped], tables=[table], method=text)


def _linear_sections(found: Verification, part: LinearEvidence) -> list[Section]:
    mu = [
        [neck.name, row.axes, f"{row.mu:.3f}"]
        for neck, rows in zip(found.necks, part.structured, strict=True) for row in rows
    ]  # fmt: skip
    bounds = Table("Bounds", ["plants", "axis", "mu, bound"], mu, text=2)
    charts = frequency_charts(part, found.evidence.frequency, found.necks[0].gain_unit)
    return [
        Section("Frequency responses", tables=[_margin_table(part, drawn=bool(found.evidence.drawn))], charts=charts),
        Section("Structured singular value", tables=[bounds], charts=mu_charts(part)),
    ]


def _margin_table(part: LinearEvidence, *, drawn: bool) -> Table:
    rows = []
    for name, values in part.margins.items():
        finite = values[np.isfinite(values)]
        middle = float(np.median(finite)) if finite.size else math.inf
        rows.append([name, *(cell(float(v)) for v in (values[0], middle, values.min(), values.max()))])
    title = f"Margins over all linear plants{'; those of the draws decide, above' if drawn else ''}"
    return Table(title, ["margin", "nominal", "median", "least", "largest"], rows)


def _spread(found: Verification, group: str, caption: str) -> Table:
    rows = []
    for name, values in found.evidence.metrics.items():
        if name.startswith(f"{group}."):
            v = values.values
            worst = values.describe(int(np.argmax(v)))["name"]
            rows.append([name.partition(".")[2], *(cell(float(x)) for x in (v[0], np.median(v), v.max())), worst])
    return Table(caption, ["metric", "nominal", "median", "worst", "worst plant"], rows)


def _runs_table(found: Verification) -> Table:
    runs = found.evidence.necks
    tendons = found.controller.robot.tendon_angles is not None
    names = [name for name in runs[0].metrics if tendons or name != "slack_s"]
    rows = [[run.name, *(cell(run.metrics[name]) for name in names)] for run in runs]
    shown = [found.requirements.scale.name_of(f"sim.{name}").partition(".")[2] for name in names]
    return Table("Each loop over a simulation model, in one direction", ["plant, payload, direction", *shown], rows)


def _plants_section(found: Verification) -> Section:
    rows = []
    robot, scale = found.controller.robot, found.requirements.scale
    motor = to_si(robot.motors.unit)[0]
    for neck in found.necks:
        for axis, box in zip(neck.names, neck.axes, strict=True):
            for title, values in (("least", box.low), ("nominal", box.nominal), ("largest", box.high)):
                numbers = [f"{motor * scale.shown(values[0]):.4g}", f"{values[1]:.4g}", f"{1e3 * values[2]:.4g}"]
                rows.append([neck.name, axis, title, *numbers])
    gain = f"static gain [{error_unit(robot)[0]}/{robot.motors.unit}]"
    head = ["source", "axis", "", gain, "pole [1/s]", "dead time [ms]"]
    cross = [
        f"{neck.name}: {robot.input_names[j]} into {axis} {mixed[i, j]:+.3f} of its own gain."
        for neck in found.necks for mixed in [mixing_matrix(neck.cross, len(neck.names))]
        for i, axis in enumerate(neck.names) for j in range(len(neck.names)) if i != j
    ]  # fmt: skip
    files = [[role, path, digest] for role, (path, digest) in found.files.items()]
    tables = [Table("Boxes", head, rows, text=3)]
    if files:
        tables.append(Table("Files", ["role", "path", "SHA-256"], files, text=3))
    text = [f"{len(found.evidence.plants)} plants, {found.order_words()}.", *cross]
    return Section("Plants and files", text=text, tables=tables)
