"""The fault table: for each event the reaction of the master and its deadline.

The tests name each row.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Reaction(StrEnum):
    """Reactions of the master."""

    COUNT = "count"
    HOLD = "hold"
    RETREAT = "retreat"
    STOP = "stop"


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the fault table.

    Attributes:
        reaction: of the master.
        cycles: deadline in cycles; 0 if `seconds` is the deadline.
        seconds: deadline [s].
        text: one line on the event.
        rehome: whether the drives' zero is lost and `softneck drives commission --only zero` must be run.
    """

    reaction: Reaction
    cycles: int
    seconds: float
    text: str
    rehome: bool = False


_R = Reaction
RULES: dict[str, Rule] = {
    "setpoint_missing": Rule(_R.HOLD, 2, 0.0, "no new set-point: the last one holds"),
    "setpoint_lost": Rule(_R.STOP, 5, 0.0, "no set-point for 5 cycles"),
    "bus_off": Rule(_R.STOP, 1, 0.0, "the adapter is bus-off or gone"),
    "bus_silent": Rule(_R.STOP, 3, 0.0, "no drive answered for 3 cycles: cable?"),
    "emergency": Rule(_R.STOP, 2, 0.0, "a drive sent an emergency"),
    "drive_fault": Rule(_R.STOP, 2, 0.0, "a drive is in Fault"),
    "drive_left": Rule(_R.STOP, 2, 0.0, "a drive left Operation Enabled by itself"),
    "node_left": Rule(_R.STOP, 0, 0.3, "a drive is no longer operational (NMT)"),
    "tpdo_missing": Rule(_R.STOP, 5, 0.0, "a drive's position did not come for 5 cycles"),
    "heartbeat_missing": Rule(_R.STOP, 0, 0.3, "a drive's heartbeat or guarding answer did not come"),
    "boot_up": Rule(_R.STOP, 2, 0.0, "a drive booted: its encoder's zero is lost", rehome=True),
    "tpdo_twice": Rule(_R.COUNT, 1, 0.0, "two positions of a drive came for one SYNC"),
    "node_twice": Rule(_R.STOP, 0, 0.5, "two devices send as this drive: give one of them another node number"),
    "frame_length": Rule(_R.COUNT, 1, 0.0, "a drive's frame has the wrong length and was ignored"),
    "second_master": Rule(_R.STOP, 1, 0.0, "another master is on the bus"),
    "sensor_lost": Rule(_R.RETREAT, 0, 0.1, "the inclinometer dropped out"),
    "sensor_frozen": Rule(_R.RETREAT, 0, 0.1, "the inclinometer is frozen"),
    "sensor_bad": Rule(_R.STOP, 1, 0.0, "three samples of the inclinometer in a row were no angles"),
    "sample_discarded": Rule(_R.COUNT, 1, 0.0, "a sample of the inclinometer was discarded"),
    "controller_failed": Rule(_R.STOP, 1, 0.0, "controller or observer failed"),
    "clamped": Rule(_R.COUNT, 1, 0.0, "a set-point was beyond a limit and clamped"),
    "clamp_persistent": Rule(_R.STOP, 0, 1.0, "set-points stayed beyond a limit"),
    "drive_limit": Rule(_R.COUNT, 1, 0.0, "a drive is at its own position limit (607Dh)"),
    "following": Rule(_R.STOP, 0, 0.2, "a motor does not follow its set-point"),
    "diverged": Rule(_R.STOP, 0, 0.2, "the measured tilt is not what the motors' positions give"),
    "tension": Rule(_R.STOP, 0, 0.2, "a tendon is pulled too hard"),
    "pushed": Rule(_R.STOP, 0, 0.2, "a motor pushes its tendon, which can only pull"),
    "motor_jammed": Rule(_R.STOP, 0, 0.5, "a motor does not move as its set-points ask"),
    "encoder_slip": Rule(_R.STOP, 0, 0.5, "an encoder slipped: its zero is lost", rehome=True),
    "position_bad": Rule(_R.STOP, 0, 0.5, "a drive's position jumps as no motor can: bad frames"),
    "current_scale": Rule(_R.STOP, 0, 0.5, "a motor's current does not fit its motion: is `peak_current_A` right?"),
    "gear_wrong": Rule(_R.STOP, 0, 0.5, "the tilt does not fit a winch's turns: is `gear` right?"),
    "tilt_unexplained": Rule(_R.STOP, 0, 4.0, "the neck is not where its motors put it: push, creep, tendon or sensor"),
    "astray": Rule(_R.STOP, 0, 0.5, "the loop does not follow its reference as it did: controller or limits"),
    "sensor_reversed": Rule(_R.STOP, 0, 0.5, "an axis of the inclinometer is reversed"),
    "sensor_swapped": Rule(_R.STOP, 0, 0.5, "the inclinometer's axes are swapped"),
    "sensor_stuck": Rule(_R.RETREAT, 0, 0.5, "the inclinometer does not follow the motors"),
    "sensor_late": Rule(_R.RETREAT, 0, 0.5, "the inclinometer is later than it was"),
    "sensor_noise": Rule(_R.RETREAT, 0, 0.5, "the inclinometer's noise is not what it was"),
    "sensor_rate": Rule(_R.RETREAT, 0, 0.5, "the inclinometer's samples come less often than they did"),
    "sensor_drift": Rule(_R.RETREAT, 0, 4.0, "the inclinometer drifts: its own gyro does not confirm its angles"),
    "not_watched": Rule(_R.COUNT, 0, 5.0, "not all is compared with the experiments"),
    "stalled": Rule(_R.STOP, 1, 0.0, "the control loop stood still for 5 cycles or more"),
    "late_cycle": Rule(_R.COUNT, 1, 0.0, "a cycle came late"),
    "loop_failed": Rule(_R.STOP, 1, 0.0, "the control loop failed"),
    "clock": Rule(_R.STOP, 1, 0.0, "the clock went backwards"),
    "enable_timeout": Rule(_R.STOP, 0, 2.0, "a drive did not reach Operation Enabled"),
    "ramp_timeout": Rule(_R.STOP, 0, 60.0, "a ramp did not end"),
    "not_off": Rule(_R.STOP, 0, 1.0, "a drive did not confirm that it is switched off"),
    "left": Rule(_R.COUNT, 1, 0.0, "the operator asked for the ramp to rest"),
    "operator": Rule(_R.STOP, 1, 0.0, "stopped by the operator"),
}


# Events that count also while no drive has power: another master is active, or a zero is lost.
IDLE_TOO = frozenset({"second_master", "bus_off", "boot_up", "operator", "emergency"})


@dataclass(frozen=True, slots=True)
class Event:
    """An event in a run: its time, its kind and the drive.

    Attributes:
        time: [s] of the master's clock.
        name: key of `RULES`.
        node: of the drive, 0 for none.
        detail: further text.
    """

    time: float
    name: str
    node: int = 0
    detail: str = ""

    @property
    def rule(self) -> Rule:
        """The row of the fault table for this event."""
        return RULES[self.name]

    def __str__(self) -> str:
        """Return one line on the event."""
        where = f" (node {self.node})" if self.node else ""
        more = f": {self.detail}" if self.detail else ""
        return f"{self.rule.text}{where}{more}"
