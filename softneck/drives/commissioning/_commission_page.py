"""The page of a commissioning: what was found first, then the numbers, then each motor's moves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softneck.plots import Chart, Curve, Level, Panel, Section, Table, page

from ..bus._write import drives_table
from ._commission import Commissioned, motor_table
from ._features import Features
from ._findings import Finding
from ._moves import SWEEP, WIGGLE, MotorMoves

_BLUE, _ORANGE = "#0072B2", "#D55E00"
_UNTOUCHED = "As the files say: nothing to correct."


def commission_page(result: Commissioned, *, title: str = "Commissioning") -> str:
    """Return one self-contained page."""
    sections = [_verdict(result), _proposal(result)]
    if result.identified is not None and result.moves is not None:
        sections += [_motors(result), _sensor(result)]
        for moved in result.moves.motors:
            one = result.identified.motors[moved.motor - 1]
            if one is not None:
                sections.append(_moves(result, moved, one))
    said = f"{len(result.findings)} thing(s) to correct: see the findings." if result.findings else _UNTOUCHED
    if result.moves is None:
        said = "Nothing was moved: the findings have to be put right first."
    elif result.moves.stopped:
        said = f"The moves ended early: {result.moves.stopped}."
    clean = not result.findings and result.moves is not None and not result.moves.stopped
    return page(title, sections, verdict=said, holds=clean, footer="Written by softneck drives commission.")


def _verdict(result: Commissioned) -> Section:
    return Section("Findings", findings=[("note", _sentence(one)) for one in result.findings] or [("ok", _UNTOUCHED)])


def _sentence(one: Finding) -> str:
    others = "".join(f"; or {other}, which no move can tell from it" for other in one.instead)
    said = f"{one}{others}. {one.advice}"
    return said[0].upper() + said[1:]


def _proposal(result: Commissioned) -> Section:
    """List the keys that the proposed files change."""
    before, after = drives_table(result.believed), drives_table(result.file)
    rows = []
    for j, (old, new) in enumerate(zip(before["drive"], after["drive"], strict=True), start=1):
        rows += [[f"[[drive]] {j} {key}", _cell(old.get(key)), _cell(value)]
                 for key, value in new.items() if old.get(key) != value]  # fmt: skip
    axes = [", ".join(table["sensor"].get("axes", [])) or "as they come" for table in (before, after)]
    if axes[0] != axes[1]:
        rows.append(["[sensor] axes", *axes])
    given, right = result.believed.moves, result.robot
    rows += [
        [f"robot: {key}", _cell(old), _cell(value)]
        for key, old, value in (
            ("[motors] sign", given.motors.sign, right.motors.sign),
            ("[sensor] noise_std", given.noise_std, right.noise_std),
            ("[sensor] delay_s", given.delay_s, right.delay_s),
        )
        if old != value
    ]
    text = ["Slack and friction stand in no file: they are below, and in the JSON."]
    text += [] if rows else ["The proposed files say the same of drives and sensor as those that were given."]
    table = Table("What the proposed files change", ["key", "given", "proposed"], rows)
    return Section("Proposal", text, [table] if rows else [])


def _cell(value: Any) -> str:
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else f"{value:.6g}" if isinstance(
        value, float) else str(value)  # fmt: skip


def _motors(result: Commissioned) -> Section:
    rows = []
    for j in range(1, len(result.believed.drives) + 1):
        m = motor_table(result, j)
        if "tendon" not in m:
            rows.append([f"{j} (node {m['node']})", m["outcome"], *["-"] * 8])
            continue
        rows.append([
            f"{j} (node {m['node']})", f"tendon {m['tendon']}", "falls" if m["reversed"] else "rises",
            f"{m['gear']:.5g}",
            f"{m['encoder_counts']:.0f}{'' if m['index'] else ' (no index)'}", f"{m['peak_current_A']:g}",
            f"{m['slack_rad']:.2f}", f"{1e3 * m['friction_A']:.2f}", f"{m['tilt_deg_per_rad']:.2f}",
            f"{m['tension_N_per_rad']:.2f}",
        ])  # fmt: skip
    head = ["motor", "pulls", "as its count", "gear", "counts for a turn", "peak current [A]", "slack [rad]",
            "friction [mA]", "tilt [deg/rad]", "tension [N/rad]"]  # fmt: skip
    source = (
        "Gear and current are judged against what is expected of the robot: "
        + ("nothing stands for it, so motors were compared with each other, and a mistake that all share does not show."
           if result.expected is None else f"{result.expected.source}.")
    )  # fmt: skip
    return Section("Motors", [source], [Table("As they were found; radians of the winch", head, rows)])


def _sensor(result: Commissioned) -> Section:
    found = result.identified
    outputs = ", ".join(result.believed.moves.outputs.names)
    late = "-" if found is None or math.isnan(found.late) else f"{1e3 * found.late:+.0f}"
    noise = "-" if found is None or math.isnan(found.noise) else f"{math.degrees(found.noise):.3f}"
    axes = ", ".join(result.file.sensor_axes) or "as they come"
    text = [] if found is None or found.quiet else [
        "Its noise is beyond 0.15 deg: gears, currents and lateness were not judged."
    ]  # fmt: skip
    head = ["outputs", "are the sensor's", "noise [deg]", "later than expected [ms]"]
    return Section("Sensor", text, [Table("As it was found", head, [[outputs, axes, noise, late]])])


def _moves(result: Commissioned, moved: MotorMoves, one: Features) -> Section:
    entry = next(made for made in result.file.drives if made.node == moved.node)
    counts = abs(entry.scale.counts_per_radian)
    rows = moved.rows(SWEEP)
    x = one.pull * (moved.counts[rows] - moved.counts[0]) / counts
    tilt = np.degrees((moved.outputs[rows] - np.nanmean(moved.outputs[:20], axis=0)) @ one.direction)
    knee = [Level(one.slack / counts, "taut from here on", vertical=True)]
    slow = Chart(
        f"Motor {moved.motor}: slow, out of the slack and back",
        [
            Panel([Curve(x, tilt, "tilt", _BLUE, "points")], "tilt [deg]", levels=knee),
            Panel([Curve(x, one.pull * moved.current[rows], "current", _ORANGE, "points")], "current [units]",
                  levels=knee),
        ],
        x_label="winch [rad]",
        caption="Above the knee the tendon is taut. Friction is half of what the current's two branches are apart.",
    )  # fmt: skip
    rows = moved.rows(WIGGLE)
    time = moved.time[rows] - moved.time[rows][0]
    x = one.pull * (moved.counts[rows] - moved.counts[0]) / counts
    tilt = np.degrees((moved.outputs[rows] - np.nanmean(moved.outputs[:20], axis=0)) @ one.direction)
    quick = Chart(
        f"Motor {moved.motor}: the wiggle",
        [
            Panel([Curve(time, x, "winch", _ORANGE)], "winch [rad]"),
            Panel([Curve(time, tilt, "tilt", _BLUE)], "tilt [deg]"),
        ],
        caption=f"The tilt is {1e3 * one.lag:.0f} ms behind the winch.",
    )
    return Section(f"Motor {moved.motor}", charts=[slow, quick])
