"""The power state machine of a drive (CiA 402-2) as tables: requests of control words, and transitions."""

from __future__ import annotations

# States by their status word under the mask 6Fh.
STATES = {0x00: "NOT_READY", 0x40: "DISABLED", 0x21: "READY", 0x23: "SWITCHED_ON", 0x27: "ENABLED", 0x07: "QUICK_STOP",
          0x0F: "REACTION", 0x08: "FAULT"}  # fmt: skip
NOT_READY, SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, REACTION, FAULT = STATES

# Requests of control words: (mask, value, request), first match wins; bit 7 acts by its rising edge.
_REQUEST_TABLE = (
    (0x02, 0x00, "disable voltage"),
    (0x06, 0x02, "quick stop"),
    (0x07, 0x06, "shutdown"),
    (0x0F, 0x07, "switch on"),
    (0x0F, 0x0F, "enable"),
)
_TRANSITIONS = {
    (SWITCH_ON_DISABLED, "shutdown"): READY,
    (READY, "disable voltage"): SWITCH_ON_DISABLED,
    (READY, "quick stop"): SWITCH_ON_DISABLED,
    (READY, "switch on"): SWITCHED_ON,
    # Through Switched On at once (CiA 402-2, transition 3 followed by 4).
    (READY, "enable"): ENABLED,
    (SWITCHED_ON, "disable voltage"): SWITCH_ON_DISABLED,
    (SWITCHED_ON, "quick stop"): SWITCH_ON_DISABLED,
    (SWITCHED_ON, "shutdown"): READY,
    (SWITCHED_ON, "enable"): ENABLED,
    (ENABLED, "disable voltage"): SWITCH_ON_DISABLED,
    (ENABLED, "shutdown"): READY,
    (ENABLED, "switch on"): SWITCHED_ON,
    (ENABLED, "quick stop"): QUICK_STOP,
    (QUICK_STOP, "disable voltage"): SWITCH_ON_DISABLED,
    (QUICK_STOP, "enable"): ENABLED,
}


def request(word: int) -> str:
    """Return the request in control word `word`; "" for none."""
    return next((name for mask, value, name in _REQUEST_TABLE if word & mask == value), "")


def next_state(state: int, word: int) -> int:
    """Return the state after control word `word`; unchanged without a transition."""
    return _TRANSITIONS.get((state, request(word)), state)
