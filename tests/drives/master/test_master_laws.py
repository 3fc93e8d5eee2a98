"""The parts of the master one by one: its words, its watches and their times, as standard and fault table say."""

from __future__ import annotations

import pytest

from softneck.drives.master import Phase
from softneck.drives.master._cia402 import DriveState, Goal, control_word
from softneck.drives.master._events import Event
from softneck.drives.master._settings import LimitSettings, WatchSettings
from softneck.drives.master._watches import Leaky, Patience, Watches
from softneck.drives.simulated import _axis as power

from ..bench import Bench, T

NODES = (1, 2, 3)


# -- control words ----------------------------------------------------------------------------------------------------


def test_every_control_word_is_the_one_of_the_standard() -> None:
    """By the bits of CiA 402-2: 0 switch on, 1 enable voltage, 2 no quick stop, 3 enable operation, 7 fault reset."""
    S = DriveState
    shutdown, switch_on, enable, quick_stop, reset = 0b0110, 0b0111, 0b1111, 0b0010, 0b1000_0000
    expected = {
        **{(state, Goal.READY): shutdown for state in (S.DISABLED, S.READY, S.SWITCHED_ON, S.ENABLED)},
        (S.DISABLED, Goal.ENABLED): shutdown, (S.READY, Goal.ENABLED): switch_on,
        (S.SWITCHED_ON, Goal.ENABLED): enable, (S.ENABLED, Goal.ENABLED): enable,
        **{(state, Goal.STOPPED): quick_stop for state in (S.ENABLED, S.QUICK_STOP, S.UNKNOWN)},
        (S.FAULT, Goal.RESET): reset,
    }  # fmt: skip
    for state in DriveState:
        for goal in Goal:
            assert control_word(state, goal) == expected.get((state, goal), 0), (state, goal)


def test_a_stop_brakes_under_power_before_the_voltage_goes() -> None:
    """Without quick stop a drive falls from enabled to disabled, and its motor is let go where it is."""
    assert power.next_state(power.ENABLED, control_word(DriveState.ENABLED, Goal.STOPPED)) == power.QUICK_STOP
    bench = Bench().start()
    bench.pilot.wanted = (3.0, -1.5, -1.5)
    bench.pass_time(0.05)
    bench.master.stop("test")
    seen: list[set[int]] = [set(), set(), set()]
    while bench.phase is not Phase.STOPPED:
        bench.step()
        for states, state in zip(seen, bench.states, strict=True):
            states.add(state)
    # All three were on their way, and none loses its power on it.
    assert all(power.QUICK_STOP in states for states in seen)


# -- times ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [0.05, 0.15])
def test_patience_ends_at_its_limit_and_begins_anew_after_a_pause(limit: float) -> None:
    patience = Patience(limit)
    cycles = round(limit / T)
    assert [patience.over(k * T, True) for k in range(cycles + 2)] == [False] * cycles + [True, True]
    assert not patience.over(1.0, False)
    assert [patience.over(1.0 + k * T, True) for k in range(1, cycles + 2)] == [False] * cycles + [True]


def test_what_leaks_fills_in_its_limit_and_empties_ten_times_as_slowly() -> None:
    limit, cycle = 0.3, 0.01
    leaky = Leaky(limit, cycle)
    # Full with the cycle in which the sum reaches the limit.
    assert [leaky.over(True) for _ in range(30)] == [False] * 29 + [True]
    # Ten cycles of calm take one cycle's worth off: then one cycle fills it again, and not before.
    for _ in range(5):
        assert [leaky.over(False) for _ in range(10)] == [False] * 10
        assert leaky.over(True)
    # 100 of calm take off ten.
    for _ in range(100):
        leaky.over(False)
    assert [leaky.over(True) for _ in range(10)] == [False] * 9 + [True]
    # It never owes calm time: after very long calm it is empty, not less.
    for _ in range(5000):
        leaky.over(False)
    assert [leaky.over(True) for _ in range(30)] == [False] * 29 + [True]


# -- watches ----------------------------------------------------------------------------------------------------------


def _spoken(watch: str, *, settings: WatchSettings, limits: LimitSettings, value: float) -> list[tuple[int, str, int]]:
    """Play 200 ms of one motor's `value`; return (cycle, name, node) of what was told."""
    watches, told = Watches(settings, limits), []
    for k in range(21):
        events: list[Event] = []
        rest = (0.0, 0.0, 0.0)
        given = (0.0, value, 0.0)
        if watch == "pushed":
            watches.signs(k * T, NODES, given, events)
        elif watch == "tension":
            watches.motors(k * T, rest, rest, NODES, given, events)
        else:
            watches.motors(k * T, given, rest, NODES, rest, events)
        told += [(k, event.name, event.node) for event in events]
    return told


@pytest.mark.parametrize(
    ("watch", "border"),
    [
        # The reference page's and drives.toml's numbers: half a newton of pushing, 12 N of tension, 1.5 rad.
        ("pushed", -0.5),
        ("tension", 12.0),
        ("tension", -12.0),
        ("following", 1.5),
        ("following", -1.5),
    ],
)
def test_a_watch_speaks_beyond_its_threshold_after_150_ms_and_not_within(watch: str, border: float) -> None:
    settings, limits = WatchSettings(), LimitSettings()
    told = _spoken(watch, settings=settings, limits=limits, value=1.01 * border)
    assert told == [(k, watch, 2) for k in range(15, 21)]
    assert _spoken(watch, settings=settings, limits=limits, value=0.99 * border) == []
    # A tendon that pulls does not push.
    if watch == "pushed":
        assert _spoken(watch, settings=settings, limits=limits, value=-10.0 * border) == []


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_thresholds_scale_with_their_settings(scale: float) -> None:
    settings = WatchSettings(pushed=0.5 * scale, following=1.5 * scale)
    limits = LimitSettings(tension=12.0 * scale)
    for watch, border in (("pushed", -0.5), ("tension", 12.0), ("following", 1.5)):
        assert _spoken(watch, settings=settings, limits=limits, value=1.01 * scale * border)
        assert not _spoken(watch, settings=settings, limits=limits, value=0.99 * scale * border)
