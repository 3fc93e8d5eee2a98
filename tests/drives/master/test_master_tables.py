"""The master's numbers against the fault table, CiA 301 and the ranges that the settings promise, written by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest

from softneck.core import SettingsError
from softneck.drives.master import Frame, Phase
from softneck.drives.master._events import IDLE_TOO, RULES, Event, Reaction
from softneck.drives.master._fieldbus import BusSettings, Command, NodeState, nmt_frame, node_state
from softneck.drives.master._settings import (
    LimitSettings,
    MasterSettings,
    RampSettings,
    WatchSettings,
)
from softneck.drives.master._supervisor import ACTIVE, FINAL, GOALS, NEXT, Signal, Supervisor

# (class, field, default, least, most) as the fault table and the paper's neck need them.
RANGES = [
    (LimitSettings, "position", 6.0, 0.01, 100.0),
    (LimitSettings, "speed", 15.6, 0.01, 100.0),
    (LimitSettings, "acceleration", 1000.0, 0.1, 1e5),
    (LimitSettings, "tension", 12.0, 0.1, 200.0),
    (LimitSettings, "slack", 0.2, 0.0, 50.0),
    (LimitSettings, "slack_unwind", 3.0, 0.0, 20.0),
    (WatchSettings, "following", 1.5, 0.01, 20.0),
    (WatchSettings, "tilt", math.radians(12.0), 0.01, 1.6),
    (WatchSettings, "gain", 0.483 / 5.293, 0.001, 2.0),
    (WatchSettings, "pole", 5.293, 0.1, 100.0),
    (WatchSettings, "pushed", 0.5, 0.05, 200.0),
    (RampSettings, "speed", 1.0, 0.01, 10.0),
    (RampSettings, "settle", 1.0, 0.0, 60.0),
    (RampSettings, "tolerance", 0.05, 1e-3, 1.0),
    (BusSettings, "cycle", 0.01, 0.005, 0.05),
]


@pytest.mark.parametrize(
    ("kind", "name", "default", "least", "most"), RANGES, ids=[f"{row[0].__name__}.{row[1]}" for row in RANGES]
)
def test_each_setting_has_its_default_and_its_range(kind: Any, name: str, default: Any, least: Any, most: Any) -> None:
    assert getattr(kind(), name) == default
    assert getattr(kind(**{name: least}), name) == least
    assert getattr(kind(**{name: most}), name) == most
    step = 1 if isinstance(default, int) else 1e-6
    for wrong in (least - step, most + step, math.nan):
        with pytest.raises(SettingsError, match=f"`{name}"):
            kind(**{name: wrong})


def test_the_settings_without_a_range_have_their_defaults() -> None:
    third = 2.0 * math.pi / 3.0
    assert WatchSettings().tendon_angles == (0.0, third, 2.0 * third)
    made = MasterSettings(counts_per_radian=(1.0, 1.0, 1.0))
    assert (made.newton_per_unit, made.zero_counts, made.sample_cycles) == ((0.0, 0.0, 0.0), 1, 2)
    bus = made.bus
    assert (bus.nodes, bus.guarding, bus.guard_cycles, bus.master) == ((1, 2, 3), "life", 2, 127)
    assert (bus.silent_cycles, bus.missing_cycles, bus.answer_time, bus.stalled_cycles) == (3, 5, 0.25, 5)
    for cycles in (1, 20):
        MasterSettings(counts_per_radian=(1.0, 1.0, 1.0), sample_cycles=cycles)
    assert made.angle == 1.2
    for angle in (0.0999, 1.601, math.nan):
        with pytest.raises(SettingsError, match="`angle`"):
            MasterSettings(counts_per_radian=(1.0, 1.0, 1.0), angle=angle)
    for cycles in (0, 21):
        with pytest.raises(SettingsError, match="sample_cycles"):
            MasterSettings(counts_per_radian=(1.0, 1.0, 1.0), sample_cycles=cycles)
    for node in (1, 126):
        BusSettings(nodes=(node, 2, 3))
    for node in (0, 127):
        with pytest.raises(SettingsError, match="node"):
            BusSettings(nodes=(1, 2, node))


def test_the_rules_are_those_of_the_fault_table() -> None:
    """Reaction and deadline (cycles, seconds) of each row, as the project's fault table states them."""
    stop, retreat, count, hold = Reaction.STOP, Reaction.RETREAT, Reaction.COUNT, Reaction.HOLD
    expected = {
        "setpoint_missing": (hold, 2, 0.0), "setpoint_lost": (stop, 5, 0.0), "bus_off": (stop, 1, 0.0),
        "bus_silent": (stop, 3, 0.0), "emergency": (stop, 2, 0.0), "drive_fault": (stop, 2, 0.0),
        "drive_left": (stop, 2, 0.0), "node_left": (stop, 0, 0.3), "tpdo_missing": (stop, 5, 0.0),
        "heartbeat_missing": (stop, 0, 0.3), "boot_up": (stop, 2, 0.0), "second_master": (stop, 1, 0.0),
        "tpdo_twice": (count, 1, 0.0), "node_twice": (stop, 0, 0.5), "frame_length": (count, 1, 0.0),
        "sensor_lost": (retreat, 0, 0.1), "sensor_frozen": (retreat, 0, 0.1), "sensor_bad": (stop, 1, 0.0),
        "sample_discarded": (count, 1, 0.0), "controller_failed": (stop, 1, 0.0), "clamped": (count, 1, 0.0),
        "clamp_persistent": (stop, 0, 1.0), "drive_limit": (count, 1, 0.0), "following": (stop, 0, 0.2),
        "diverged": (stop, 0, 0.2), "tension": (stop, 0, 0.2), "pushed": (stop, 0, 0.2), "stalled": (stop, 1, 0.0),
        "motor_jammed": (stop, 0, 0.5), "encoder_slip": (stop, 0, 0.5), "position_bad": (stop, 0, 0.5),
        "current_scale": (stop, 0, 0.5), "gear_wrong": (stop, 0, 0.5), "tilt_unexplained": (stop, 0, 4.0),
        "astray": (stop, 0, 0.5),
        "sensor_reversed": (stop, 0, 0.5), "sensor_swapped": (stop, 0, 0.5), "sensor_stuck": (retreat, 0, 0.5),
        "sensor_late": (retreat, 0, 0.5), "sensor_noise": (retreat, 0, 0.5), "sensor_rate": (retreat, 0, 0.5),
        "sensor_drift": (retreat, 0, 4.0), "not_watched": (count, 0, 5.0),
        "late_cycle": (count, 1, 0.0), "clock": (stop, 1, 0.0), "loop_failed": (stop, 1, 0.0),
        "enable_timeout": (stop, 0, 2.0),
        "ramp_timeout": (stop, 0, 60.0), "not_off": (stop, 0, 1.0), "left": (count, 1, 0.0), "operator": (stop, 1, 0.0),
    }  # fmt: skip
    assert {name: (rule.reaction, rule.cycles, rule.seconds) for name, rule in RULES.items()} == expected
    # A drive that booted has lost its encoder's zero, and so has an encoder that slipped; nothing else loses it.
    assert [name for name, rule in RULES.items() if rule.rehome] == ["boot_up", "encoder_slip"]
    assert {"second_master", "bus_off", "boot_up", "operator", "emergency"} == IDLE_TOO


def test_phases_follow_each_other_as_the_table_says_and_in_no_other_way() -> None:
    P, S = Phase, Signal
    expected = {
        (P.IDLE, S.START): P.ENABLING, (P.ENABLING, S.ENABLED): P.RAMP_IN, (P.RAMP_IN, S.ARRIVED): P.RUNNING,
        (P.RAMP_IN, S.FINISH): P.RAMP_OUT, (P.RUNNING, S.FINISH): P.RAMP_OUT, (P.RAMP_OUT, S.ARRIVED): P.DISABLING,
        (P.RETREAT, S.ARRIVED): P.DISABLING, (P.DISABLING, S.OFF): P.DONE, (P.STOPPING, S.OFF): P.STOPPED,
        (P.IDLE, S.STOP): P.STOPPED, (P.ENABLING, S.RETREAT): P.STOPPING, (P.RAMP_IN, S.RETREAT): P.RETREAT,
        (P.RUNNING, S.RETREAT): P.RETREAT,
        **{(phase, S.STOP): P.STOPPING for phase in ACTIVE},
    }  # fmt: skip
    assert expected == NEXT
    assert set(P) - {P.IDLE, P.STOPPING} - FINAL == ACTIVE
    assert {P.DONE, P.STOPPED} == FINAL
    # Power is asked for in the phases that move and no others.
    moving = {P.ENABLING, P.RAMP_IN, P.RUNNING, P.RAMP_OUT, P.RETREAT}
    assert {phase for phase, goal in GOALS.items() if goal.name == "ENABLED"} == moving
    assert [phase for phase, goal in GOALS.items() if goal.name == "STOPPED"] == [P.STOPPING]
    assert set(GOALS) == set(P)


def test_the_first_fault_is_told_a_stop_goes_over_a_retreat_and_nothing_clears_either() -> None:
    supervisor = Supervisor()
    assert (supervisor.phase, supervisor.since, supervisor.fault, supervisor.rehome) == (Phase.IDLE, 0.0, None, False)
    supervisor.phase = Phase.RUNNING
    lost, stop = Event(1.0, "sensor_lost"), Event(1.1, "operator")
    assert supervisor.react(1.0, [lost]) == [lost]
    assert (supervisor.phase, supervisor.since, supervisor.fault) == (Phase.RETREAT, 1.0, lost)
    supervisor.react(1.1, [stop])
    assert (supervisor.phase, supervisor.since, supervisor.fault) == (Phase.STOPPING, 1.1, lost)
    assert not supervisor.rehome
    supervisor.react(1.2, [Event(1.2, "boot_up", 2)])
    assert supervisor.rehome
    # What comes later leaves it lost, and a phase that nothing leads out of stays.
    supervisor.react(1.3, [Event(1.3, "late_cycle")])
    assert supervisor.rehome
    assert supervisor.signal(1.4, Signal.OFF)
    assert not supervisor.signal(1.5, Signal.START)
    assert (supervisor.phase, supervisor.since) == (Phase.STOPPED, 1.4)


def test_guards_that_are_off_are_not_heard() -> None:
    supervisor = Supervisor(off=frozenset({"tension"}))
    supervisor.phase = Phase.RUNNING
    kept = supervisor.react(0.0, [Event(0.0, "tension"), Event(0.0, "late_cycle")])
    assert [event.name for event in kept] == ["late_cycle"]
    assert supervisor.phase is Phase.RUNNING
    assert supervisor.fault is None


def test_network_management_speaks_cia_301() -> None:
    """7.3.2.2.1: commands 1, 2, 128, 129, 130 on COB-ID 0; 7.2.8.3.2.2: states 0, 4, 5, 127, and a toggle bit."""
    numbers = {"START": 1, "STOP": 2, "PRE_OPERATIONAL": 128, "RESET_NODE": 129, "RESET_COMMUNICATION": 130}
    assert {command.name: command.value for command in Command} == numbers
    for name, number in numbers.items():
        assert nmt_frame(Command[name], 3) == Frame(0, bytes([number, 3]))
    states = {0: "BOOT_UP", 4: "STOPPED", 5: "OPERATIONAL", 127: "PRE_OPERATIONAL"}
    for code in range(128):
        for toggle in (0, 0x80):
            assert node_state(code | toggle) is NodeState[states.get(code, "UNKNOWN")]
