"""The results of `softneck tune`: its folder with the best controller and the Pareto front, and its page."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from softneck.core import file_hash, write_certificate, write_text
from softneck.design import assumed_lines
from softneck.loop import error_unit
from softneck.plots import GREY, Chart, Curve, Panel, Section, Table, cell, curve_styles, page, write_page
from softneck.tuning import curve_times
from softneck.verification import (
    certificate_decision,
    has_drives,
    metric_title,
    nominal_plants,
    sources_of,
    start_of,
    verdict_values,
    write_linear,
)

from ._tuner import faster_values, faster_words, tuner_page

if TYPE_CHECKING:
    from softneck.tuning import Candidate, Tuned
    from softneck.verification import Requirement

BEST, OBSERVER, CERTIFICATE, LOOP = "best.npz", "observer.npz", "best.certificate.json", "loop.toml"
TUNER, PLANT = "tuner.html", "plant.npz"
_DRAWN = "the model of the draws"
_LOOP_AT, _LOOP_TAUT = 1.0, 3.0


def write_tuned(found: Tuned, folder: Path, plants: Mapping[str, Path]) -> dict[str, Any]:
    """Write all files of a tuning and return its JSON values.

    `found`: the result. `folder`: target; files of an earlier run are replaced, and its certificate is removed if this
    one does not hold. `plants`: name -> file, or preset, of every plant.
    """
    files = {f"plant {k}": path for k, path in enumerate(plants.values(), start=1) if path.is_file()}
    steps = {name: path if path.exists() else str(path) for name, path in plants.items() if name in found.task.own}
    found.controller.save(folder / BEST, force=True)
    if found.observer is not None:
        found.observer.save(folder / OBSERVER, force=True)
    requirements = folder / "requirements.toml"
    write_text(requirements, tomli_w.dumps(_toml_table(found.task.asked.table)), force=True)
    read = {"controller": folder / BEST, "requirements": requirements, **files}
    verification = replace(
        found.verification, files={role: (str(path), file_hash(path)) for role, path in read.items()}
    )
    certificate = folder / CERTIFICATE
    if found.holds:  # includes [track], which `verify` does not check
        more = {"loosened": _loosened_values(found), "judged_elsewhere": found.judged_elsewhere()}
        write_certificate(certificate, verification.contents(further=more), force=True)
    else:
        certificate.unlink(missing_ok=True)
    _write_loop(found, folder, steps or _write_drawn(found, folder))
    values = tuned_values(found, folder / BEST)
    write_text(folder / "pareto.json", json.dumps(values["pareto"], indent=1) + "\n", force=True)
    write_text(folder / "pareto.csv", _csv(found), force=True)
    write_page(folder / "report.html", tune_page(found), force=True)
    certified = tune_decision(found, tuner=None)
    write_page(folder / TUNER, tuner_page(found, folder, plants, certified=certified), force=True)
    return values


def tuned_values(found: Tuned, path: Path) -> dict[str, Any]:
    """Return the JSON values of a tuning."""
    return {
        "best": {"kind": found.best.kind, "file": str(path), "metrics": _metrics(found.best), "holds": found.holds,
                 "settings": dict(found.best.settings)},
        "pareto": [{"kind": item.kind, "settings": dict(item.settings), "metrics": _metrics(item)}
                   for item in found.front],
        "binding": found.binding,
        "requirements": found.task.asked.lines(),
        "loosened": _loosened_values(found),
        "evaluations": found.evaluations,
        "dropped": dict(found.dropped),
        "verdicts": _verdict_rows(found),
        "judged_elsewhere": found.judged_elsewhere(),
        "faster": faster_values(found),
        "decision": tune_decision(found),
    }  # fmt: skip


def _loosened_values(found: Tuned) -> dict[str, dict[str, float]]:
    return {metric: asdict(one) for metric, one in found.loosened.items()}


def _metrics(item: Candidate) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in sorted(item.metrics.items())}


def _csv(found: Tuned) -> str:
    """Return the front as a table: kind, settings as JSON, objectives, then all other metrics."""
    names = [*found.objectives, *sorted({n for item in found.front for n in item.metrics} - set(found.objectives))]
    lines = [",".join(["kind", *names, "settings"])]
    for item in found.front:
        settings = json.dumps(dict(item.settings), sort_keys=True).replace('"', '""')
        values = [f"{item.metrics[name]:.6g}" if name in item.metrics else "" for name in names]
        lines.append(",".join([item.kind, *values, f'"{settings}"']))
    return "\n".join(lines) + "\n"


def _write_drawn(found: Tuned, folder: Path) -> dict[str, Path]:
    """Write the model of the draws that decide, if any, as a plant of the loop, and return it by its name."""
    for thing in found.task.linear.values() if found.task.drawn else ():
        if getattr(thing, "draws", None) is not None:
            thing.draws.model.save(folder / PLANT, force=True)
            return {_DRAWN: folder / PLANT}
    return {}


def _write_loop(found: Tuned, folder: Path, steps: Mapping[str, Path | str]) -> None:
    """Write a loop file with the best controller and the first of `steps`, else the nominal linear model."""
    task = found.task
    robot = task.robot
    if not steps:
        source = sources_of(task.linear, task.asked.certificate)[0]
        plant = nominal_plants([source])[0]
        facts = {"name": plant.names[0], "numerator": plant.numerator[0].tolist(),
                 "denominator": plant.denominator[0].tolist(), "delay": plant.delay[0].tolist(),
                 "cross": plant.cross[0].tolist(), "sample_time": plant.sample_time, "axis": 0}  # fmt: skip
        write_linear(folder, "loop", facts, controller=folder / BEST, asked=task.asked.certificate,
                     block=found.controller.block(), weights=source.weights, force=True)  # fmt: skip
        return
    name, path = next(iter(steps.items()))
    taut = task.cocontraction is not None
    at = _LOOP_TAUT if taut else _LOOP_AT
    neck = task.asked.certificate.sim
    first, unit = robot.outputs.names[0], error_unit(robot)[0]
    kind = {".fmu": "fmu", ".npz": "model"}.get(Path(path).suffix, "neck")
    start = float(task.asked.certificate.scale.shown(start_of(robot)[0]))
    table: dict[str, Any] = {
        "duration_s": at + float(neck["duration_s"]),
        "plant": {kind: path if isinstance(path, str) else Path(os.path.relpath(path, folder)).as_posix()},
        **({"observer": {"file": OBSERVER}} if found.observed else {}),
        "controller": {"file": BEST},
        "reference": {"kind": "step", f"{first}_{unit}": start + float(neck["size_deg"]), "at_s": at},
    }
    if any(plant.payload and (plant.name == name or name == _DRAWN) for plant in found.own):
        table["plant"]["parameters"] = {"payload": float(max(neck["payloads_kg"]))}
    if taut and "least_cocontraction" not in found.best.settings:
        table["reference"]["cocontraction"] = task.said_cocontraction
    limits = {b.metric.partition(".")[2]: b.limit for b in task.asked.bounds
             if b.metric.startswith("sim.") and b.bound != "min" and not b.metric.endswith("slack_s")}  # fmt: skip
    # From zero to a step away from it is a larger motion than was asked for: of that the end alone is judged.
    shape = ("rise_s", *(("overshoot_pct", "settling_s") if task.asked.shows_settling() else ()))
    known = ("steady_rms_", *(() if start else shape))
    table["limits"] = {f"{first}.{key}": limit for key, limit in limits.items() if key.startswith(known)}
    words = "" if found.observed else (
        "\n# Without observer.npz: with it steps fail a requirement or rise later, or none was designed."
    )  # fmt: skip
    write_text(folder / LOOP, f"# The best of `softneck tune` over {name}.{words}\n{tomli_w.dumps(table)}", force=True)


def _toml_table(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a requirements table as TOML values, without empty tables."""
    return {key: dict(value) if isinstance(value, Mapping) else value for key, value in table.items() if value != {}}


_MAX_FRONT_ROWS = 30
_MAX_STEPS = 6
_SIGNS = {"min": ">=", "max": "<=", "below": "<"}


def tune_page(found: Tuned) -> str:
    """Return the HTML page of a tuning."""
    items = [found.best, *(item for item in found.front if item is not found.best)]
    given = Section("Requirements as given", text=["; ".join(found.task.asked.lines()) + "."])
    return page(
        f"Controller for {found.task.robot.label()}, tuned",
        [_result(found, _steps(found, items)), _front(found), given],
        verdict=tune_decision(found),
        holds=found.holds,
        footer="Written by softneck tune.",
    )


def tune_decision(found: Tuned, *, tuner: str | None = TUNER) -> str:
    """Return the decision of `tune`, from the verdicts of its JSON; `tuner`: the page that it names, if any."""
    robot = found.task.robot
    one = {"file": CERTIFICATE, "controller": BEST, "kind": found.best.kind, "holds": found.holds,
           "drives": has_drives((robot.motors.unit, robot.outputs.unit)),
           **verdict_values(_verdict_rows(found))}  # fmt: skip
    said = certificate_decision(one, tuner=tuner)
    if found.holds and found.loosened:
        said += f" Loosened: {'; '.join(one.in_words(metric) for metric, one in found.loosened.items())}."
    return said if tuner is None else f"{said} {faster_words(faster_values(found), tuner)}".rstrip()


def _verdict_rows(found: Tuned) -> list[dict[str, Any]]:
    """Return the JSON values of each requirement."""
    return [
        {"metric": item.metric, "bound": item.bound, "limit": item.limit, "holds": holds, "note": note,
         "value": value if value is not None and math.isfinite(value) else None}
        for item, value, holds, note in _verdicts(found)
    ]  # fmt: skip


def tune_verdict(found: Tuned) -> str:
    """Return the verdict on a search whose certificate holds; what was not computed is named and holds nothing."""
    absent = [verdict.requirement.metric for verdict in found.verification.verdicts if verdict.value is None]
    said = "All requirements that were computed hold" if absent else "All requirements hold"
    if found.loosened:
        said += f" but {'; '.join(one.in_words(metric) for metric, one in found.loosened.items())}"
    return f"{said}; not computed: {', '.join(absent)}." if absent else f"{said}."


def _verdicts(found: Tuned) -> list[tuple[Requirement, float | None, bool | None, str]]:
    """Return requirement, value of the best, whether it holds and a note; what was not computed does not hold."""
    rows = []
    for verdict in found.verification.verdicts:
        item, value, holds = verdict.requirement, verdict.value, verdict.holds
        tuned = found.best.metrics.get(item.metric)
        if value is not None and tuned is not None and item.metric.startswith("sim.") and not tuned <= value:
            # Loops of tuning alone: with noise, or with another dead time.
            value, holds = tuned, bool(holds) and item.holds(tuned)
        rows.append((item, value, holds, verdict.note))
    for item in found.task.asked.bounds:
        if item.metric.startswith("track."):
            value = found.best.metrics.get(item.metric)
            if value is None and not found.task.own:
                rows.append((item, None, None, "not computed: no simulation model of the robot was given"))
                continue
            why = "not computed: the budget ended before its loops were simulated" if value is None else ""
            rows.append((item, value, value is not None and item.holds(value), why))
    return rows


def requirement_rows(found: Tuned) -> list[list[str]]:
    """Return a row for each requirement: metric, bound, limit, value of the best, verdict, note."""
    return [
        [metric_title(item.metric), _SIGNS[item.bound], f"{item.limit:g}", cell(value, ".3g"),
         "not computed" if value is None else "-" if holds is None else "holds" if holds else "fails", note]
        for item, value, holds, note in _verdicts(found)
    ]  # fmt: skip


def tune_notes(found: Tuned) -> list[str]:
    """Return the notes on requirements, each once with its metrics, and the assumptions of the design."""
    metrics_of: dict[str, list[str]] = {}
    for row in requirement_rows(found):
        if row[5]:
            metrics_of.setdefault(row[5], []).append(row[0])
    reasons = [f"{', '.join(metrics)}: {note}." for note, metrics in metrics_of.items()]
    reasons += [f"{condition}: {how}." for condition, how in found.judged_elsewhere().items()]
    limits = getattr(found.controller, "limits", None)
    motors = [] if limits is None else limits.lines(found.controller.sample_time)
    return reasons + [line.strip() for line in (*motors, *assumed_lines(found.assumed))]


def failing_requirement(found: Tuned) -> str:
    """Return a sentence or two on the requirement that fails."""
    if found.holds:
        return ""
    unknown: dict[str, list[str]] = {}
    for item in found.verification.failed:
        if item.value is None:
            unknown.setdefault(item.note, []).append(item.requirement.metric)
    if unknown:  # whatever else fails, no limit makes these hold
        also = f" {found.binding} fails." if found.binding else ""
        said = "; ".join(f"{', '.join(metrics)} of {found.best.kind}: {note}" for note, metrics in unknown.items())
        return f"{said}.{also}"
    if found.binding is None:
        # Unlike `verify`, tuning has loops with noise, smaller steps and a circle.
        limits = dict.fromkeys(bound.metric for bound in found.task.asked.bounds)
        looped = ", ".join(metric for metric in limits if metric.startswith(("sim.", "track.")))
        return f"The budget of {found.evaluations} ended before all loops were simulated: {looped} are not computed."
    if found.nearest is None:
        return f"{found.binding} fails, by the largest factor."
    sign, limit = next((b.bound, b.limit) for b in found.task.asked.bounds if b.metric == found.binding)
    value = f"{found.nearest:.3g}, required {_SIGNS[sign]} {limit:.3g}"
    task, judged = found.task, found.verification.failed
    failed = {verdict.requirement.metric for verdict in judged}
    failed |= {name for name, ratio in found.best.ratios(task.bounds, tested=task.tested).items() if ratio > 1.0}
    if failed <= {found.binding}:
        return f"Only {found.binding} fails: {value}."
    return (
        f"{found.best.kind} fails {', '.join(sorted(failed))}. Another candidate fails {found.binding} alone: {value}."
    )


def _result(found: Tuned, steps: Chart) -> Section:
    best = found.best
    text = [
        f"{best.kind}: " + ", ".join(f"{name} {cell(value, '.3g')}" for name, value in best.settings.items()) + ".",
        f"{found.evaluations} evaluations of {len({(i.kind, str(i.settings)) for i in found.candidates})} candidates "
        "that were simulated in loops, and of others that were rejected before.",
    ]
    text += [f"{kind} was left out: {why}" for kind, why in found.dropped.items()]
    rows = requirement_rows(found)
    evidence = found.verification.evidence
    of = f"{len(evidence.plants)} linear plants and {len(evidence.necks)} simulated loops"
    caption = f"Requirements, each at its worst over the {of} of the certificate, or over those of the search"
    tables = [Table(caption, ["metric", "bound", "limit", "value", "verdict"], [row[:5] for row in rows])]
    text += tune_notes(found)
    # A budget that ended before any loop leaves no step to draw.
    charts = [steps] if any(panel.curves for panel in steps.panels) else []
    return Section("Best controller", charts=charts, tables=tables, method=text)


def _steps(found: Tuned, items: Sequence[Candidate]) -> Chart:
    time = curve_times(found.task)
    curves: list[Curve] = []
    for item, (colour, style) in zip(
        [item for item in items if item.curves][:_MAX_STEPS], curve_styles(), strict=False
    ):
        y, (size,) = np.array(item.curves["value"]), item.curves["reference"]
        if not curves:
            curves.append(Curve(time, np.full(time.size, size), "reference", GREY, "dashed"))
        curves.append(Curve(time, y, _label(found, item), colour, style, 2.0 if item is found.best else 1.0))
    outputs = found.task.robot.outputs
    asked = found.task.asked.certificate.sim["payloads_kg"]
    heaviest = max((kg for plant in found.own for kg in plant.payloads(asked)), default=0.0)
    where = "of the simulation model" if found.task.own else "of the nominal plant"
    where = f"with the heaviest payload, {heaviest:g} kg" if heaviest > 0.0 else where
    panel = Panel(curves, f"{outputs.names[0]} [{outputs.display_unit}]")
    return Chart(f"Steps {where}: the best, and others on the front", [panel], row_height=4.0)


def _front(found: Tuned) -> Section:
    rows = [
        [item.kind, ", ".join(f"{name} {cell(value, '.3g')}" for name, value in item.settings.items()),
         *(cell(item.metrics[name], ".3g") for name in found.objectives)]
        for item in found.front[:_MAX_FRONT_ROWS]
    ]  # fmt: skip
    more = len(found.front) - _MAX_FRONT_ROWS
    robot, size = found.task.robot, float(found.task.asked.certificate.sim["size_deg"])
    plants = "all simulation models and payloads" if found.task.own else "all linear plants"
    text = [
        f"{len(found.front)} candidates that none beats in every objective; all are in pareto.csv.",
        f"Each value is the worst of the loops of the search alone ({plants}, steps of up to {size:.4g} "
        f"{robot.outputs.display_unit}); the certificate, above, has more plants.",
    ]
    text += [f"The first {_MAX_FRONT_ROWS} by {found.objectives[0]}."] if more > 0 else []
    return Section("Pareto front", text=text, tables=[Table("", ["kind", "settings", *found.objectives], rows, text=2)])


def _label(found: Tuned, item: Candidate) -> str:
    number = next((k for k, other in enumerate(found.front, start=1) if other is item), 0)
    return f"best: {item.kind}" if item is found.best else f"{item.kind} {number}"
