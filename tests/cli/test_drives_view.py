"""The live view of a drives run: each thing is on the screen, at its unit, and drawing changes nothing."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console, RenderableType

from softneck.cli.drives._screen import from_line
from softneck.cli.drives._view import LiveView, live_view, to_line
from softneck.drives.logs._times import CycleFigures, CycleTimes
from softneck.drives.master import Event, Phase
from softneck.drives.master._cia301 import NodeState
from softneck.drives.master._cia402 import DriveState
from softneck.drives.running._snapshot import DriveSnapshot, Snapshot

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


def _text(snapshot: Snapshot, times: CycleFigures | None = None) -> str:
    return _drawn(render(snapshot, times or CycleFigures(), begin=100.0, title="pi.npz", duration=4.0))


def render(snapshot: Snapshot, times: CycleFigures, *, size: tuple[int, int] = (104, 32), **more) -> RenderableType:
    return from_line(to_line(snapshot, times, **more), size)


def _drawn(what: RenderableType, width: int = 100) -> str:
    console = Console(record=True, width=width, file=io.StringIO())
    console.print(what)
    return console.export_text()


def test_everything_is_on_the_screen() -> None:
    text = _text(_snapshot(), CycleFigures(0.010, 0.0125, 0.014, 101))
    lines = [" ".join(line.strip("│ ").split()) for line in text.splitlines()]
    assert "pi.npz" in lines[0]
    # Sample 75 of 0.02 s; begun at 100 s of the clock.
    assert "running loop 1.50 of 4.0 s since start 3.50 s bus cycle 350 validity -" in lines
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
    assert "cycle time [ms] p50 10.00 p99 12.50 max 14.00 (of 101 cycles, due 10) late cycles 4" in lines
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


def test_a_small_terminal_shows_all_of_it() -> None:
    fault = Event(103.4, "emergency", 2, "code 2310h")
    one, two, three = _snapshot().drives
    drives = (one, replace(two, nmt=NodeState.PRE_OPERATIONAL, state=DriveState.SWITCHED_ON), three)
    full = replace(_snapshot(), fault=fault, events=(fault,) * 5, drives=drives)
    assert len(_drawn(render(full, CycleFigures(), begin=100.0), 104).splitlines()) <= 31
    drawn = _drawn(render(full, CycleFigures(0.010, 0.0125, 0.014, 1000), begin=100.0, size=(80, 24)), 80)
    lines = drawn.splitlines()
    assert len(lines) <= 24
    assert "…" not in drawn
    words = [" ".join(line.strip("│ ").split()) for line in lines]
    assert "motor set-point [rad] position [rad] lag [rad] tension [N] of limit" in words
    assert "node 2 switched on pre operational 1237h 0 -" in words
    assert "cycle [ms] p50 10.00 p99 12.50 max 14.00 due 10 late 4" in words
    assert sum("emergency a drive sent an emergency (node 2)" in line for line in words) == 5
    # As high as a large one may get: nothing is cropped there either.
    assert len(_drawn(render(full, CycleFigures(), begin=100.0), 104).splitlines()) <= 32


@pytest.mark.parametrize("size", [(80, 24), (104, 32)])
def test_what_the_supervisor_says_fits_in_two_lines(size: tuple[int, int]) -> None:
    """It is the longest; a loop of two minutes has the longest head."""
    fault = Event(103.4, "gear_wrong", 1, "motor 1: the tilt moves as if the winch turned 0.5 times as far")
    full = replace(_snapshot(), fault=fault, events=(fault,) * 5, index=6000, phase=Phase.STOPPING)
    lines = _drawn(render(full, CycleFigures(), begin=0.0, duration=120.0, size=size), size[0]).splitlines()
    assert len(lines) <= size[1]
    assert lines[-1].startswith("╰")
    said = " ".join(line.strip("│ ") for line in lines)
    assert str(fault) in said


def test_a_picture_is_one_line_and_markup_in_it_is_text() -> None:
    fault = Event(103.4, "emergency", 2, "code 2310h")
    stopped = replace(_snapshot(), phase=Phase.STOPPED, fault=fault, estimates=(math.nan, math.nan))
    line = to_line(stopped, CycleFigures(), title="pi [1].npz")
    assert line.count(b"\n") == 1
    assert "pi [1].npz" in _drawn(from_line(line))


def test_the_drawing_process_imports_nothing_of_the_drives() -> None:
    """It starts while a run begins: importing the drives costs seconds of processor time."""
    heavy = ("softneck.drives", "scipy", "control", "numba", "matplotlib", "pandas")
    code = f"import sys, softneck.cli.drives._screen; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_newest_snapshot_and_the_last_thousand_cycles_count() -> None:
    # 600 cycles of 20 ms, then 990 of 10 ms and ten of 14 ms: percentiles of the last 1000 by hand.
    gaps = [0.02] * 600 + [0.01] * 989 + [0.014] * 11
    ticks = iter([0.0, *itertools.accumulate(gaps)])
    view = LiveView(title="pi.npz", clock=lambda: next(ticks))
    assert view.line() is None
    for k in range(1601):
        view.show(replace(_snapshot(), cycle=k))
    line = view.line()
    assert line is not None
    text = _drawn(from_line(line))
    assert "bus cycle 1600" in text
    assert "p50 10.00   p99 14.00   max 14.00   (of 1000 cycles" in text


def test_the_figures_of_the_view_and_of_the_result_agree() -> None:
    times, now = CycleTimes(0.01), 0.0
    gaps = np.random.default_rng(0).uniform(0.009, 0.013, 900)
    times.take(now, 0.001)
    for gap in gaps:
        now += gap
        times.take(now, 0.001)
    whole, some = times.figures(), CycleFigures.of(gaps)
    # The histogram has bins of 10 us, and both take the sample next to the quantile: 900 samples over 4 ms.
    np.testing.assert_allclose(whole[:3], some[:3], rtol=0, atol=2.5e-5)
    assert whole.number == some.number == 900
    assert math.isnan(CycleTimes(0.01).figures().p50)
    assert CycleFigures.of(gaps[:0]).number == 0


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_the_last_picture_is_on_the_terminal_and_a_dead_screen_does_no_harm() -> None:
    here, there = os.openpty()
    drawn: list[bytes] = []

    def read() -> None:
        # Reading ends with an error when nobody has the other side open any more.
        with contextlib.suppress(OSError):
            while chunk := os.read(here, 65536):
                drawn.append(chunk)

    reader = threading.Thread(target=read)
    reader.start()
    with LiveView(title="pi.npz", terminal=there) as view:
        for k in range(8):
            view.show(replace(_snapshot(), cycle=k))
    with LiveView(title="pi.npz", terminal=there) as view:
        assert view._screen is not None
        view._screen.kill()
        view._screen.wait()
        view.show(_snapshot())
    os.close(there)
    reader.join(10.0)
    os.close(here)
    text = b"".join(drawn).decode()
    assert "bus cycle 7" in text
    assert "Traceback" not in text


def test_without_a_terminal_or_a_wish_nothing_is_drawn(capsys: pytest.CaptureFixture[str]) -> None:
    for wanted in (True, False):
        with live_view("pi.npz", 4.0, wanted=wanted) as watches:
            assert watches == ()
    assert capsys.readouterr() == ("", "")
