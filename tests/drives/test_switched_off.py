"""The end of a run: guarding goes on until the last drive is disarmed, and done means that each said it is off."""

from __future__ import annotations

from dataclasses import replace

import pytest

from softneck.core import CheckFailedError
from softneck.drives import default_drives, preflight, simulated_neck, zero
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning._jog import jog_pilot
from softneck.drives.master import Frame, Phase
from softneck.drives.running._bus_loop import RunEnd, Session, run_session
from softneck.plant import NeckParameters

from .bench import FAST, FAULT, Bench
from .slow_answers import SlowAnswers

OFF = 0x40


def short_run(link: VirtualLink, profile: str) -> RunEnd:
    file = replace(default_drives(profile), ramps=FAST)
    return run_session(Session(file=file, link=link), jog_pilot(1, 0.1), sample_time=0.02, most=5.0)


def slow(profile: str, delay: float, *, homed: bool = True) -> SlowAnswers:
    file = default_drives(profile)
    return SlowAnswers(simulated_neck(file, NeckParameters.paper(), sample_time=0.02, homed=homed), delay)


@pytest.mark.parametrize("profile", ["ipos2015", "ds402"])
@pytest.mark.parametrize("delay", [0.03, 0.05])
def test_slow_answers_do_not_trip_a_drive_at_the_end_of_a_good_run(profile: str, delay: float) -> None:
    """Three times two writes of 30 or 50 ms are longer than the 100 ms after which a drive that nobody guards trips."""
    link = slow(profile, delay)
    ended = short_run(link, profile)
    ended.require()
    assert ended.master.supervisor.phase is Phase.DONE
    link.receive(0.5)
    # Nobody guards any more, and nobody trips for it.
    assert [(drive.axis.state, drive.axis.fault) for drive in link.neck.drives] == [(OFF, 0)] * 3


def test_slow_answers_do_not_trip_a_drive_while_it_is_zeroed() -> None:
    link = slow("ipos2015", 0.03, homed=False)
    file = default_drives()
    report = preflight(link, file)

    zero(link, file, lambda: link.newest, guarding=report.guarding)
    link.receive(0.5)
    assert [(drive.axis.state, drive.axis.fault) for drive in link.neck.drives] == [(OFF, 0)] * 3


def test_a_drive_that_does_not_confirm_its_end_is_no_done() -> None:
    link = VirtualLink(simulated_neck(default_drives(), NeckParameters.paper(), sample_time=0.02))
    # Node 2 answers no SDO once its guarding is to end (100Ch := 0).
    mute = []

    def lose(from_master: bool, frame: Frame) -> bool:
        if from_master and frame == Frame(0x602, bytes([0x2B, 0x0C, 0x10, 0, 0, 0, 0, 0])):
            mute.append(frame)
        return bool(mute) and not from_master and frame.identifier == 0x582

    link.lose = lose
    ended = short_run(link, "ipos2015")
    assert ended.table()["phase"] == "stopped"
    assert ended.table()["fault"]["event"] == "not_off"
    assert ended.table()["fault"]["node"] == 2
    with pytest.raises(CheckFailedError, match=r"\(node 2\): node 2 does not answer.*press the hardware stop"):
        ended.require()


def test_a_drive_that_trips_while_it_is_disarmed_is_named() -> None:
    link = VirtualLink(simulated_neck(default_drives(), NeckParameters.paper(), sample_time=0.02))

    def lose(from_master: bool, frame: Frame) -> bool:
        if from_master and frame == Frame(0x602, bytes([0x2B, 0x0C, 0x10, 0, 0, 0, 0, 0])):
            link.neck.drives[1].axis.trip(0x8130)
        return False

    link.lose = lose
    ended = short_run(link, "ipos2015")
    with pytest.raises(CheckFailedError, match=r"did not confirm that it is switched off \(node 2\): it is in FAULT"):
        ended.require()


def test_a_drive_that_stays_on_is_stopped_and_the_run_is_not_done() -> None:
    """Node 3 hears no more set-points: a second later its guarding ends, which it notices by itself."""
    bench = Bench().start()

    def deaf(from_master: bool, frame: Frame) -> bool:
        return from_master and frame.identifier == 0x203 and bench.phase in (Phase.DISABLING, Phase.STOPPING)

    bench.link.lose = deaf
    bench.master.finish()
    bench.finish(20.0)
    assert bench.phase is Phase.STOPPED
    assert bench.master.supervisor.fault is not None
    assert (bench.master.supervisor.fault.name, bench.master.supervisor.fault.node) == ("not_off", 3)
    bench.pass_time(0.3)
    assert bench.states[2] == FAULT
