"""The quality report as one self-contained page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import Vector, to_si
from softneck.signals import Quality, Recording, file_unit

from ._chart import Chart, Curve, Panel
from ._page import Section, Table, page
from ._style import GREEN, GREY, ORANGE, PURPLE, RED

_FAULTS = (("missed", RED), ("frozen", PURPLE), ("clipped", ORANGE), ("outliers", GREEN))
_SHOWN = {"outliers": "spikes"}
# Of one sort in one channel.
_MOST_MARKED = 200


def faults_chart(recording: Recording, quality: Quality, title: str) -> Chart:
    """Describe the measured channels over time: a band over the rows of a fault, a point on a spike."""
    # Times restart at each run; rows do not.
    t = np.arange(len(recording)) * recording.sample_time
    border = np.flatnonzero(np.diff(recording.run)) + 1
    panels = []
    for name in [name for name in _shown(recording) if name not in recording.robot.set_points]:
        y = _values(recording, name)
        y[border] = np.nan
        curves = [Curve(t, y, colour=GREY, width=0.7)]
        for sort, colour in _FAULTS:
            if segments := getattr(quality.channels[name], sort)[:_MOST_MARKED]:
                rows = [np.arange(one.start, one.stop) for one in segments]
                curves.append(_marked(t, _values(recording, name), rows, sort, colour))
        panels.append(Panel(curves, f"{name.replace('_', ' ')} [{quality.channels[name].unit}]"))
    return Chart(title, panels, "time from the first row [s]", row_height=2.0)


def _marked(t: Vector, y: Vector, rows: Sequence[np.ndarray], sort: str, colour: str) -> Curve:
    """Return what marks rows of a fault: they are few, or hold no value that could be drawn otherwise."""
    if sort == "outliers":
        at = np.concatenate(rows)
        return Curve(t[at], y[at], _SHOWN[sort], colour, "points", 1.3)
    low, high = (float(np.nan_to_num(edge)) for edge in (np.nanmin(y, initial=0.0), np.nanmax(y, initial=0.0)))
    step = t[1] - t[0] if t.size > 1 else 1.0
    x = np.concatenate([[t[one[0]], t[one[-1]] + step, t[one[-1]] + step] for one in rows])
    gaps = np.tile([0.0, 0.0, np.nan], len(rows))
    return Curve(x, low + gaps, sort, colour, "band", upper=high + gaps)


def _shown(recording: Recording) -> list[str]:
    robot = recording.robot
    names = (*robot.set_points, *robot.motor_positions, *robot.outputs.names)
    return [name for name in names if name in recording.channels]


def _values(recording: Recording, name: str) -> Vector:
    """Return a channel in the unit of files; a copy."""
    return recording.channels[name] / to_si(file_unit(name, recording.robot))[0]


def quality_page(recording: Recording, quality: Quality, title: str) -> str:
    """Return the HTML text of a recording's quality: findings and tables."""
    bandwidth = quality.spectrum.bandwidth
    spectrum = f"Power of {', '.join(quality.spectrum.inputs)} (Welch, never across runs)."
    if not np.isnan(bandwidth):
        spectrum += f" What has none up to the bandwidth of {bandwidth:.3g} rad/s cannot be identified."
    faults = faults_chart(recording, quality, "What was measured, with the rows of each fault marked")
    sections = [
        Section("Findings", charts=[faults], findings=_findings(quality)),
        Section("Channels", tables=[_channels(quality)]),
        Section("Excitation", text=[spectrum, *quality.numbers()]),
    ]
    return page(
        title, sections, verdict=_verdict(recording, quality), holds=quality.severity != "warning",
        footer="Written by softneck info.",
    )  # fmt: skip


def _verdict(recording: Recording, quality: Quality) -> str:
    """Return in a sentence how good the recording is, and how long."""
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
    """Return each finding with where it is first seen."""
    return [
        (
            one.severity,
            str(one).removeprefix(f"{one.severity}: ")
            + (f" First at {one.time:.2f} s of its run." if one.time is not None and "at " not in one.message else ""),
        )
        for one in quality.findings
    ]


def _channels(quality: Quality) -> Table:
    head = ["channel", "lowest", "highest", "unit", "step", "noise", "missed", "frozen", "clipped", "spikes"]
    rows = []
    for name, channel in quality.channels.items():
        shown = channel.as_dict()
        counts = [str(shown[f"{sort}_rows"]) for sort in ("missed", "frozen", "clipped", "outliers")]
        numbers = [_number(shown[key]) for key in ("lowest", "highest")]
        tail = [_number(shown["quantum"]), "-" if channel.is_command else _number(shown["noise_std"])]
        rows.append([name, *numbers, channel.unit, *tail, *counts])
    return Table("Channels: steps and noise in the channel's unit, faults in rows", head, rows)


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3g}"
