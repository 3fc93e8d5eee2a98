"""Phases of a run and their transitions: a table and one look-up; a stop is final."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

from ._cia402 import Goal
from ._events import Event, Reaction


class Phase(StrEnum):
    """The phase that a run on the drives is in, from waiting to switched off."""

    IDLE = "idle"
    ENABLING = "enabling"
    RAMP_IN = "ramp in"
    RUNNING = "running"
    RAMP_OUT = "ramp out"
    RETREAT = "retreat"
    DISABLING = "disabling"
    DONE = "done"
    STOPPING = "stopping"
    STOPPED = "stopped"


class Signal(StrEnum):
    """Signals that trigger a transition."""

    START = "start"
    ENABLED = "enabled"
    ARRIVED = "arrived"
    FINISH = "finish"
    OFF = "off"
    RETREAT = "retreat"
    STOP = "stop"


_P, _S = Phase, Signal
NEXT = {
    (_P.IDLE, _S.START): _P.ENABLING,
    (_P.IDLE, _S.STOP): _P.STOPPED,
    (_P.ENABLING, _S.ENABLED): _P.RAMP_IN,
    (_P.RAMP_IN, _S.ARRIVED): _P.RUNNING,
    (_P.RAMP_IN, _S.FINISH): _P.RAMP_OUT,
    (_P.RUNNING, _S.FINISH): _P.RAMP_OUT,
    (_P.RAMP_OUT, _S.ARRIVED): _P.DISABLING,
    (_P.RETREAT, _S.ARRIVED): _P.DISABLING,
    (_P.DISABLING, _S.OFF): _P.DONE,
    (_P.STOPPING, _S.OFF): _P.STOPPED,
    # A lost sensor: retreat to rest, which needs no sensor; before the first motion, stop.
    (_P.ENABLING, _S.RETREAT): _P.STOPPING,
    (_P.RAMP_IN, _S.RETREAT): _P.RETREAT,
    (_P.RUNNING, _S.RETREAT): _P.RETREAT,
    # A stop from every phase in which drives may have power.
    (_P.ENABLING, _S.STOP): _P.STOPPING,
    (_P.RAMP_IN, _S.STOP): _P.STOPPING,
    (_P.RUNNING, _S.STOP): _P.STOPPING,
    (_P.RAMP_OUT, _S.STOP): _P.STOPPING,
    (_P.RETREAT, _S.STOP): _P.STOPPING,
    (_P.DISABLING, _S.STOP): _P.STOPPING,
}
# Phases in which drives may have power, and final phases.
ACTIVE = frozenset({_P.ENABLING, _P.RAMP_IN, _P.RUNNING, _P.RAMP_OUT, _P.RETREAT, _P.DISABLING})
FINAL = frozenset({_P.DONE, _P.STOPPED})
# Goal for every drive in each phase; enabling goes one drive at a time.
GOALS = {
    _P.IDLE: Goal.OFF,
    _P.ENABLING: Goal.ENABLED,
    _P.RAMP_IN: Goal.ENABLED,
    _P.RUNNING: Goal.ENABLED,
    _P.RAMP_OUT: Goal.ENABLED,
    _P.RETREAT: Goal.ENABLED,
    _P.DISABLING: Goal.OFF,
    _P.DONE: Goal.OFF,
    _P.STOPPING: Goal.STOPPED,
    _P.STOPPED: Goal.OFF,
}
_SIGNALS = {Reaction.STOP: Signal.STOP, Reaction.RETREAT: Signal.RETREAT}


class Supervisor:
    """State machine of the run: its phase, and the first event that ended it.

    Attributes:
        phase: of the run.
        since: start of the phase [s].
        fault: the event that ended the run early; it is never cleared.
        rehome: whether a drive lost its zero.
        off: names of disabled guards, for the tests that show that each guard is needed.
    """

    def __init__(self, off: frozenset[str] = frozenset()) -> None:
        """Start idle."""
        self.phase, self.since = Phase.IDLE, 0.0
        self.fault: Event | None = None
        self.rehome = False
        self.off = off

    def signal(self, now: float, signal: Signal) -> bool:
        """Make the transition for `signal` if the table has one; return whether it has."""
        following = NEXT.get((self.phase, signal))
        if following is None:
            return False
        self.phase, self.since = following, now
        return True

    def revoke(self, event: Event) -> None:
        """Change a successful end to a stop, because of an event after it."""
        self.phase = Phase.STOPPED
        self.fault = self.fault or event

    def react(self, now: float, events: Sequence[Event]) -> list[Event]:
        """Process the events of this cycle in order; return those that are not disabled."""
        kept = [event for event in events if event.name not in self.off] if self.off else list(events)
        for event in kept:
            rule = event.rule
            self.rehome = self.rehome or rule.rehome
            signal = _SIGNALS.get(rule.reaction)
            # The first fault is kept; a stop overrides a retreat.
            if signal is not None and self.phase not in FINAL and self.signal(now, signal) and self.fault is None:
                self.fault = event
        return kept
