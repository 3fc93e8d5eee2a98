"""Snapshots for a live view: what is in them, and that a run does not notice that it is watched."""

from __future__ import annotations

import itertools
import math

import numpy as np

from softneck.cosim import load_loop
from softneck.drives import DrivesResult, Snapshots, default_drives, prepare, run_simulated
from softneck.drives.bus._link import VirtualLink
from softneck.drives.master import Frame, Master, Phase
from softneck.drives.master._cia301 import NodeState
from softneck.drives.master._cia402 import DriveState
from softneck.drives.running._snapshot import Snapshot
from softneck.drives.running._virtual import recorded

from ..bench import Bench
from ..conftest import STEP, Project


def _run(project: Project, *, watched: bool) -> tuple[DrivesResult, list[tuple[float, bool, Frame]], list[Snapshot]]:
    setup = load_loop(project.write_loop("short.toml", STEP, 2.0))
    frames: list[list[tuple[float, bool, Frame]]] = []
    seen: list[Snapshot] = []
    taker = Snapshots()

    def record(link: VirtualLink) -> None:
        if not frames:
            frames.append(recorded(link))

    def watch(now: float, _in: object, _out: object, _tilt: object, master: Master) -> None:
        seen.append(taker.take(master, now))

    deployed = prepare(setup, project.controller)
    result = run_simulated(deployed, default_drives(), hook=record, watches=(watch,) if watched else ())
    return result, frames[0], seen


def test_a_watched_run_sends_the_same_frames_and_shows_each_cycle(project: Project) -> None:
    plain, frames, _ = _run(project, watched=False)
    result, watched_frames, seen = _run(project, watched=True)
    assert watched_frames == frames
    assert len(frames) > 5000
    for name, values in plain.signals.signals.items():
        np.testing.assert_array_equal(values, result.signals[name])
    # One snapshot for each cycle, of that cycle.
    assert [item.cycle for item in seen] == list(range(1, result.cycles + 1))
    assert all(b.time > a.time for a, b in itertools.pairwise(seen))
    # What it shows while the loop runs is what the run's own log has.
    rows = {item.index: item for item in seen if item.phase is Phase.RUNNING and item.index >= 0}
    log = result.signals
    last = [rows[i] for i in range(len(log.time))]
    for k, axis in enumerate(("pitch", "roll")):
        np.testing.assert_array_equal([item.references[k] for item in last], log[f"{axis}_reference"])
        np.testing.assert_array_equal([item.estimates[k] for item in last], log[f"{axis}_estimate"])
        np.testing.assert_array_equal([item.angles[k] for item in last], log[f"{axis}_measured"])
    assert math.degrees(last[-1].references[0]) == np.degrees(log["pitch_reference"][-1])
    assert last[-1].run_time == log.time[-1]
    assert seen[-1].phase is Phase.DONE
    assert math.isnan(seen[-1].references[0])
    assert dict(seen[-1].counts) == dict(result.counts)
    assert seen[-1].events == result.events[-5:]


def test_a_snapshot_does_not_change_with_the_run_and_tells_a_fault() -> None:
    bench = Bench().start()
    taker = Snapshots()
    before = taker.take(bench.master, bench.now)
    kept = (before.counts, before.events, before.setpoints, before.drives)
    copied = (dict(before.counts), tuple(before.events), tuple(before.setpoints), tuple(before.drives))
    assert all(drive.state is DriveState.ENABLED and drive.nmt is NodeState.OPERATIONAL for drive in before.drives)
    # This pilot has no named signals: nothing is made up.
    assert all(math.isnan(value) for value in (*before.references, *before.estimates))
    bench.master.stop("enough")
    bench.finish()
    after = taker.take(bench.master, bench.now)
    assert kept == copied
    assert after.phase is Phase.STOPPED
    assert after.fault is not None
    assert after.fault.name == "operator"
    assert after.counts["operator"] == 1
    assert after.events[-1].detail == "enough"
    assert all(drive.state is not DriveState.ENABLED for drive in after.drives)
