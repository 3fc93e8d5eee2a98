"""Pages of a log and a recording: its import, and its quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Vector, to_si
from softneck.robot import Scaling
from softneck.signals import Doubt, Layout, Quality, Recording, Source, file_unit, is_held

from ._chart import ALL_MOTOR_COLOURS, GREEN, GREY, ORANGE, PURPLE, RED, Chart, Curve, Panel, least_spans
from ._page import Section, Table, cell, page

if TYPE_CHECKING:
    import pandas as pd

# More points would hide each other and fill the page.
_MAX_POINTS = 3_000


def import_page(
    log: Path,
    frame: pd.DataFrame,
    layout: Layout,
    *,
    recording: Recording | None,
    doubts: Sequence[Doubt] = (),
    lines: Sequence[str] = (),
    problems: Sequence[str] = (),
) -> str:
    """Return the HTML page of an import.

    `lines` are those of the guess and notes of the import, `problems` missing entries or the reason for no recording.
    """
    charts = _charts(frame, layout, recording)
    sections = [_doubts_section(doubts, problems, lines, charts[:1]), _mapping(frame, layout, recording)]
    if recording is None:
        sections.insert(1, Section("Columns of the log", tables=[_columns(frame, _roles(layout))]))
    if charts[1:]:
        sections.append(Section("Raw columns and channels", charts=charts[1:]))
    if left_out := [line.removeprefix("ignored: ") for line in lines if line.startswith("ignored: ")]:
        sections.append(Section("Left out", text=left_out))
    return _import_page(log, sections, doubts, problems, recording)


def refused_page(
    log: Path, frame: pd.DataFrame, columns: Mapping[str | int, tuple[str, str]], why: str,
    doubts: Sequence[Doubt] = (),
) -> str:  # fmt: skip
    """Return the HTML page of an import that was refused, of columns each with its unit ("" for none) and role."""
    roles: dict[str, dict[str | int, str]] = {}
    for column, (unit, role) in columns.items():
        if role[-1:].isdigit():
            roles.setdefault(role.rstrip("0123456789 "), {})[column] = unit
    panels = [replace(_raw_panel(frame, those), title=role) for role, those in roles.items()]
    charts = [Chart("Raw columns", panels, x_label="", columns=2, linked=False, row_height=2.6)] if panels else []
    sections = [Section("Columns of the log", tables=[_columns(frame, columns)], charts=charts,
                        findings=_findings_of_doubts(doubts))]  # fmt: skip
    return _import_page(log, sections, doubts, (why,), None)


def _import_page(
    log: Path, sections: Sequence[Section], doubts: Sequence[Doubt], problems: Sequence[str],
    recording: Recording | None,
) -> str:  # fmt: skip
    return page(
        f"Import of {log.name}", sections, verdict=_import_verdict(doubts, problems, recording),
        holds=False if problems else None if doubts else True,
        footer="Written by softneck import.",
    )  # fmt: skip


def _import_verdict(doubts: Sequence[Doubt], problems: Sequence[str], recording: Recording | None) -> str:
    if problems or recording is None:
        return f"No recording: {problems[0] if problems else 'something is missing'}"
    made = f"A recording of {len(recording)} rows was made"
    return f"{made}; guesses to confirm: {len(doubts)}." if doubts else f"{made}; no guess is in doubt."


def _doubts_section(
    doubts: Sequence[Doubt], problems: Sequence[str], lines: Sequence[str], charts: Sequence[Chart]
) -> Section:
    """Return the doubts and problems for the reader to decide, with the first chart."""
    # The verdict, at the top of the page, has the first problem.
    findings = [("warning", f"missing: {problem}") for problem in problems[1:]]
    findings += [("warning", line.removeprefix("warning: ")) for line in lines if line.startswith("warning: ")]
    findings = list(dict.fromkeys([*findings, *_findings_of_doubts(doubts)]))
    if not doubts and not problems:
        findings.append(("ok", "every guess is at least 90 % sure."))
    method = "First: columns as logged, by row. Then: channels of the recording over time, in the same colours."
    title = "Doubts" if doubts or problems else "Columns and channels"
    return Section(title, findings=findings, charts=charts, method=[method] if charts else [])


def _findings_of_doubts(doubts: Sequence[Doubt]) -> list[tuple[str, str]]:
    # A list, since a phone shows two columns of a table of five.
    return [
        ("note", f"{one} ({'or: ' + ', '.join(one.choices) if one.choices else 'if not, edit the layout'})")
        for one in doubts
    ]


def _mapping(frame: pd.DataFrame, layout: Layout, recording: Recording | None) -> Section:
    text = [f"{len(frame)} rows and {frame.shape[1]} columns in the log."]
    if recording is not None:
        text.append(
            f"The recording has {len(recording)} rows in {len(recording.runs())} run(s) at "
            f"{1e3 * recording.sample_time:.6g} ms."
        )
    rows = []
    for name, source in _sources(layout).items():
        there = recording is not None and name in recording.channels
        unit = file_unit(name, layout.robot) if name not in ("inclination", "orientation", "time") else ""
        made = _span(recording.channels[name] / to_si(unit)[0], unit) if there and recording is not None else ""
        how = ("inverted" if source.sign < 0 else "") + (" integrated" if source.integrate else "")
        rows.append([name, _source_text(source), made, how.strip()])
    head = ["channel", "from", "in the recording", "changed"]
    return Section("Mapping", text=text, tables=[Table("Channels", head, rows, text=2)])


def _columns(frame: pd.DataFrame, columns: Mapping[str | int, tuple[str, str]]) -> Table:
    """Return a table of the raw columns: the unit that was read, the range, and what each seems to be."""
    rows = []
    for number, title in enumerate(frame.columns):
        values = _column(frame, number)
        seen = values[np.isfinite(values)]
        ends = [f"{seen.min():.4g}", f"{seen.max():.4g}"] if seen.size else ["no number", ""]
        unit, role = columns.get(number) or columns.get(title) or ("", "not recognised")
        rows.append([str(title), unit or "-", *ends, role])
    return Table("Columns", ["column", "unit read", "least", "largest", "seems to be"], rows)


def _roles(layout: Layout) -> dict[str | int, tuple[str, str]]:
    """Return the units and the channels of each column that a layout takes."""
    found: dict[str | int, dict[str, str]] = {}
    for name, source in _sources(layout).items():
        for term in source.terms:
            found.setdefault(term.column, {})[name] = source.unit
    return {column: (", ".join(dict.fromkeys(those.values())), ", ".join(those)) for column, those in found.items()}


def _sources(layout: Layout) -> dict[str, Source]:
    tilt = {"inclination": layout.inclination, "orientation": layout.orientation, "time": layout.time}
    return {**layout.channels, **{name: source for name, source in tilt.items() if source is not None}}


def _source_text(source: Source) -> str:
    terms = [f"{t.column}" if t.factor == 1.0 else f"{t.factor:.4g} x {t.column}" for t in source.terms]
    said = " + ".join(terms)
    return said if said.endswith(f"[{source.unit}]") else f"{said} [{source.unit}]"


def _column(frame: pd.DataFrame, name: str | int) -> Vector:
    import pandas as pd

    cells = frame[name] if name in frame.columns else frame.iloc[:, int(name)]
    return np.asarray(pd.to_numeric(cells, errors="coerce"), dtype=np.float64)


def _span(values: Vector, unit: str) -> str:
    seen = values[np.isfinite(values)]
    return f"{seen.min():.4g} to {seen.max():.4g} {unit}" if seen.size else "no number"


def _charts(frame: pd.DataFrame, layout: Layout, recording: Recording | None) -> list[Chart]:
    """Return a chart for each group of channels, with the raw columns beside them."""
    sources = _sources(layout)
    robot = layout.robot
    channels = {
        "set-points": robot.set_points, "positions": robot.motor_positions, "velocities": robot.motor_velocities,
    }  # fmt: skip
    groups = {title: [name for name in layout.channels if name in names] for title, names in channels.items()}
    taken = {name for names in groups.values() for name in names}
    for output in robot.outputs.names:
        groups[output] = [name for name in layout.channels if name.startswith(output) and name not in taken]
    charts = []
    for title, names in groups.items():
        raw = names or (["inclination", "orientation"] if title in ("pitch", "roll") else [])
        raw = [name for name in raw if name in sources]
        made = [name for name in (names or [title]) if recording is not None and name in recording.channels]
        if raw or made:
            panels = [_raw_panel(frame, {t.column: sources[name].unit for name in raw for t in sources[name].terms})]
            if recording is not None and made:
                panels.append(_made_panel(recording, made))
            charts.append(Chart(title.capitalize(), panels, x_label="", columns=2, linked=False, row_height=2.6))
    return [chart for chart in charts if any(panel.curves for panel in chart.panels)]


def _raw_panel(frame: pd.DataFrame, columns: Mapping[str | int, str]) -> Panel:
    """Return a panel of columns, each with its unit."""
    every = max(1, len(frame) // _MAX_POINTS)
    rows = np.arange(0, len(frame), every, dtype=np.float64)
    curves = [
        Curve(rows, _column(frame, name)[::every], str(name), ALL_MOTOR_COLOURS[k % len(ALL_MOTOR_COLOURS)], "line")
        for k, name in enumerate(columns)
    ]
    return Panel(curves, f"as logged [{'/'.join(sorted(set(columns.values()))) or '?'}]", x_label="row", title="raw")


def _least_spans(recording: Recording) -> dict[str, float]:
    robot = recording.robot
    return least_spans(Scaling.of(robot, set_points=recording.set_points, outputs=recording.outputs), robot)


def _made_panel(recording: Recording, names: Sequence[str]) -> Panel:
    every = max(1, len(recording) // _MAX_POINTS)
    unit = file_unit(names[0], recording.robot)
    time = recording.time[::every]
    curves = [
        Curve(
            time, recording.channels[name][::every] / to_si(file_unit(name, recording.robot))[0], name,
            ALL_MOTOR_COLOURS[k % len(ALL_MOTOR_COLOURS)], "step" if is_held(name) else "line",
        )
        for k, name in enumerate(names)
    ]  # fmt: skip
    # Colours and order are those of the columns beside it; a phone has no room for a second legend.
    least = _least_spans(recording).get(names[0], 0.0)
    label = f"in the recording [{unit}]"
    return Panel(curves, label, x_label="time [s]", title="recording", legend=False, least_span=least)


_FAULTS = (("missed", RED), ("frozen", PURPLE), ("clipped", ORANGE), ("outliers", GREEN))
_FAULT_NAMES = {"outliers": "spikes"}
# Marks of one fault in one channel.
_MAX_MARKS = 200


def faults_chart(recording: Recording, quality: Quality, title: str) -> Chart:
    """Describe the measured channels over time: a band over the rows of each fault, a point on each spike."""
    # Times restart with each run; row numbers do not.
    t = np.arange(len(recording)) * recording.sample_time
    border = np.flatnonzero(np.diff(recording.run)) + 1
    panels = []
    least = _least_spans(recording)
    measured = (*recording.robot.motor_positions, *recording.robot.outputs.names)
    for name in [name for name in measured if name in recording.channels]:
        y = _values(recording, name)
        y[border] = np.nan
        curves = [Curve(t, y, colour=GREY, width=0.7)]
        for sort, colour in _FAULTS:
            if segments := getattr(quality.channels[name], sort)[:_MAX_MARKS]:
                rows = [np.arange(one.start, one.stop) for one in segments]
                curves.append(_fault_curve(t, _values(recording, name), rows, sort, colour))
        label = f"{name.replace('_', ' ')} [{quality.channels[name].unit}]"
        panels.append(Panel(curves, label, least_span=least[name]))
    return Chart(title, panels, "time from the first row [s]", row_height=2.0)


def _fault_curve(t: Vector, y: Vector, rows: Sequence[np.ndarray], sort: str, colour: str) -> Curve:
    """Return the marks of a fault: points for spikes, else bands over its rows."""
    if sort == "outliers":
        at = np.concatenate(rows)
        return Curve(t[at], y[at], _FAULT_NAMES[sort], colour, "points", 1.3)
    low, high = (float(np.nan_to_num(edge)) for edge in (np.nanmin(y, initial=0.0), np.nanmax(y, initial=0.0)))
    step = t[1] - t[0] if t.size > 1 else 1.0
    x = np.concatenate([[t[one[0]], t[one[-1]] + step, t[one[-1]] + step] for one in rows])
    gaps = np.tile([0.0, 0.0, np.nan], len(rows))
    return Curve(x, low + gaps, sort, colour, "band", upper=high + gaps)


def _values(recording: Recording, name: str) -> Vector:
    """Return a copy of a channel in its file unit."""
    return recording.channels[name] / to_si(file_unit(name, recording.robot))[0]


def quality_page(recording: Recording, quality: Quality, title: str) -> str:
    """Return the HTML page of a recording's quality: findings, channels and excitation."""
    bandwidth = quality.spectrum.bandwidth
    spectrum = f"Power of {', '.join(quality.spectrum.inputs)} (Welch, never across runs)."
    if not np.isnan(bandwidth):
        spectrum += f" Inputs without power up to the bandwidth of {bandwidth:.3g} rad/s identify no model."
    faults = faults_chart(recording, quality, "Measured channels, with the rows of each fault marked")
    sections = [
        Section("Findings", charts=[faults], findings=_findings(quality)),
        Section("Channels", tables=[_channel_table(quality)]),
        Section("Excitation", text=[spectrum, *quality.numbers()]),
    ]
    return page(
        title, sections, verdict=_quality_verdict(recording, quality), holds=quality.severity != "warning",
        footer="Written by softneck info.",
    )  # fmt: skip


def _quality_verdict(recording: Recording, quality: Quality) -> str:
    """Return a sentence on the quality and length of the recording."""
    count = {severity: sum(one.severity == severity for one in quality.findings) for severity in ("warning", "note")}
    runs = len(recording.runs())
    words = {
        "warning": f"Fix this before you identify a model from it ({count['warning']} warnings below)",
        "note": f"Fit to identify a model, with {count['note']} thing(s) to know",
        "ok": "Fit to identify a model; nothing is wrong with it",
    }
    return (
        f"{words[quality.severity]}. It has {quality.rows} rows in {runs} run{'s' if runs > 1 else ''} at "
        f"{1e3 * quality.sample_time:g} ms, {quality.rows * quality.sample_time:.1f} s."
    )


def _findings(quality: Quality) -> list[tuple[str, str]]:
    findings = []
    for one in quality.findings:
        first = f" First at {one.time:.2f} s of its run." if one.time is not None and "at " not in one.message else ""
        findings.append((one.severity, str(one).removeprefix(f"{one.severity}: ") + first))
    return findings


def _channel_table(quality: Quality) -> Table:
    head = ["channel", "lowest", "highest", "unit", "step", "noise", "missed", "frozen", "clipped", "spikes"]
    rows = []
    for name, channel in quality.channels.items():
        values = channel.as_dict()
        counts = [str(values[f"{sort}_rows"]) for sort, _ in _FAULTS]
        low, high, step = (cell(values[key], ".3g") for key in ("lowest", "highest", "quantum"))
        noise = "-" if channel.is_command else cell(values["noise_std"], ".3g")
        rows.append([name, low, high, channel.unit, step, noise, *counts])
    return Table("Channels: steps and noise in the channel's unit, faults in rows", head, rows)
