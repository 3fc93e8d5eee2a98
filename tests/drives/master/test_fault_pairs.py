"""Faults in random pairs at random times: whatever happens, it ends, nothing restarts, and twice the same."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from softneck.drives.master import Frame, Phase
from softneck.drives.master._fieldbus import BUS_OFF

from ..bench import DISABLED, ENABLED, FAULT, Bench


def _raise(_: object) -> None:
    raise RuntimeError("broken")


def _slow_tilt(bench: Bench) -> None:
    bench.neck.set(base_tilt_pitch=0.5)


def _bus_off(bench: Bench) -> None:
    bench.link._inbox.append(BUS_OFF)
    bench.link.cut = True


# What breaks, one line per row of the fault table; each ends the run within `LATEST`.
FAULTS: dict[str, Callable[[Bench], object]] = {
    "lost set-points": lambda b: setattr(b.pilot, "act", lambda _: None),
    "bus-off": _bus_off,
    "cable": lambda b: setattr(b.link, "cut", True),
    "drive fault": lambda b: b.neck.drives[0].axis.trip(0x4310),
    "emergency": lambda b: b.neck.drives[1].axis.emergencies.append((0x3210, 4)),
    "TPDO missing": lambda b: setattr(b.link, "lose", lambda _, frame: frame.identifier == 0x183),
    "guard answer missing": lambda b: setattr(
        b.link, "lose", lambda from_master, frame: not from_master and frame.identifier == 0x701
    ),
    "node leaves": lambda b: b.neck.drives[2]._command(b.now, 0x02),
    "sensor drops": lambda b: setattr(b.neck, "sensor", "drops"),
    "sensor freezes": lambda b: setattr(b.neck, "sensor", "freezes"),
    "NaN": lambda b: setattr(b.neck, "sensor", "nan"),
    "outlier": lambda b: setattr(b.neck, "sensor", "jumps"),
    "controller raises": lambda b: setattr(b.pilot, "act", _raise),
    "controller not finite": lambda b: setattr(b.pilot, "wanted", (math.inf, 0.0, 0.0)),
    "host hangs": lambda b: b.host_stopped(True),
    "second master": lambda b: b.link.inject.append(Frame(0x000, b"\x01\x00")),
    "motor blocked": lambda b: (b.neck.block(2), setattr(b.pilot, "wanted", (0.5, 2.5, -0.25))),
    "tilt diverges": _slow_tilt,
    "boot-up": lambda b: b.neck.drives[1].power_cycle(b.now),
    "supply of a drive fails": lambda b: setattr(b.neck.drives[0], "alive", False),
}
# The slowest: 20 frozen samples, and the following error of a motor that has 1.5 rad to go.
LATEST = 1.5


def play(names: tuple[str, str], times: tuple[float, float], seed: int = 0) -> Bench:
    bench = Bench(seed=seed).start()
    begin = bench.now
    for name, time in zip(names, times, strict=True):
        bench.at(begin + time, FAULTS[name])
    bench.pass_time(max(times) + LATEST)
    # A hung process comes back at last: it must not enable anything.
    bench.host_stopped(False)
    bench.finish(8.0)
    return bench


def safe(bench: Bench) -> None:
    """Over, told, off, and never on again."""
    assert bench.master.finished, bench.phase
    assert bench.master.supervisor.fault is not None
    bench.pass_time(0.3)
    bench.master.start()
    bench.link.cut = False
    bench.link.lose = None
    bench.pass_time(0.3)
    assert not bench.restarted
    for drive in bench.neck.drives:
        assert drive.axis.state in (DISABLED, FAULT) or not drive.alive
    assert bench.widest <= bench.file.limits.position


PAIRS = st.tuples(st.sampled_from(sorted(FAULTS)), st.sampled_from(sorted(FAULTS)))
TIMES = st.tuples(st.floats(0.0, 0.4), st.floats(0.0, 0.4))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(names=PAIRS, times=TIMES)
def test_pairs(names: tuple[str, str], times: tuple[float, float]) -> None:
    safe(play(names, times))


@pytest.mark.slow
@pytest.mark.nightly
@settings(max_examples=2000, deadline=None)
@given(names=PAIRS, times=TIMES, seed=st.integers(0, 1000))
def test_thousands_of_pairs(names: tuple[str, str], times: tuple[float, float], seed: int) -> None:
    safe(play(names, times, seed))


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(names=PAIRS, times=TIMES, seed=st.integers(0, 1000))
def test_the_same_seed_gives_the_same_trace(names: tuple[str, str], times: tuple[float, float], seed: int) -> None:
    first, second = play(names, times, seed), play(names, times, seed)
    assert first.trace.hexdigest() == second.trace.hexdigest()
    assert list(first.master.events) == list(second.master.events)


class Abuse(RuleBasedStateMachine):
    """Faults, repairs and commands in any order and at any time."""

    def __init__(self) -> None:
        super().__init__()
        self.bench = Bench()

    @initialize(started=st.booleans())
    def begin(self, started: bool) -> None:
        if started:
            self.bench.start()

    @rule(name=st.sampled_from(sorted(FAULTS)))
    def breaks(self, name: str) -> None:
        FAULTS[name](self.bench)

    @rule()
    def is_repaired(self) -> None:
        self.bench.link.cut = False
        self.bench.link.lose = None
        self.bench.neck.sensor = "works"
        self.bench.pilot.act = None
        self.bench.pilot.wanted = (0.2, 0.0, 0.0)
        self.bench.host_stopped(False)

    @rule()
    def is_started(self) -> None:
        self.bench.master.start()

    @rule()
    def is_finished(self) -> None:
        self.bench.master.finish()

    @rule(seconds=st.floats(0.01, 0.5))
    def time_passes(self, seconds: float) -> None:
        self.bench.pass_time(seconds)

    @invariant()
    def nothing_restarts(self) -> None:
        assert not self.bench.restarted

    @invariant()
    def what_is_over_stays_over(self) -> None:
        bench = self.bench
        if bench.phase is Phase.STOPPED and not bench.run.host_stopped:
            bench.pass_time(0.4)
            assert bench.phase is Phase.STOPPED
            if bench.pilot.started and not bench.run.host_stopped:
                assert not any(drive.axis.state == ENABLED and drive.alive for drive in bench.neck.drives)


@pytest.mark.slow
def test_abuse() -> None:
    run_state_machine_as_test(Abuse, settings=settings(max_examples=25, stateful_step_count=12, deadline=None))


@pytest.mark.slow
@pytest.mark.nightly
def test_much_abuse() -> None:
    run_state_machine_as_test(Abuse, settings=settings(max_examples=500, stateful_step_count=25, deadline=None))
