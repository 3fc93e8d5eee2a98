"""What an import made of a log, as one page: doubts first, then raw columns and channels side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Vector, to_si
from softneck.signals import Doubt, Layout, Recording, Source, file_unit, is_held

from ._chart import Chart, Curve, Panel
from ._page import Section, Table, page
from ._style import ALL_MOTOR_COLOURS

if TYPE_CHECKING:
    import pandas as pd

# More points than this hide each other, and fill the page.
_POINTS = 3_000


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
    """Return the page of an import as HTML.

    Args:
        log: what was read.
        frame: its table, as logged.
        layout: how it was read.
        recording: what was made of it; None where something is missing.
        doubts: of the guess, the least sure first.
        lines: of the guess, and notes of the import.
        problems: what is missing, or why there is no recording.
    """
    first, *charts = [*_charts(frame, layout, recording), None]
    sections = [_doubts(doubts, problems, lines, first), _made(frame, layout, recording)]
    if charts[:-1]:
        sections.append(Section("Raw and made", charts=[chart for chart in charts if chart is not None]))
    if left_out := [line.removeprefix("ignored: ") for line in lines if line.startswith("ignored: ")]:
        sections.append(Section("Left out", text=left_out))
    return page(
        f"Import of {log.name}", sections, verdict=_verdict(doubts, problems, recording),
        holds=False if problems else None if doubts else True,
        footer="Written by softneck import.",
    )  # fmt: skip


def _verdict(doubts: Sequence[Doubt], problems: Sequence[str], recording: Recording | None) -> str:
    if problems or recording is None:
        return f"No recording: {problems[0] if problems else 'something is missing'}"
    made = f"A recording of {len(recording)} rows was made"
    return f"{made}; {len(doubts)} guesses are for you to confirm." if doubts else f"{made}; no guess is in doubt."


def _doubts(doubts: Sequence[Doubt], problems: Sequence[str], lines: Sequence[str], chart: Chart | None) -> Section:
    """Return what a reader has to decide, before all else but the first picture."""
    findings = [("warning", f"missing: {problem}") for problem in problems]
    findings += [("warning", line.removeprefix("warning: ")) for line in lines if line.startswith("warning: ")]
    # A list and no table: on a phone a table of five columns shows two.
    findings += [
        ("note", f"{one} ({'or: ' + ', '.join(one.choices) if one.choices else 'if not, edit the layout'})")
        for one in doubts
    ]
    if not doubts:
        findings.append(("ok", "nothing that was guessed is less than 90 % sure."))
    method = (
        "Left: the columns as logged, over their rows. Right: the recording's channels over time, in the same colours."
    )
    charts = [] if chart is None else [chart]
    return Section("Doubts", findings=findings, charts=charts, method=[method] if charts else [])


def _made(frame: pd.DataFrame, layout: Layout, recording: Recording | None) -> Section:
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
        how = ("turned round" if source.sign < 0 else "") + (" summed up" if source.integrate else "")
        rows.append([name, _from(source), made, how.strip()])
    head = ["channel", "from", "in the recording", ""]
    return Section("What was made of it", text=text, tables=[Table("Channels", head, rows, text=2)])


def _sources(layout: Layout) -> dict[str, Source]:
    tilt = {"inclination": layout.inclination, "orientation": layout.orientation, "time": layout.time}
    return {**layout.channels, **{name: source for name, source in tilt.items() if source is not None}}


def _from(source: Source) -> str:
    terms = [f"{t.column}" if t.factor == 1.0 else f"{t.factor:.4g} x {t.column}" for t in source.terms]
    return f"{' + '.join(terms)} [{source.unit}]"


def _column(frame: pd.DataFrame, name: str | int) -> Vector:
    import pandas as pd

    cells = frame[name] if name in frame.columns else frame.iloc[:, int(name)]
    return np.asarray(pd.to_numeric(cells, errors="coerce"), dtype=np.float64)


def _span(values: Vector, unit: str) -> str:
    seen = values[np.isfinite(values)]
    return f"{seen.min():.4g} to {seen.max():.4g} {unit}" if seen.size else "no number"


def _charts(frame: pd.DataFrame, layout: Layout, recording: Recording | None) -> list[Chart]:
    """Return a chart for each group of channels, the raw columns beside it."""
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
            panels = [_raw_panel(frame, {name: sources[name] for name in raw})]
            if recording is not None and made:
                panels.append(_made_panel(recording, made))
            charts.append(Chart(title.capitalize(), panels, x_label="", columns=2, linked=False, row_height=2.6))
    return [chart for chart in charts if any(panel.curves for panel in chart.panels)]


def _raw_panel(frame: pd.DataFrame, sources: dict[str, Source]) -> Panel:
    columns = dict.fromkeys(term.column for source in sources.values() for term in source.terms)
    every = max(1, len(frame) // _POINTS)
    rows = np.arange(0, len(frame), every, dtype=np.float64)
    curves = [
        Curve(rows, _column(frame, name)[::every], str(name), ALL_MOTOR_COLOURS[k % len(ALL_MOTOR_COLOURS)], "line")
        for k, name in enumerate(columns)
    ]
    units = {source.unit for source in sources.values()}
    return Panel(curves, f"as logged [{'/'.join(sorted(units)) or '?'}]", x_label="row", title="raw")


def _made_panel(recording: Recording, names: Sequence[str]) -> Panel:
    every = max(1, len(recording) // _POINTS)
    unit = file_unit(names[0], recording.robot)
    time = recording.time[::every]
    curves = [
        Curve(
            time, recording.channels[name][::every] / to_si(file_unit(name, recording.robot))[0], name,
            ALL_MOTOR_COLOURS[k % len(ALL_MOTOR_COLOURS)], "step" if is_held(name) else "line",
        )
        for k, name in enumerate(names)
    ]  # fmt: skip
    # Colours and order are those of the columns beside it; a second legend would not fit on a phone.
    return Panel(curves, f"recording [{unit}]", x_label="time [s]", title="made", legend=False)
