"""The master step by step: what it knows before the first frame, how it converts, counts, times and lets go."""

from __future__ import annotations

import struct
from dataclasses import replace
from types import SimpleNamespace

import pytest

from softneck.drives.master import Frame, Master, MasterSettings, Phase, Tilt
from softneck.drives.master._cia402 import DriveState
from softneck.drives.master._events import Event
from softneck.drives.master._fieldbus import BUS_OFF
from softneck.drives.master._supervisor import GOALS

from ..bench import Bench, Script, T

COUNTS = (7717.5, 7000.0, -7717.5)


def new_master(**changes: object) -> Master:
    settings = MasterSettings(counts_per_radian=COUNTS, newton_per_unit=(0.01, 0.02, -0.03))
    return Master(replace(settings, **changes), Script())  # pyright: ignore[reportArgumentType]


def tpdos(*, counts: tuple[int, int, int] = (1, 1, 1), current: int = 0, word: int = 0x1640) -> list[Frame]:
    return [Frame(0x181 + i, struct.pack("<Hih", word, counts[i], current)) for i in range(3)]


def test_states_are_the_bits_of_the_status_word() -> None:
    """CiA 402-2: bits 0 to 3 and 5, and bit 6 of a drive that must not be switched on."""
    assert {state.name: state.value for state in DriveState} == {
        "NOT_READY": 0b000_0000, "DISABLED": 0b100_0000, "READY": 0b010_0001, "SWITCHED_ON": 0b010_0011,
        "ENABLED": 0b010_0111, "QUICK_STOP": 0b000_0111, "REACTION": 0b000_1111, "FAULT": 0b000_1000, "UNKNOWN": 0xFF,
    }  # fmt: skip


def test_before_the_first_frame_it_knows_nothing_and_wants_nothing() -> None:
    master = new_master()
    zero = (0.0, 0.0, 0.0)
    assert (master.positions, master.tensions, master.setpoints, master.wanted) == (zero,) * 4
    assert (master.cycle, master.index, master.ran, master.finished) == (0, -1, False, False)
    assert (master.supervisor.phase, master.tilt, master.sample_due) == (Phase.IDLE, None, True)
    assert not master.counts
    assert not master.events
    assert master.requests == []
    assert master.taken == ()
    # What it sends at first leaves every drive without voltage, where it is as far as anybody knows: at no counts.
    sent = master.step(0.0, [])
    assert [frame.data for frame in sent[:3]] == [struct.pack("<Hi", 0, 0)] * 3
    # A sample is due in every other cycle.
    due = []
    for k in range(1, 7):
        due.append(master.sample_due)
        master.step(k * T, tpdos())
    assert due == [False, True] * 3
    assert master.cycle == 7


def test_counts_become_radians_and_currents_newtons_with_their_signs() -> None:
    master = new_master(zero_counts=101)
    master.step(0.0, tpdos(counts=(101 + 15435, 101 - 7000, 101 + 15435), current=50))
    assert master.positions == pytest.approx((2.0, -1.0, -2.0))
    assert master.tensions == pytest.approx((0.5, 1.0, -1.5))
    # Without power set-points are where the motors are: the targets are the counts.
    sent = master.step(T, tpdos(counts=(101 + 15435, 101 - 7000, 101 + 15435)))
    assert master.setpoints == pytest.approx(master.positions)
    assert [struct.unpack("<Hi", frame.data)[1] for frame in sent[:3]] == [101 + 15435, 101 - 7000, 101 + 15435]


@pytest.mark.parametrize(("gap", "told"), [(1.49, ""), (5.01, "stalled")])
def test_the_time_between_two_steps_is_judged_in_cycles(gap: float, told: str) -> None:
    bench = Bench().start()
    before = dict(bench.master.counts)
    bench.link.drain()
    now = bench.now - T + gap * T
    frames = [
        Frame(0x180 + drive.node, struct.pack("<Hih", 0x1637, round(p * k) + 1, 0))
        for drive, p, k in zip(
            bench.master.bus.drives, bench.master.positions, bench.master.settings.counts_per_radian, strict=True
        )
    ]
    bench.master.step(now, frames, bench.master.tilt)
    new = {name for name, count in bench.master.counts.items() if count != before.get(name, 0)}
    assert new & {"late_cycle", "stalled", "clock"} == ({told} if told else set())


def test_requests_are_taken_in_the_next_step_and_once() -> None:
    master = new_master()
    master.start()
    master.leave("why")
    assert master.requests == [("start", ""), ("leave", "why")]
    master.step(0.0, tpdos(), Tilt(0.0, 0.0))
    assert master.taken == (("start", ""), ("leave", "why"))
    assert master.requests == []
    master.step(T, tpdos())
    assert master.taken == ()


def test_leaving_before_anything_moves_is_a_stop_and_in_a_run_the_ramp_out() -> None:
    idle = new_master()
    idle.leave("gone")
    assert idle.supervisor.phase is Phase.STOPPED
    bench = Bench().start()
    bench.master.leave("home")
    bench.step()
    assert bench.phase is Phase.RAMP_OUT
    assert bench.master.counts["left"] == 1
    # Asked again on its way it goes on.
    bench.master.leave("again")
    bench.step()
    assert bench.phase is Phase.RAMP_OUT
    assert bench.finish(8.0).phase is Phase.DONE
    assert bench.master.supervisor.fault is None


def test_set_points_run_straight_between_samples_and_the_last_holds() -> None:
    """Two cycles a sample: half of the way in the first, all of it in the second."""
    bench = Bench().start()
    bench.pilot.wanted = (0.52, -0.26, -0.26)
    while not bench.master.sample_due:
        bench.step()
    before = bench.master.setpoints
    bench.step()
    half = bench.master.setpoints
    bench.step()
    assert half == pytest.approx([0.5 * (a + b) for a, b in zip(before, bench.pilot.wanted, strict=True)], abs=1e-9)
    assert bench.master.setpoints == pytest.approx(bench.pilot.wanted, abs=1e-9)
    assert bench.master.ran is False
    bench.step()
    assert bench.master.ran is True
    index = bench.master.index
    bench.step()
    bench.step()
    assert bench.master.index == index + 1


def test_what_is_counted_is_kept_once_and_the_last_thousand_events() -> None:
    master = new_master()
    for _ in range(3):
        master._record_event(Event(0.0, "late_cycle"))
    assert master.counts["late_cycle"] == 3
    assert [event.name for event in master.events] == ["late_cycle"]
    for _ in range(1500):
        master.stop("x")
    assert len(master.events) == 1000


def test_every_phase_has_a_goal_of_its_own_for_drives_enabled_one_by_one() -> None:
    assert set(GOALS) == set(Phase)
    bench = Bench()
    bench.master.start()
    seen = []
    while bench.phase in (Phase.IDLE, Phase.ENABLING):
        bench.step()
        names = tuple(goal.name for goal in bench.master._goals())
        if not seen or seen[-1] != names:
            seen.append(names)
    on, off = "ENABLED", "OFF"
    assert seen == [(on, off, off), (on, on, off), (on, on, on)]


def test_waiting_before_the_start_costs_no_time_of_what_follows() -> None:
    """Every time-out counts from the begin of its phase, not from that of the clock."""
    bench = Bench()
    bench.pass_time(5.0)
    assert bench.start().phase is Phase.RUNNING
    assert bench.master.supervisor.fault is None


def test_a_drive_that_does_not_enable_is_given_its_second_and_no_more() -> None:
    bench = Bench()
    bench.pass_time(1.5)
    bench.link.lose = lambda _, frame: frame.identifier == 0x202
    begin = bench.now
    bench.master.start()
    bench.finish(6.0)
    fault = bench.master.supervisor.fault
    assert fault is not None
    assert (fault.name, fault.node) == ("enable_timeout", 2)
    # The first drive takes a few cycles, the second its second.
    assert 1.0 < fault.time - begin < 1.15


@pytest.mark.parametrize(
    ("frame", "told"),
    [(Frame(0x080), "second_master"), (BUS_OFF, "bus_off"), (Frame(0x701, b"\0"), "boot_up"),
     (Frame(0x082, b"\x10\x23\x01\0\0\0\0\0"), "emergency"), (Frame(0x181, b"\0"), ""),
     (Frame(0, b"\x08", error=True), "")],
)  # fmt: skip
def test_before_the_start_another_master_a_lost_bus_or_zero_and_an_emergency_end_it_and_nothing_else_counts(
    frame: Frame, told: str
) -> None:
    master = new_master()
    master.step(0.0, [frame])
    assert dict(master.counts) == ({told: 1} if told else {})
    fault = master.supervisor.fault
    assert (fault.name if fault else "", master.supervisor.phase) == (told, Phase.STOPPED if told else Phase.IDLE)


@pytest.mark.parametrize("left", [0, 1, 2])
@pytest.mark.parametrize("phase", [Phase.ENABLING, Phase.RUNNING, Phase.DISABLING])
def test_a_drive_that_was_enabled_and_is_no_more_stops_the_others_while_they_are_enabled(
    left: int, phase: Phase
) -> None:
    master = new_master()
    master.supervisor.phase, master._enabling = phase, 1
    for view in master.bus.drives:
        view.state = DriveState.ENABLED
    master.bus.drives[left].state = DriveState.READY
    master._watch(0.0, False, False, [])
    # In the phase of enabling the first drive alone was enabled; when they are switched off none must be.
    tells = phase is Phase.RUNNING or (phase is Phase.ENABLING and left == 0)
    assert master.counts["drive_left"] == tells
    fault = master.supervisor.fault
    assert (fault.name, fault.node) == ("drive_left", left + 1) if tells and fault else not tells


@pytest.mark.parametrize("fresh", [True, False])
@pytest.mark.parametrize("phase", [Phase.RAMP_IN, Phase.RUNNING])
def test_watches_get_a_sample_once_and_a_reference_only_in_a_run(fresh: bool, phase: Phase) -> None:
    master, asked = new_master(), {}
    master.supervisor.phase, master.reference = phase, (0.1, 0.2)
    master._gate.last = Tilt(0.3, 0.4)
    for view in master.bus.drives:
        view.state = DriveState.ENABLED
    quiet = {name: lambda *_: None for name in ("signs", "motors")}
    master._watches = SimpleNamespace(  # pyright: ignore[reportAttributeAccessIssue]
        **quiet, plausible=lambda *_, **told: asked.update(told), tilt=lambda *told: asked.update(values=told[3])
    )
    master._watch(0.0, True, fresh, [])
    last = master._gate.last if fresh else None
    assert (asked["sample"], asked["values"]) == (last, last and last.values)
    assert asked["reference"] == ((0.1, 0.2) if phase is Phase.RUNNING else ())


@pytest.mark.parametrize("phase", [Phase.DISABLING, Phase.STOPPING])
@pytest.mark.parametrize("state", [DriveState.READY, DriveState.ENABLED, DriveState.FAULT, DriveState.UNKNOWN])
@pytest.mark.parametrize("fresh", [True, False])
@pytest.mark.parametrize("last", [0, 2])
@pytest.mark.parametrize("late", [True, False])
def test_a_run_is_done_when_every_drive_says_now_that_it_is_off_and_a_stop_when_none_has_power(
    phase: Phase, state: DriveState, fresh: bool, last: int, late: bool
) -> None:
    master, events = new_master(), list[Event]()
    master.supervisor.phase = phase
    for view in master.bus.drives:
        view.state, view.fresh, view.silent = DriveState.DISABLED, True, 0
    view = master.bus.drives[last]
    view.state, view.fresh, view.silent = state, fresh, 0 if fresh else 6
    master._switch_off(1.01 if late else 1.0, events)  # voltage is off one second after a stop at the latest
    if phase is Phase.STOPPING:
        off = late or state is not DriveState.ENABLED or not fresh
        assert (master.supervisor.phase, events) == (Phase.STOPPED if off else phase, [])
        return
    off = state is DriveState.READY and fresh
    assert master.supervisor.phase is (Phase.DONE if off else phase)
    assert [(event.name, event.node) for event in events] == [("not_off", last + 1)] * (late and not off)


@pytest.mark.parametrize("heard", [True, False])
@pytest.mark.parametrize("silent", [0, 1])
@pytest.mark.parametrize("state", [DriveState.READY, DriveState.FAULT, DriveState.REACTION, DriveState.ENABLED])
@pytest.mark.parametrize("drive", [0, 2])
def test_after_a_stop_guarding_ends_while_one_drive_that_was_heard_may_have_power(
    heard: bool, silent: int, state: DriveState, drive: int
) -> None:
    """A drive that is silent now may brake or not: its own guarding switches it off."""
    master = new_master()
    for view in master.bus.drives:
        view.heard, view.silent, view.state = True, 0, DriveState.DISABLED
    view = master.bus.drives[drive]
    view.heard, view.silent, view.state = heard, silent, state
    assert not master.starved
    master.supervisor.phase = Phase.STOPPED
    unsure = silent > 0 or state in (DriveState.REACTION, DriveState.ENABLED)
    assert master.starved is (heard and unsure)
    master.supervisor.phase = Phase.DONE
    assert not master.starved


def test_a_drive_is_given_a_quarter_of_a_second_to_obey_a_stop_before_guarding_ends() -> None:
    master = new_master()
    master.supervisor.phase, master.supervisor.since = Phase.STOPPING, 1.0
    for now, starved in ((1.0, False), (1.25, False), (1.26, True)):
        master._now = now
        assert master.starved is starved
