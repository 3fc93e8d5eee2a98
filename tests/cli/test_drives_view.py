"""The live view of a drives run: each thing is on the screen, at its unit, and drawing changes nothing."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest
from rich.console import Console, RenderableType

from softneck.cli.drives._screen import from_line
from softneck.cli.drives._view import LiveView, live_view, picture_of
from softneck.cosim import load_loop
from softneck.drives import default_drives, prepare, run_simulated
from softneck.drives.bus._link import VirtualLink
from softneck.drives.logs._times import CycleFigures, CycleTimes
from softneck.drives.master import Event, Master
from softneck.drives.running._virtual import recorded

from ..drives.bench import Bench
from ..drives.conftest import STEP, Project
from ..drives.conftest import project as project  # the fixture

DEG = math.pi / 180.0


def _drive(node: int, **changes: Any) -> dict[str, Any]:
    return {"node": node, "state": "enabled", "state_style": "green", "nmt": "operational", "nmt_style": "none",
            "word": 0x1237, "silent": 0, "emergency": 0, **changes}  # fmt: skip


def _picture(**changes: Any) -> dict[str, Any]:
    return {
        "title": "pi.npz", "duration": 4.0, "phase": "running", "phase_style": "bold green", "run_time": 1.5,
        "since": 3.5, "cycle": 350, "fault": None, "outputs": ["pitch", "roll"], "validity": math.nan,
        "angles": [(15.0 * DEG, 14.25 * DEG, 14.5 * DEG), (-3.0 * DEG, -2.5 * DEG, -2.75 * DEG)],
        "motors": [(1.5, 1.25, 6.0), (-0.75, -0.7, 1.25), (-0.625, -0.6, 11.5)], "tension_limit": 12.0,
        "drives": [_drive(node) for node in (1, 2, 3)], "times": "-", "cycles": 0, "period": 0.01,
        "events": [(2.0, "late_cycle", "a cycle came late", False)], "counts": {"late_cycle": 4, "clamped": 17},
        **changes,
    }  # fmt: skip


def render(picture: dict[str, Any], size: tuple[int, int] = (104, 32)) -> RenderableType:
    return from_line(json.dumps(picture).encode(), size)


def _text(picture: dict[str, Any]) -> str:
    return _drawn(render(picture))


def _drawn(what: RenderableType, width: int = 100) -> str:
    console = Console(record=True, width=width, file=io.StringIO())
    console.print(what)
    return console.export_text()


def test_everything_is_on_the_screen() -> None:
    text = _text(_picture(times=str(CycleFigures(0.010, 0.0125, 0.014, 101)), cycles=101))
    lines = [" ".join(line.strip("│ ").split()) for line in text.splitlines()]
    assert "pi.npz" in lines[0]
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
    fault = "a drive sent an emergency (node 2): code 2310h"
    drives = [_drive(1), _drive(2, state="fault", emergency=0x2310, silent=3), _drive(3)]
    unknown = [(math.nan, 14.25 * DEG, math.nan), (math.nan, -2.5 * DEG, math.nan)]
    text = _text(_picture(phase="stopped", fault=fault, events=[], drives=drives, angles=unknown, counts={}))
    assert fault in text
    assert any(line.strip("│ ").split() == ["node", "2", "fault", "operational", "1237h", "3", "2310h"]
               for line in text.splitlines())  # fmt: skip
    assert "counts  none" in text
    assert any(line.strip("│ ").split() == ["pitch", "-", "14.25", "-", "-"] for line in text.splitlines())
    assert not any("nan" in line for line in text.splitlines())


def test_a_small_terminal_shows_all_of_it() -> None:
    fault = "a drive sent an emergency (node 2): code 2310h"
    drives = [_drive(1), _drive(2, nmt="pre operational", state="switched on"), _drive(3)]
    full = _picture(fault=fault, events=[(3.4, "emergency", fault, True)] * 5, drives=drives)
    assert len(_drawn(render(full), 104).splitlines()) <= 31
    figures = CycleFigures(0.010, 0.0125, 0.014, 1000)
    drawn = _drawn(render({**full, "times": str(figures), "cycles": 1000}, (80, 24)), 80)
    lines = drawn.splitlines()
    assert len(lines) <= 24
    assert "…" not in drawn
    words = [" ".join(line.strip("│ ").split()) for line in lines]
    assert "motor set-point [rad] position [rad] lag [rad] tension [N] of limit" in words
    assert "node 2 switched on pre operational 1237h 0 -" in words
    assert "cycle [ms] p50 10.00 p99 12.50 max 14.00 due 10 late 4" in words
    assert sum("emergency a drive sent an emergency (node 2)" in line for line in words) == 5


@pytest.mark.parametrize("size", [(80, 24), (104, 32)])
def test_what_the_supervisor_says_fits_in_two_lines(size: tuple[int, int]) -> None:
    """It is the longest; a loop of two minutes has the longest head."""
    fault = str(Event(103.4, "gear_wrong", 1, "motor 1: the tilt moves as if the winch turned 0.5 times as far"))
    full = _picture(fault=fault, events=[(103.4, "gear_wrong", fault, True)] * 5, run_time=120.0, since=123.5,
                    duration=120.0, phase="stopping")  # fmt: skip
    lines = _drawn(render(full, size), size[0]).splitlines()
    assert len(lines) <= size[1]
    assert lines[-1].startswith("╰")
    said = " ".join(line.strip("│ ") for line in lines)
    assert fault in said


def test_markup_in_a_picture_is_text() -> None:
    assert "pi [1].npz" in _text(_picture(title="pi [1].npz"))


def test_a_watched_run_sends_the_same_frames_and_is_shown_as_it_is(project: Project) -> None:
    setup = load_loop(project.write_loop("short.toml", STEP, 2.0))
    runs = []
    for watched in (False, True):
        frames: list[Any] = []
        seen: list[tuple[int, dict[str, Any]]] = []
        times = CycleTimes(0.01)

        def watch(now: float, _in: Any, _out: Any, _tilt: Any, master: Master, seen=seen, times=times) -> None:
            seen.append((master.index, json.loads(json.dumps(picture_of(master, now, times)))))

        def record(link: VirtualLink, frames=frames) -> None:
            if not frames:
                frames.append(recorded(link))

        result = run_simulated(prepare(setup, project.controller), default_drives(), hook=record,
                               watches=(watch,) if watched else ())  # fmt: skip
        runs.append((result, frames[0], seen))
    (plain, frames, _), (result, watched_frames, seen) = runs
    assert watched_frames == frames
    assert len(frames) > 5000
    for name, values in plain.signals.signals.items():
        np.testing.assert_array_equal(values, result.signals[name])
    assert [picture["cycle"] for _, picture in seen] == list(range(1, result.cycles + 1))
    # What it shows while the loop runs is what the run's own log has.
    rows = {index: picture for index, picture in seen if picture["phase"] == "running" and index >= 0}
    last, log = [rows[i] for i in range(len(result.signals.time))], result.signals
    for k, axis in enumerate(("pitch", "roll")):
        for column, name in enumerate(("reference", "measured", "estimate")):
            shown = [picture["angles"][k][column] for picture in last]
            np.testing.assert_array_equal(shown, log[f"{axis}_{name}"])
    assert last[-1]["run_time"] == log.time[-1]
    end = seen[-1][1]
    assert (end["phase"], end["counts"]) == ("done", dict(result.counts))
    assert math.isnan(end["angles"][0][0])
    assert [event[2] for event in end["events"]] == [str(event) for event in result.events[-5:]]


def test_a_picture_does_not_change_with_the_run_and_tells_a_fault() -> None:
    bench, times = Bench().start(), CycleTimes(0.01)
    before = picture_of(bench.master, bench.now, times)
    kept = repr(before)
    # This pilot has no named signals: nothing is made up.
    assert all(math.isnan(row[0]) and math.isnan(row[2]) for row in before["angles"])
    assert [(drive["state"], drive["nmt"]) for drive in before["drives"]] == [("enabled", "operational")] * 3
    bench.master.stop("enough")
    bench.finish()
    after = picture_of(bench.master, bench.now, times)
    assert repr(before) == kept
    assert (after["phase"], after["counts"]["operator"]) == ("stopped", 1)
    assert "enough" in after["fault"]
    assert all(drive["state"] != "enabled" for drive in after["drives"])


def test_the_drawing_process_imports_nothing_of_the_drives() -> None:
    """It starts while a run begins: importing the drives costs seconds of processor time."""
    heavy = ("softneck.drives", "scipy", "control", "numba", "matplotlib", "pandas")
    code = f"import sys, softneck.cli.drives._screen; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_eight_pictures_a_second_and_the_cycles_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    ticks = iter(0.01 * k for k in range(1000))
    view = LiveView(title="pi.npz", clock=lambda: next(ticks))
    drawn: list[str] = []
    monkeypatch.setattr(view, "_draw", lambda: drawn.append(str(view._times and view._times.count)))
    for _ in range(200):
        view.watch(bench.now, (), (), None, bench.master)
    # At 0.00, 0.13, 0.26, ... s of the wall clock: the first of each eighth of a second.
    assert len(drawn) == 16
    assert drawn[:2] == ["0", "13"]


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
    bench = Bench()
    with LiveView(title="pi.npz", terminal=there) as view:
        bench.run.watches = (view.watch,)
        for _ in range(7):
            bench.step()
    with LiveView(title="pi.npz", terminal=there) as view:
        assert view._screen is not None
        view._screen.kill()
        view._screen.wait()
        view.watch(bench.now, (), (), None, bench.master)
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
