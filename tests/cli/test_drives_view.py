"""The live view of a drives run: each thing is on the screen, at its unit, and drawing changes nothing."""

from __future__ import annotations

import io
import itertools
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from softneck.cli._drives_view import LiveView, live_view, render
from softneck.drives import DriveSnapshot, Snapshot
from softneck.drives.master import DriveState, Event, NodeState, Phase

DEG = math.pi / 180.0


def _snapshot() -> Snapshot:
    drives = tuple(DriveSnapshot(node, DriveState.ENABLED, NodeState.OPERATIONAL, 0x1237, 0, 0) for node in (1, 2, 3))
    return Snapshot(
        time=103.5,
        cycle=350,
        phase=Phase.RUNNING,
        index=75,
        references=(15.0 * DEG, -3.0 * DEG, 0.1),
        angles=(14.25 * DEG, -2.5 * DEG),
        estimates=(14.5 * DEG, -2.75 * DEG),
        setpoints=(1.5, -0.75, -0.625),
        positions=(1.25, -0.7, -0.6),
        tensions=(6.0, 1.25, 11.5),
        drives=drives,
        events=(Event(102.0, "late_cycle"),),
        counts={"late_cycle": 4, "clamped": 17},
        fault=None,
        period=0.01,
        sample_time=0.02,
        tension_limit=12.0,
    )


def _text(snapshot: Snapshot, cycles: np.ndarray | None = None) -> str:
    console = Console(record=True, width=100, file=io.StringIO())
    cycles = np.zeros(0) if cycles is None else cycles
    console.print(render(snapshot, cycles, begin=100.0, title="pi.npz", duration=4.0))
    return console.export_text()


def test_everything_is_on_the_screen() -> None:
    # 99 cycles of 10 ms and two of 14 ms: percentiles by hand.
    text = _text(_snapshot(), np.array([0.010] * 99 + [0.014] * 2))
    lines = [" ".join(line.strip("│ ").split()) for line in text.splitlines()]
    assert "pi.npz" in lines[0]
    # Sample 75 of 0.02 s; begun at 100 s of the clock.
    assert "running loop 1.50 of 4.0 s since start 3.50 s bus cycle 350" in lines
    # The units are there: rich would take [deg] in a string for markup.
    assert "angle [deg] reference measured estimate error" in lines
    assert "motor set-point [rad] position [rad] lag [rad] tension [N] of limit" in lines
    assert "pitch 15.00 14.25 14.50 0.75" in lines
    assert "roll -3.00 -2.50 -2.75 -0.50" in lines
    # A bar of 20: half of the limit of 12 N, a tenth, and 19 of 20.
    rows = (("1 1.500 1.250 0.250 6.0", 10), ("2 -0.750 -0.700 -0.050 1.2", 2), ("3 -0.625 -0.600 -0.025 11.5", 19))
    for start, filled in rows:
        assert f"{start} {'█' * filled}{'·' * (20 - filled)}" in lines
    for node in (1, 2, 3):
        assert f"node {node} enabled operational 1237h 0 -" in lines
    assert "cycle time [ms] p50 10.00 p99 14.00 max 14.00 (of 101 cycles, due 10) late cycles 4" in lines
    assert "2.00 s late_cycle a cycle came late" in lines
    assert "counts clamped 17 late_cycle 4" in lines
    assert any("tension: from the drives' current" in line for line in lines)


def test_a_fault_is_named_and_what_is_not_known_is_a_dash() -> None:
    fault = Event(103.4, "emergency", 2, "code 2310h")
    one, two, three = _snapshot().drives
    faulty = replace(two, state=DriveState.FAULT, emergency=0x2310, silent=3)
    unknown = math.nan
    stopped = replace(_snapshot(), phase=Phase.STOPPED, fault=fault, events=(fault,), drives=(one, faulty, three))
    text = _text(replace(stopped, references=(unknown,) * 3, estimates=(unknown, unknown), counts={}))
    assert "a drive sent an emergency (node 2): code 2310h" in text
    assert any(line.strip("│ ").split() == ["node", "2", "fault", "operational", "1237h", "3", "2310h"]
               for line in text.splitlines())  # fmt: skip
    assert "counts  none" in text
    assert any(line.strip("│ ").split() == ["pitch", "-", "14.25", "-", "-"] for line in text.splitlines())
    assert not any("nan" in line for line in text.splitlines())


@pytest.mark.parametrize("width", [40, 80, 200])
def test_no_width_breaks_it(width: int) -> None:
    console = Console(record=True, width=width, file=io.StringIO())
    console.print(render(_snapshot(), np.full(3, 0.01)))
    assert all(len(line) <= width for line in console.export_text().splitlines())


def test_the_view_shows_the_newest_and_counts_each_cycle() -> None:
    ticks = itertools.count()
    console = Console(record=True, width=100, file=io.StringIO())
    view = LiveView(console, title="pi.npz", clock=lambda: 0.01 * next(ticks))
    before = sys.getswitchinterval()
    with view:
        # More cycles than are kept: the last 1000 count.
        for k in range(1500):
            view.show(replace(_snapshot(), cycle=k))
        assert sys.getswitchinterval() < before
    assert sys.getswitchinterval() == before
    console.print(view.render())
    text = console.export_text()
    assert "bus cycle 1499" in text
    assert "p50 10.00   p99 10.00   max 10.00   (of 1000 cycles" in text


def test_without_a_terminal_or_a_wish_nothing_is_drawn(capsys: pytest.CaptureFixture[str]) -> None:
    for wanted in (True, False):
        with live_view("pi.npz", 4.0, wanted=wanted) as watch:
            assert watch is None
    assert capsys.readouterr() == ("", "")
