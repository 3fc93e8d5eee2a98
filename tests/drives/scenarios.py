"""The fault table's scenarios by name, each with the guards without which it must fail."""

from __future__ import annotations

from dataclasses import replace

from softneck.drives.bus._objects import Write
from softneck.drives.master import MasterSettings

from .fault_table import (
    Scenario,
    bus_off,
    cable,
    controller_not_finite,
    controller_raises,
    drive_boots,
    drive_leaves,
    drive_trips,
    emergency_alone,
    enable_input_opens,
    fault_without_emergency,
    guard_answer_missing,
    host_gone,
    host_hangs_and_resumes,
    host_stalls_shortly,
    lost_setpoints,
    motor_blocked,
    node_leaves,
    over_limit,
    positions_twice,
    second_master_guards,
    second_master_setpoints,
    second_master_sync,
    sensor_drops,
    sensor_freezes,
    sensor_jumps,
    sensor_nan,
    tendon_pulled,
    tilt_diverges,
    too_fast,
    tpdo_missing,
)


def set_off(*names: str) -> frozenset[str]:
    return frozenset(names)


def _low_tension(settings: MasterSettings) -> MasterSettings:
    return replace(settings, limits=replace(settings.limits, tension=4.5))


def _narrow(settings: MasterSettings) -> MasterSettings:
    return replace(settings, limits=replace(settings.limits, position=1.0))


_NO_LIFE = (Write(0x6007, 0, 0),)
SCENARIOS: dict[str, Scenario] = {
    "lost_setpoints": Scenario("lost set-points", lost_setpoints, set_off("setpoint_lost")),
    "bus_off": Scenario("bus-off, cable", bus_off, set_off("bus_off")),
    "cable": Scenario("bus-off, cable", cable, set_off("bus_silent")),
    "cable_drive_side": Scenario("bus-off, cable", cable, drive_guard=_NO_LIFE),
    "drive_trips": Scenario("drive EMCY or Fault", drive_trips, set_off("emergency", "drive_fault", "drive_left")),
    "emergency_alone": Scenario("drive EMCY or Fault", emergency_alone, set_off("emergency")),
    "fault_without_emergency": Scenario("drive EMCY or Fault", fault_without_emergency, set_off("drive_fault")),
    "drive_leaves": Scenario("drive EMCY or Fault", drive_leaves, set_off("drive_left")),
    "enable_input_opens": Scenario("drive EMCY or Fault", enable_input_opens, set_off("emergency")),
    "tpdo_missing": Scenario("TPDO or heartbeat missing", tpdo_missing, set_off("tpdo_missing")),
    "guard_answer_missing": Scenario("TPDO or heartbeat missing", guard_answer_missing, set_off("heartbeat_missing")),
    "node_leaves": Scenario(
        "TPDO or heartbeat missing", node_leaves, set_off("node_left"), others_off=set_off("tpdo_missing")
    ),
    "sensor_drops": Scenario("inclinometer dropout, or frozen", sensor_drops, set_off("sensor_lost")),
    "sensor_freezes": Scenario(
        "inclinometer dropout, or frozen", sensor_freezes, set_off("sensor_frozen"), others_off=set_off("sensor_lost")
    ),
    "sensor_nan": Scenario("NaN, outlier", sensor_nan, set_off("sensor_bad"), others_off=set_off("sensor_lost")),
    "sensor_jumps": Scenario("NaN, outlier", sensor_jumps, set_off("sensor_bad"), others_off=set_off("sensor_lost")),
    "controller_raises": Scenario("controller exception", controller_raises, set_off("controller_failed")),
    "controller_not_finite": Scenario("controller exception", controller_not_finite, set_off("controller_failed")),
    "host_gone": Scenario("kill -9, hang, SIGSTOP", host_gone, drive_guard=_NO_LIFE),
    "host_hangs_and_resumes": Scenario("kill -9, hang, SIGSTOP", host_hangs_and_resumes, set_off("stalled")),
    "host_stalls_shortly": Scenario("kill -9, hang, SIGSTOP", host_stalls_shortly, set_off("stalled")),
    "second_master_sync": Scenario("second master on the bus", second_master_sync, set_off("second_master")),
    "second_master_setpoints": Scenario("second master on the bus", second_master_setpoints, set_off("second_master")),
    "second_master_guards": Scenario("second master on the bus", second_master_guards, set_off("second_master")),
    "positions_twice": Scenario("a second device sends a drive's position", positions_twice, set_off("node_twice")),
    "over_limit": Scenario("set-point over limit or slew", over_limit, set_off("clamp_persistent"), change=_narrow),
    "too_fast": Scenario("set-point over limit or slew", too_fast, set_off("clamp_persistent")),
    "motor_blocked": Scenario("model and measurement diverge", motor_blocked, set_off("following")),
    "tilt_diverges": Scenario("model and measurement diverge", tilt_diverges, set_off("diverged")),
    "tendon_pulled": Scenario(
        "tendons within a tension estimate", tendon_pulled, set_off("tension", "clamp_persistent"), change=_low_tension
    ),
    "drive_boots": Scenario("unexpected boot-up of a drive", drive_boots, set_off("boot_up")),
}
