"""The master by itself: its tables, its clock, its limits, and frames that nobody should send."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.drives.master import Frame, Master, MasterSettings, Phase, Tilt, _master
from softneck.drives.master._cia402 import DriveState, Goal, control_word, state_of
from softneck.drives.master._events import RULES
from softneck.drives.master._limiter import Limiter
from softneck.drives.master._settings import LimitSettings
from softneck.drives.master._supervisor import NEXT, Signal
from softneck.drives.simulated import _axis as power

from ..bench import ENABLED, Bench, Script, T

FRAMES = st.lists(
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans(), st.booleans()), max_size=12
)


def new_master() -> Master:
    return Master(MasterSettings(counts_per_radian=(7717.5, 7717.5, -7717.5)), Script())


# -- tables -----------------------------------------------------------------------------------------------------------


def test_every_status_word_has_the_state_that_the_standard_gives_it() -> None:
    # CiA 402-2, table of the status word, bits 0 to 3, 5, 6 ("x" where 5 does not matter).
    known = {
        "x0xx0000": DriveState.NOT_READY, "x1xx0000": DriveState.DISABLED, "x01x0001": DriveState.READY,
        "x01x0011": DriveState.SWITCHED_ON, "x01x0111": DriveState.ENABLED, "x00x0111": DriveState.QUICK_STOP,
        "x0xx1111": DriveState.REACTION, "x0xx1000": DriveState.FAULT,
    }  # fmt: skip
    for word in range(256):
        bits = f"{word:08b}"
        fits = [state for text, state in known.items() if all(a in ("x", b) for a, b in zip(text, bits, strict=True))]
        assert state_of(word | 0x5600) is (fits[0] if fits else DriveState.UNKNOWN)


@pytest.mark.parametrize("goal", list(Goal))
def test_words_lead_each_drive_to_its_goal_and_never_elsewhere(goal: Goal) -> None:
    """Played against the drive's own table, which shares no code with ours."""
    ends = {
        Goal.OFF: {0x40},
        Goal.READY: {0x21},
        Goal.ENABLED: {ENABLED},
        Goal.STOPPED: {0x40, 0x07},
        Goal.RESET: {0x40},
    }
    for start in (0x40, 0x21, 0x23, 0x27, 0x07):
        state = start
        for _ in range(5):
            state = power.next_state(state, control_word(state_of(state), goal))
            if goal is not Goal.ENABLED:
                # Nothing but the goal "enabled" ever enables.
                assert not (state == ENABLED and start != ENABLED)
        assert state in ends[goal] | ({0x40} if goal is Goal.READY and start == 0x07 else set()), (start, goal)


def test_only_the_reset_goal_acknowledges_a_fault() -> None:
    for goal in Goal:
        assert bool(control_word(DriveState.FAULT, goal) & 0x80) == (goal is Goal.RESET)
    assert Goal.RESET not in {Goal.OFF, Goal.ENABLED, Goal.STOPPED}


def test_no_signal_leads_out_of_the_end() -> None:
    assert not [phase for phase, _ in NEXT if phase in (Phase.DONE, Phase.STOPPED)]
    assert {following for (phase, _), following in NEXT.items() if phase is Phase.STOPPING} == {Phase.STOPPED}
    for phase in (Phase.ENABLING, Phase.RAMP_IN, Phase.RUNNING, Phase.RAMP_OUT, Phase.RETREAT, Phase.DISABLING):
        assert NEXT[phase, Signal.STOP] is Phase.STOPPING


def test_every_rule_has_a_deadline() -> None:
    assert all(bool(rule.cycles) != bool(rule.seconds) for rule in RULES.values())


# -- clock ------------------------------------------------------------------------------------------------------------


def test_the_wall_clock_is_never_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A jump of the wall clock has no effect: nothing looks at it, in the same run to the last frame."""
    calm = Bench().start().pass_time(0.3).trace.hexdigest()

    def jumped() -> float:
        raise AssertionError("the wall clock was asked")

    monkeypatch.setattr(time, "time", jumped)
    monkeypatch.setattr(time, "time_ns", jumped)
    assert Bench().start().pass_time(0.3).trace.hexdigest() == calm


def test_a_monotonic_clock_that_goes_back_stops() -> None:
    bench = Bench().start()
    bench.master.step(bench.now - 0.5, [])
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.name == "clock"
    assert bench.phase is Phase.STOPPING


def test_a_late_cycle_is_counted_and_no_more() -> None:
    bench = Bench().start()
    bench.host_stopped(True)
    bench.step()
    bench.host_stopped(False)
    bench.pass_time(0.2)
    assert bench.master.counts["late_cycle"] == 1
    assert bench.phase is Phase.RUNNING


# -- begin and end ----------------------------------------------------------------------------------------------------


def test_drives_are_enabled_one_at_a_time_where_they_are() -> None:
    bench = Bench()
    bench.master.start()
    seen: list[int] = []
    while bench.phase is not Phase.RAMP_IN:
        bench.step()
        count = sum(state == ENABLED for state in bench.states)
        if not seen or seen[-1] != count:
            seen.append(count)
        for i, drive in enumerate(bench.neck.drives):
            if drive.axis.state == ENABLED:
                # A jump at enabling would be fast: the winch stays within what its tendon pulled it in a cycle or two.
                assert abs(bench.master.setpoints[i] - bench.master.positions[i]) < 0.3
    assert seen == [0, 1, 2, 3]


def test_a_run_ends_at_rest_with_drives_off() -> None:
    bench = Bench(rows=20)
    bench.start().finish(6.0)
    assert bench.phase is Phase.DONE
    assert bench.master.supervisor.fault is None
    assert bench.states == [0x40, 0x40, 0x40]
    assert max(map(abs, bench.master.positions)) < 0.2


def test_an_operator_stops_in_the_same_cycle() -> None:
    bench = Bench().start()
    bench.master.stop("key")
    assert bench.phase is Phase.STOPPING
    assert "stopped by the operator" in str(bench.master.supervisor.fault)


def test_a_drive_that_cannot_be_enabled_ends_the_run() -> None:
    bench = Bench()
    bench.link.lose = lambda _, frame: frame.identifier == 0x203
    bench.master.start()
    bench.finish(6.0)
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.name == "enable_timeout"
    assert bench.now < 2.0


def test_a_ramp_that_does_not_end_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_master, "_RAMP_TIME", 1.0)

    def short(given: MasterSettings) -> MasterSettings:
        return replace(given, ramps=replace(given.ramps, tolerance=0.001))

    bench = Bench(change=short)
    bench.neck.block(3)
    bench.master.start()
    bench.finish(8.0)
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.name in ("ramp_timeout", "following")


def test_without_a_sensor_nothing_is_ramped() -> None:
    bench = Bench()
    bench.neck.sensor = "drops"
    bench.master.start()
    bench.finish(3.0)
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.name == "sensor_lost"
    assert bench.phase is Phase.STOPPED


def test_the_drive_backs_up_the_position_limit() -> None:
    """Set-points that bypass ours: 607Dh holds the drive, it says FF06h, and that is no fault."""
    bench = Bench(off=frozenset({"following", "second_master"})).start()
    limit = bench.file.limits.position
    axis = bench.neck.drives[0].axis
    axis.values[(0x607D, 2)] = 5000
    axis._configure()
    bench.pilot.wanted = (2.0, -0.25, -0.25)
    bench.pass_time(1.0)
    assert bench.master.counts["drive_limit"] >= 1
    assert bench.master.positions[0] < 5000 / 7717.5 + 0.05 < limit
    assert bench.phase is Phase.RUNNING


def test_the_drive_watches_its_following_error() -> None:
    bench = Bench(off=frozenset({"following", "emergency", "drive_fault", "drive_left"})).start()
    bench.neck.block(1)
    bench.pilot.wanted = (3.5, -0.25, -0.25)
    bench.pass_time(1.5)
    assert bench.neck.drives[0].axis.fault == 0x8611


# -- fuzzing ----------------------------------------------------------------------------------------------------------


@given(cycles=st.lists(FRAMES, max_size=6), begun=st.booleans())
def test_no_frame_crashes_the_master(cycles: list[list[Frame]], begun: bool) -> None:
    master = new_master()
    if begun:
        master.start()
    for k, frames in enumerate(cycles):
        for frame in master.step(k * T, frames, Tilt(0.0, 0.001 * k)):
            assert 0 <= frame.identifier <= 0x7FF
            assert len(frame.data) <= 8


@pytest.fixture(scope="module")
def running() -> Bench:
    return Bench(off=frozenset(RULES)).start()


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    frames=FRAMES, tilt=st.none() | st.builds(Tilt, st.floats(), st.floats(), st.floats(), st.floats(), st.booleans())
)
def test_no_frame_and_no_sample_crash_a_run(running: Bench, frames: list[Frame], tilt: Tilt | None) -> None:
    """All guards are off, so that it goes on through everything."""
    running.link.pass_time()
    frames_out = running.master.step(running.now, frames, tilt)
    assert all(0 <= frame.identifier <= 0x7FF and len(frame.data) <= 8 for frame in frames_out)
    assert all(math.isfinite(value) for value in running.master.setpoints)


@given(
    wanted=st.lists(st.floats(-20.0, 20.0), min_size=1, max_size=60),
    tension=st.floats(0.5, 3.0),
    acceleration=st.floats(50.0, 2000.0),
)
def test_set_points_keep_every_limit(wanted: list[float], tension: float, acceleration: float) -> None:
    limits = LimitSettings(position=6.0, speed=15.6, acceleration=acceleration)
    limiter = Limiter(limits, T)
    before, speed = 0.0, 0.0
    for value in wanted:
        now = limiter.step(value, tension)
        assert abs(now) <= 6.0 + 1e-12
        assert abs(now - before) <= 15.6 * T + 1e-9
        # Position comes before acceleration: at the very limit the set-point stops where it is.
        if abs(now) < 6.0:
            assert abs((now - before) / T - speed) <= acceleration * T + 1e-6
        before, speed = now, (now - before) / T


def test_a_limiter_comes_to_rest_where_it_is_asked() -> None:
    limiter = Limiter(LimitSettings(acceleration=100.0), T)
    path = [limiter.step(3.0, 1.0) for _ in range(200)]
    assert path[-1] == pytest.approx(3.0, abs=1e-6)
    # One cycle's worth of braking too late is the most that it may overshoot: a T^2 / 2.
    assert max(path) <= 3.0 + 100.0 * T * T


def test_a_hanging_tendon_is_not_let_out_for_ever() -> None:
    limiter = Limiter(LimitSettings(slack_unwind=1.0), T)
    for _ in range(300):
        limiter.step(-5.0, 0.0)
    assert limiter.value == pytest.approx(-1.0, abs=1e-6)
    assert limiter.clamped == "slack"


def test_a_tight_tendon_is_not_pulled_further() -> None:
    limiter = Limiter(LimitSettings(tension=5.0), T)
    for _ in range(50):
        limiter.step(2.0, 4.5)
    assert limiter.value == 0.0
    assert limiter.clamped == "tension"
