"""Logs of jog and record: replayed to the same decisions, kept when interrupted, and the same recording again."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from softneck.core import CheckFailedError, FileFormatError
from softneck.drives import (
    CanInclinometer,
    CanLink,
    Experiment,
    default_drives,
    jog,
    read_run_log,
    record_signal,
    replay,
    simulated_neck,
)
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning._jog import jog_pilot
from softneck.drives.commissioning._record import drive_limits
from softneck.drives.logs._run_log import RunLogger
from softneck.drives.master._settings import RampSettings
from softneck.drives.running._bus_loop import Session
from softneck.drives.running._timing import Ask, Operator
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings, serve
from softneck.plant import NeckParameters
from softneck.signals import Recording

FILE = default_drives()
PSI = (0.0, 2.0943951023931953, 4.1887902047863905)
EXPERIMENT = Experiment(signal="aprbs", limits=drive_limits(FILE), duration=5.0, seed=3, runs=2)


def virtual() -> VirtualLink:
    return VirtualLink(simulated_neck(FILE, NeckParameters.paper(), sample_time=0.02, homed=True))


def recorded(path: Path, *, link: VirtualLink | None = None, operator: Operator | None = None) -> Recording:
    with RunLogger(path, wait=True) as log:
        session = Session(file=FILE, link=link or virtual(), log=log, facts={"record": EXPERIMENT.facts()})
        done = record_signal([part for part, _ in EXPERIMENT.prepare_runs()], replace(session, operator=operator))
    assert done.recording is not None
    return done.recording


def equal(one: Recording, other: Recording) -> None:
    assert set(one.channels) == set(other.channels)
    np.testing.assert_array_equal(one.run, other.run)
    np.testing.assert_array_equal(one.time, other.time)
    for name, values in one.channels.items():
        np.testing.assert_array_equal(other.channels[name], values, err_msg=name)


@pytest.mark.slow
def test_an_experiment_is_computed_again_and_imported_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    recording = recorded(path)
    log = read_run_log(path)
    result = replay(log, Experiment.of(log.facts["record"]).pilot())
    result.require()
    # Two runs of 5 s with 3 s of pause between at 20 ms; the last question finds the end.
    assert result.answers == (250 + 150 + 250)
    equal(recording, log.recording())
    assert set(np.unique(recording.run)) == {1, 2}
    other = replay(log, replace(EXPERIMENT, seed=4).pilot())
    assert other.difference is not None
    assert other.difference.what == "the controller's answer"


@pytest.mark.slow
@pytest.mark.parametrize("ask", list(Ask))
def test_an_interrupted_experiment_keeps_its_log(tmp_path: Path, ask: Ask) -> None:
    path, link = tmp_path / "r.mcap", virtual()
    recording = recorded(path, link=link, operator=lambda: ask if 12.0 <= link.now < 12.015 else None)
    log = read_run_log(path)
    assert log.cut == ""
    replay(log, Experiment.of(log.facts["record"]).pilot()).require()
    equal(recording, log.recording())
    # Leaving on the way in is no stop, and replays as what it was.
    assert log.cycles[-1].phase == {Ask.LEAVE: "done", Ask.STOP: "stopped"}[ask]


def test_leaving_before_anything_moved_replays(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RunLogger(path, wait=True) as log:
        session = Session(file=FILE, link=virtual(), log=log, operator=lambda: Ask.LEAVE)
        jog(2, session, tendon_angles=PSI)
    replay(read_run_log(path)).require()


@pytest.mark.slow
def test_a_jog_replays(tmp_path: Path) -> None:
    path = tmp_path / "j.mcap"
    with RunLogger(path, wait=True) as log:
        jog(2, Session(file=FILE, link=virtual(), log=log), tendon_angles=PSI, amplitude=0.4)
    logged = read_run_log(path)
    assert logged.facts["jog"] == {"motor": 2, "amplitude": 0.4, "lowest": -0.4, "motors": 3}
    replay(logged, jog_pilot(2, 0.4)).require()
    assert replay(logged, jog_pilot(1, 0.4)).difference is not None


def test_facts_of_another_version_are_one_line() -> None:
    with pytest.raises(FileFormatError, match="the log's experiment does not fit this softneck"):
        Experiment.of({**EXPERIMENT.facts(), "colour": "red"})


# In real time: where neighbours take the processor for 30 ms, the run ends before it has begun.
@pytest.mark.slow
@pytest.mark.nightly
def test_a_jog_over_a_bus_of_python_can_replays(tmp_path: Path) -> None:
    """In real time; however well this machine keeps the cycles, the log gives the same decisions."""
    file = replace(FILE, ramps=RampSettings(speed=3.0, settle=0.1, tolerance=0.2), sensor_kind="can", sensor_node=10)
    path, ended, asked = tmp_path / "j.mcap", threading.Event(), []
    with can.Bus("jogged", interface="virtual") as theirs, can.Bus("jogged", interface="virtual") as ours:
        neck = SimulatedNeck(NeckParameters.paper(), SimulatedSettings(homed=True))
        server = threading.Thread(target=serve, args=(theirs, neck), kwargs={"stopped": ended.is_set})
        server.start()
        try:
            with RunLogger(path) as log:
                session = Session(
                    file=file, link=CanLink(ours, "virtual:jogged"), sensor=CanInclinometer(10), log=log,
                    operator=lambda: asked.append(1) or (Ask.STOP if len(asked) == 300 else None),
                )  # fmt: skip
                found = jog(1, session, tendon_angles=PSI)
        finally:
            ended.set()
            server.join()
    with pytest.raises(CheckFailedError, match=r"The drives are off"):
        found.require()
    log = read_run_log(path)
    assert len(log.cycles) == found.ended.master.cycle
    replay(log, jog_pilot(1, 0.5)).require()
