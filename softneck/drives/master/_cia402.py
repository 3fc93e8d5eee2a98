"""The power state machine of a drive as the master sees it (CiA 402-2): status word in, control word out.

Tables and look-ups without state.
"""

from __future__ import annotations

from enum import IntEnum


class DriveState(IntEnum):
    """Drive states, coded by their bits of the status word."""

    NOT_READY = 0x00
    DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    ENABLED = 0x27
    QUICK_STOP = 0x07
    REACTION = 0x0F
    FAULT = 0x08
    UNKNOWN = 0xFF


# States without power and without a fault: each drive must report one of them before a run is done.
OFF = frozenset({DriveState.NOT_READY, DriveState.DISABLED, DriveState.READY, DriveState.SWITCHED_ON})
# States with power: during a quick stop or a fault reaction a drive still brakes.
POWERED = frozenset({DriveState.ENABLED, DriveState.QUICK_STOP, DriveState.REACTION})


class Goal(IntEnum):
    """The state that the master requests of a drive."""

    OFF = 0
    READY = 1
    ENABLED = 2
    STOPPED = 3
    RESET = 4


# mask, value -> state (CiA 402-2, table of the status word).
_PATTERNS = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP),
    (0x4F, 0x0F, DriveState.REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)
_STATES = tuple(
    next((state for mask, value, state in _PATTERNS if word & mask == value), DriveState.UNKNOWN) for word in range(128)
)

_SHUTDOWN, _SWITCH_ON, _ENABLE, _QUICK_STOP, _NOTHING, _FAULT_RESET = 0x06, 0x07, 0x0F, 0x02, 0x00, 0x80
S, G = DriveState, Goal
# (state, goal) -> control word; pairs that are not listed get "disable voltage". Quick stop never leads back to
# enabled, and only the goal RESET leaves a fault, so that no drive restarts by itself.
_WORDS = {
    (S.DISABLED, G.READY): _SHUTDOWN,
    (S.READY, G.READY): _SHUTDOWN,
    (S.SWITCHED_ON, G.READY): _SHUTDOWN,
    (S.ENABLED, G.READY): _SHUTDOWN,
    (S.DISABLED, G.ENABLED): _SHUTDOWN,
    (S.READY, G.ENABLED): _SWITCH_ON,
    (S.SWITCHED_ON, G.ENABLED): _ENABLE,
    (S.ENABLED, G.ENABLED): _ENABLE,
    (S.ENABLED, G.STOPPED): _QUICK_STOP,
    (S.QUICK_STOP, G.STOPPED): _QUICK_STOP,
    (S.UNKNOWN, G.STOPPED): _QUICK_STOP,
    (S.FAULT, G.RESET): _FAULT_RESET,
}
del S, G


def state_of(word: int) -> DriveState:
    """Return the state in status word `word`."""
    return _STATES[word & 0x7F]


def control_word(state: DriveState, goal: Goal) -> int:
    """Return the control word for the next transition of a drive in `state` towards `goal`."""
    return _WORDS.get((state, goal), _NOTHING)
