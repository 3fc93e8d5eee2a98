"""The page of a tuning: the best, what binds, the front, and its steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from softneck.design import assumed_lines
from softneck.plots import GREY, Chart, Curve, Panel, Section, Table, curve_styles, page
from softneck.tuning import step_response
from softneck.verification import metric_title

if TYPE_CHECKING:
    from softneck.tuning import Candidate, Tuned

_SHOWN = 30
_STEPS = 6
_SIGNS = {"min": ">=", "max": "<=", "below": "<"}


def tune_page(found: Tuned) -> str:
    """Return the HTML page of a tuning."""
    items = [found.best, *(item for item in found.front if item is not found.best)]
    return page(
        f"Controller for {found.task.robot.label()}, tuned",
        [_result(found, _steps(found, items)), _front(found), _asked(found)],
        verdict=said_of(found) if found.holds else f"Not all requirements hold. {stands_in_the_way(found)}",
        holds=found.holds,
        footer="Written by softneck tune.",
    )


def said_of(found: Tuned) -> str:
    """Return the verdict of a search whose certificate holds."""
    if not found.loosened:
        return "All requirements hold."
    return f"All requirements hold but {'; '.join(one.in_words(metric) for metric, one in found.loosened.items())}."


def requirement_rows(found: Tuned) -> list[list[str]]:
    """Return a row for each requirement: metric, bound, limit, value of the best, verdict, note."""
    rows = []
    for verdict in found.verification.verdicts:
        item, value, holds = verdict.requirement, verdict.value, verdict.holds
        seen = found.best.metrics.get(item.metric)
        if value is not None and seen is not None and item.metric.startswith("sim.") and seen > value:
            # Of the loops that only tuning looks at: noise, another dead time.
            value, holds = seen, bool(holds) and item.holds(seen)
        said = "-" if holds is None else "holds" if holds else "fails"
        rows.append(
            [metric_title(item.metric), _SIGNS[item.bound], f"{item.limit:g}", _text(value), said, verdict.note]
        )
    for item in found.task.asked.bounds:
        if item.metric.startswith("track."):
            value = found.best.metrics.get(item.metric)
            said = "-" if value is None else "holds" if item.holds(value) else "fails"
            rows.append([metric_title(item.metric), _SIGNS[item.bound], f"{item.limit:g}", _text(value), said, ""])
    return rows


def notes(found: Tuned) -> list[str]:
    """Return what is to be said of requirements, each reason once with its metrics, and what the design assumes."""
    told: dict[str, list[str]] = {}
    for row in requirement_rows(found):
        if row[5]:
            told.setdefault(row[5], []).append(row[0])
    reasons = [f"{', '.join(metrics)}: {note}." for note, metrics in told.items()]
    limits = getattr(found.controller, "limits", None)
    motors = [] if limits is None else limits.lines(found.controller.sample_time)
    return reasons + [line.strip() for line in (*motors, *assumed_lines(found.assumed))]


def stands_in_the_way(found: Tuned) -> str:
    """Return what binds in a sentence or two."""
    if found.holds:
        return ""
    unknown = [item for item in found.verification.failed if item.value is None]
    if found.binding is None and unknown:
        metrics = ", ".join(verdict.requirement.metric for verdict in unknown)
        return f"Of {found.best.kind} nobody knows {metrics}: {unknown[0].note}."
    if found.binding is None:
        # Loops of tuning have noise, smaller steps and a circle, which `verify` has not.
        asked = dict.fromkeys(bound.metric for bound in found.task.asked.bounds)
        looped = ", ".join(metric for metric in asked if metric.startswith(("sim.", "track.")))
        return f"The budget of {found.evaluations} ended before all loops were simulated: {looped} are not computed."
    if found.nearest is None:
        return f"{found.binding} fails, by the largest factor."
    sign, limit = next((b.bound, b.limit) for b in found.task.asked.bounds if b.metric == found.binding)
    return f"Only {found.binding} fails: {found.nearest:.3g}, required {_SIGNS[sign]} {limit:.3g}."


def _result(found: Tuned, steps: Chart) -> Section:
    best = found.best
    text = [
        f"{best.kind}: " + ", ".join(f"{name} {_text(value)}" for name, value in best.settings.items()) + ".",
        f"{found.evaluations} judgements of {len({(i.kind, str(i.settings)) for i in found.candidates})} candidates "
        "that were closed in loops, and of others that were left behind before.",
    ]
    text += [f"{kind} was left out: {why}" for kind, why in found.dropped.items()]
    rows = requirement_rows(found)
    tables = [Table("Requirements", ["metric", "bound", "limit", "value", "verdict"], [row[:5] for row in rows])]
    text += notes(found)
    return Section("Best controller", charts=[steps], tables=tables, method=text)


def _asked(found: Tuned) -> Section:
    return Section("What was asked", text=["; ".join(found.task.asked.lines()) + "."])


def _steps(found: Tuned, items: Sequence[Candidate]) -> Chart:
    curves: list[Curve] = []
    for item, (colour, style) in zip(items[:_STEPS], curve_styles(), strict=False):
        time, y, reference = step_response(found.task, item)
        if not curves:
            curves.append(Curve(time, reference, "reference", GREY, "step"))
        curves.append(Curve(time, y, _label(found, item), colour, style, 2.0 if item is found.best else 1.0))
    outputs = found.task.robot.outputs
    where = "with the heaviest payload" if found.task.own else "of the nominal plant"
    panel = Panel(curves, f"{outputs.names[0]} [{outputs.display_unit}]")
    return Chart(f"Steps {where}: the best, and others on the front", [panel], row_height=4.0)


def _front(found: Tuned) -> Section:
    rows = [
        [item.kind, *(_text(item.metrics[name]) for name in found.objectives),
         ", ".join(f"{name} {_text(value)}" for name, value in item.settings.items())]
        for item in found.front[:_SHOWN]
    ]  # fmt: skip
    more = len(found.front) - _SHOWN
    text = [f"{len(found.front)} candidates that none beats in every objective; all are in pareto.csv."]
    text += [f"The first {_SHOWN} by {found.objectives[0]}."] if more > 0 else []
    return Section("Pareto front", text=text, tables=[Table("", ["kind", *found.objectives, "settings"], rows)])


def _label(found: Tuned, item: Candidate) -> str:
    number = next((k for k, other in enumerate(found.front, start=1) if other is item), 0)
    return f"best: {item.kind}" if item is found.best else f"{item.kind} {number}"


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
