"""The page of a verification: the verdict at one glance, and all behind it below."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softneck.plots import Chart, Section, Table, page

from ._charts import (
    frequency_charts,
    gain_unit,
    mu_charts,
    neck_chart,
    step_chart,
)
from ._evidence import LinearEvidence
from ._plants import mixing
from ._verify import Verdict, Verification

_BOUNDS = {"min": ">=", "max": "<=", "below": "<"}


def verdict_table(found: Verification) -> Table:
    """Return the requirements with value, limit, verdict and worst plant."""
    axes = found.controller.robot.outputs.names
    rows = [
        [
            verdict.requirement.metric, number(verdict.value),
            f"{_BOUNDS[verdict.requirement.bound]} {verdict.requirement.limit:g}", _word(verdict),
            _plant(verdict, axes),
        ]
        for verdict in found.verdicts
    ]  # fmt: skip
    return Table("Requirements", ["metric", "value", "limit", "verdict", "worst plant"], rows)


def number(value: Any) -> str:
    """Return a value for a table: `-` where there is none."""
    if value is None:
        return "-"
    if not isinstance(value, int | float | np.floating):
        return str(value)
    return f"{value:.4g}"


def _word(verdict: Verdict) -> str:
    if verdict.holds is None and verdict.value is not None:
        return "does not decide"
    return {True: "holds", False: "fails", None: "not computed"}[verdict.holds]


def _plant(verdict: Verdict, axes: tuple[str, ...]) -> str:
    if verdict.note:
        return verdict.note.removeprefix("not computed: ")
    worst = verdict.worst
    where = f", {worst['axis']}" if worst.get("axis") in axes else ""
    point = f" (frozen at {worst['frozen_point']})" if worst.get("frozen_point") else ""
    return f"{worst.get('name', '')}{where}{point}"


def verification_page(found: Verification, controller: str, certificate: str = "") -> str:
    """Return the HTML page of a verification.

    Args:
        found: the verification.
        controller, certificate: names of their files, for the title and the text.
    """
    evidence, robot = found.evidence, found.controller.robot
    first, *others = robot.outputs.names
    stepped = step_chart(evidence.steps, evidence.stepped, robot)
    sections = [_first(found, certificate, stepped)]
    for part in evidence.linear:
        sections += _linear_sections(found, part)
    each = f" and, in a run of its own, of {' and '.join(others)}" if others else ""
    text = [
        "The controller's own runtime with all its limits, against every plant with its delay and noisy angles: a step "
        f"of {first}{each}; half way a load is added to the plant's input."
    ]
    sections.append(Section("Steps", tables=[_spread(found, "step")], method=text))
    if evidence.necks:
        charts = [neck_chart(evidence, robot)] if any(run.result is not None for run in evidence.necks) else []
        sections.append(Section("Virtual neck", tables=[_spread(found, "neck"), _runs(found)], charts=charts))
    sections.append(_plants(found))
    words = "holds" if found.holds else "does not hold"
    return page(
        f"{controller} {words}", sections, verdict=_sentence(found), holds=found.holds,
        footer="Written by softneck verify.",
    )  # fmt: skip


def _sentence(found: Verification) -> str:
    """Return the verdict: what holds, and what fails where."""
    axes = found.controller.robot.outputs.names
    failed = [
        f"{v.requirement.metric} is {number(v.value)}, asked {_BOUNDS[v.requirement.bound]} {v.requirement.limit:g} "
        f"({_plant(v, axes)})"
        for v in found.failed
    ]
    count, plants = len(found.verdicts), f"{len(found.evidence.plants)} plants"
    if not failed:
        held, absent = (sum(map(test, found.verdicts)) for test in (_held, _absent))
        open_ = [(count - held - absent, "do not decide"), (absent, "are not computed")]
        rest = "".join(f", {number} {words}" for number, words in open_ if number)
        return (
            f"{held} of {count} requirements hold{rest} and none fails, against {plants} and "
            f"{len(found.evidence.necks)} loops of virtual necks."
        )
    more = f"; {len(failed) - 3} more below" if len(failed) > 3 else ""
    return f"{len(failed)} of {count} requirements fail: {'; '.join(failed[:3])}{more}."


def _held(verdict: Verdict) -> bool:
    return verdict.holds is True


def _absent(verdict: Verdict) -> bool:
    return verdict.value is None


def _first(found: Verification, certificate: str, stepped: Chart) -> Section:
    text = [f"{found.summary()[0].upper()}{found.summary()[1:]}."]
    if certificate:
        text.append(f"Certificate: {certificate}. Each worst plant stands beside it as a loop for softneck simulate.")
    text += [f"Not computed: {name}: {why}." for name, why in found.evidence.not_computed.items()]
    table = verdict_table(found)
    return Section(
        "Requirements", charts=[stepped], tables=[Table("Each at its worst plant", table.head, table.rows)], method=text
    )


def _linear_sections(found: Verification, part: LinearEvidence) -> list[Section]:
    title = f" at {part.name}" if part.name else ""
    mu = [
        [neck.name, row.axes, f"{row.mu:.3f}"]
        for neck, rows in zip(found.necks, part.structured, strict=True) for row in rows
    ]  # fmt: skip
    head = ["plants", "axis", "mu, bound"]
    return [
        Section(
            f"Frequency responses{title}",
            tables=[_margin_table(part)],
            charts=frequency_charts(part, found.evidence.frequency),
        ),
        Section(
            f"Structured singular value{title}", tables=[Table("Bounds", head, mu, text=2)], charts=mu_charts(part)
        ),
    ]  # fmt: skip


def _margin_table(part: LinearEvidence) -> Table:
    rows = []
    for name, values in part.margins.items():
        finite = values[np.isfinite(values)]
        middle = float(np.median(finite)) if finite.size else math.inf
        rows.append([name, *(number(float(v)) for v in (values[0], middle, values.min(), values.max()))])
    return Table("Margins over all plants tried", ["margin", "nominal", "median", "least", "largest"], rows)


def _spread(found: Verification, group: str) -> Table:
    rows = []
    for name, values in found.evidence.metrics.items():
        if name.startswith(f"{group}."):
            v = values.values
            worst = values.describe(int(np.argmax(v)))["name"]
            rows.append([name.partition(".")[2], *(number(float(x)) for x in (v[0], np.median(v), v.max())), worst])
    return Table("Over all of them", ["metric", "nominal", "median", "worst", "worst plant"], rows)


def _runs(found: Verification) -> Table:
    runs = found.evidence.necks
    names = list(runs[0].metrics)
    rows = [[run.name, *(number(run.metrics[name]) for name in names)] for run in runs]
    return Table("Each loop", ["neck, payload, direction", *names], rows)


def _plants(found: Verification) -> Section:
    rows = []
    unit, factor = gain_unit(found.controller.robot)
    digits = "2f" if found.controller.robot.is_neck else "4g"
    for neck in found.necks:
        for axis, box in zip(neck.names, neck.axes, strict=True):
            for title, values in (("least", box.low), ("nominal", box.nominal), ("largest", box.high)):
                numbers = [f"{factor * values[0]:.{digits}}", f"{values[1]:.2f}", f"{1e3 * values[2]:.0f}"]
                rows.append([neck.name, axis, title, *numbers])
    head = ["source", "axis", "", f"static gain [{unit}]", "pole [1/s]", "dead time [ms]"]
    cross = [
        f"{neck.name}: phi_i into pitch {neck.cross[0]:+.3f} of theta_i's gain, theta_i into roll {neck.cross[1]:+.3f}."
        for neck in found.necks if neck.robot.is_neck
    ] + [
        f"{neck.name}: the input of {other} into {axis} {neck_mixing[i, j]:+.3f} of its own gain."
        for neck in found.necks if not neck.robot.is_neck
        for neck_mixing in [mixing(neck.cross, len(neck.names))]
        for i, axis in enumerate(neck.names) for j, other in enumerate(neck.names) if i != j
    ]  # fmt: skip
    files = [[role, path, digest] for role, (path, digest) in found.files.items()]
    tables = [Table("Boxes", head, rows, text=3)]
    if files:
        tables.append(Table("Files", ["role", "path", "SHA-256"], files, text=3))
    text = [f"{len(found.evidence.plants)} plants, {found.order_words()}.", *cross]
    return Section("Plants and files", text=text, tables=tables)
