"""Phases of a run and what leads from one to the next: a table, one look-up, and no way back from a stop."""

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
    """What moves it on."""

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
    # A lost sensor: back to where no sensor is needed; before anything moved there is nothing to go back from.
    (_P.ENABLING, _S.RETREAT): _P.STOPPING,
    (_P.RAMP_IN, _S.RETREAT): _P.RETREAT,
    (_P.RUNNING, _S.RETREAT): _P.RETREAT,
    # A stop from wherever drives may have power.
    (_P.ENABLING, _S.STOP): _P.STOPPING,
    (_P.RAMP_IN, _S.STOP): _P.STOPPING,
    (_P.RUNNING, _S.STOP): _P.STOPPING,
    (_P.RAMP_OUT, _S.STOP): _P.STOPPING,
    (_P.RETREAT, _S.STOP): _P.STOPPING,
    (_P.DISABLING, _S.STOP): _P.STOPPING,
}
# Phases in which drives may have power, and those with nothing after them.
ACTIVE = frozenset({_P.ENABLING, _P.RAMP_IN, _P.RUNNING, _P.RAMP_OUT, _P.RETREAT, _P.DISABLING})
FINAL = frozenset({_P.DONE, _P.STOPPED})
# What is asked of every drive; while enabling it goes one by one.
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
    """Keeps the phase, and the first event that ended the run.

    Attributes:
        phase: where the run is.
        since: when the phase began [s].
        fault: what ended the run early; it stays, nothing clears it.
        rehome: whether a drive lost its zero.
        off: names of guards that are switched off, for the tests that prove each one to be needed.
    """

    def __init__(self, off: frozenset[str] = frozenset()) -> None:
        """Be idle."""
        self.phase, self.since = Phase.IDLE, 0.0
        self.fault: Event | None = None
        self.rehome = False
        self.off = off

    def signal(self, now: float, signal: Signal) -> bool:
        """Move on if the table knows a way; return whether it does."""
        following = NEXT.get((self.phase, signal))
        if following is None:
            return False
        self.phase, self.since = following, now
        return True

    def revoke(self, event: Event) -> None:
        """Take a good end back: what showed after it says that it was none."""
        self.phase = Phase.STOPPED
        self.fault = self.fault or event

    def react(self, now: float, events: Sequence[Event]) -> list[Event]:
        """Take `events` of this cycle in their order; return those that count."""
        kept = [event for event in events if event.name not in self.off] if self.off else list(events)
        for event in kept:
            rule = event.rule
            self.rehome = self.rehome or rule.rehome
            signal = _SIGNALS.get(rule.reaction)
            # The first fault is told; a stop goes over a retreat.
            if signal is not None and self.phase not in FINAL and self.signal(now, signal) and self.fault is None:
                self.fault = event
        return kept
