"""The master of the drives: `step(now, frames_in)` returns the frames to send; no clock, no bus, no thread."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from ._cia402 import OFF, POWERED, DriveState, Goal
from ._events import IDLE_TOO, Event, Reaction
from ._fieldbus import Fieldbus, Frame
from ._gate import Gate, Reading
from ._limiter import Limiter
from ._settings import MasterSettings
from ._supervisor import ACTIVE, FINAL, GOALS, Phase, Signal, Supervisor
from ._watches import Leaky, Watches, timing

# One number for each motor.
Motors = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Measurement:
    """Measurements for the pilot at one sample.

    `index`: of the sample, from 0 at the start of the phase `running`. `tilt`: last accepted sample. `fresh`: whether
    it is the present one. `positions`: of the motors [rad].
    """

    index: int
    tilt: Reading
    fresh: bool
    positions: Motors


class Pilot(Protocol):
    """Observer and controller: the map from measurements to set-points."""

    def start(self) -> None:
        """Start a new run."""
        ...

    def step(self, measured: Measurement) -> Motors | None:
        """Return the set-points [rad], one for each motor; None if they are not ready in time."""
        ...

    def is_finished(self, index: int) -> bool:
        """Return whether the run ends before sample `index`."""
        ...


def reference_of(pilot: Pilot) -> tuple[float, ...]:
    """Return the reference of a closed-loop pilot at its last step [rad]; () for other pilots."""
    return tuple(getattr(pilot, "reference", ()))


# Accumulated clamped time that stops the run [s]; time without clamping subtracts a tenth of itself.
_MAX_CLAMPED_S = 0.3
# Time-outs for enabling each drive and for a ramp [s]: half of the fault table's.
_ENABLE_TIME, _RAMP_TIME = 1.0, 30.0
# Cycles without a set-point until the run stops (fault table: hold at once, stop at 5).
_MAX_LOST_CYCLES = 5
# Time for the drives' stop ramp before their voltage is disabled [s].
_STOP_TIME = 1.0
# Time after a stop command after which guarding ends if a drive has not stopped [s].
_OBEY_TIME = 0.25
_NEVER = -math.inf
_MOVED = frozenset({Phase.RAMP_IN, Phase.RUNNING, Phase.RAMP_OUT, Phase.RETREAT})


class Master:
    """Master of all drives: enables them, runs the pilot, reacts to faults and switches the drives off.

    Attributes:
        settings: as given.
        bus: the reported states of the drives.
        supervisor: the phase, and the event that ended the run.
        positions, tensions: of the motors [rad] and tendons [N], measured and estimated.
        setpoints: as sent [rad].
        wanted: last set-points of the pilot [rad]; reference: of its outputs [rad], () without one.
        counts: event name -> number of occurrences.
        events: the last 1000.
        cycle: number of steps so far.
        requests: (request, reason) from outside since the last step: start, finish, leave, stop.
        taken: the requests that the last step processed.
    """

    def __init__(self, settings: MasterSettings, pilot: Pilot) -> None:
        """Start idle; `start` begins the run."""
        self.settings, self.pilot = settings, pilot
        self.bus = Fieldbus(settings.bus)
        self.supervisor = Supervisor(settings.bus.off)
        self._gate = Gate(settings.angle)
        count = len(self.bus.drives)
        channels = settings.channels
        self._watches = Watches(
            settings.watch, settings.limits, channels and channels.weights, count, settings.baseline
        )
        ranges = channels.ranges if channels else [None] * count
        self._limiters = tuple(Limiter(settings.limits, settings.bus.cycle, own) for own in ranges)
        scales = (settings.counts_per_radian, settings.newton_per_unit, settings.zeros)
        self._scales = tuple(zip(self.bus.drives, *scales, strict=True))
        self._clamped = Leaky(_MAX_CLAMPED_S, settings.bus.cycle)
        self.positions: Motors = (0.0,) * count
        self.tensions = self.setpoints = self.wanted = self._from = self.positions
        self.reference: Motors = ()
        self.counts: Counter[str] = Counter()
        self.events: deque[Event] = deque(maxlen=1000)
        self.cycle = 0
        self._now: float | None = None
        self._missing, self._index = 0, -1
        self._part, self._arrived_at = 0, _NEVER
        self._enabling, self._enabling_since = 0, _NEVER
        self._asked: list[Signal] = []
        self.requests: list[tuple[str, str]] = []
        self.taken: tuple[tuple[str, str], ...] = ()

    @property
    def finished(self) -> bool:
        """Whether the run is over and the drives are off."""
        return self.supervisor.phase in FINAL

    def start(self) -> None:
        """Request the start of the run with the next step."""
        self.requests.append(("start", ""))
        self._asked.append(Signal.START)

    def finish(self) -> None:
        """Request the ramp out."""
        self.requests.append(("finish", ""))
        self._asked.append(Signal.FINISH)

    def leave(self, reason: str = "") -> None:
        """Request the ramp to rest and the end of the run in any phase; before the first motion, a stop."""
        self.requests.append(("leave", reason))
        now = self._now or 0.0
        if self.supervisor.phase in (Phase.RAMP_IN, Phase.RUNNING):
            self._asked.append(Signal.FINISH)
            self._record_event(Event(now, "left", 0, reason))
        elif self.supervisor.phase in (Phase.IDLE, Phase.ENABLING):
            self._record_event(Event(now, "operator", 0, reason))

    def stop(self, reason: str = "") -> None:
        """Request an immediate stop of all drives."""
        self.requests.append(("stop", reason))
        self._record_event(Event(self._now or 0.0, "operator", 0, reason))

    def step(self, now: float, frames: Sequence[Frame], tilt: Reading | None = None) -> list[Frame]:
        """Return the frames to send at `now` [s, monotonic].

        Args:
            now: of this cycle.
            frames: received since the last step, without those of the master.
            tilt: the inclinometer's sample if one is due (`sample_due`) and has arrived.
        """
        self.taken = tuple(self.requests)
        self.requests.clear()
        events = self._timing(now)
        events += self.bus.receive(now, frames)
        self._measure()
        due = self.sample_due
        fresh = self._gate.step(now, tilt, events) if due else False
        self._judge(now, events)
        if self._asked:
            for signal in self._asked:
                self.supervisor.signal(now, signal)
            self._asked.clear()
        events = []
        self._watch(now, due, fresh, events)
        self._act(now, due, fresh, events)
        self._judge(now, events)
        frames_out = self.bus.send(self._goals(), self._targets(), guard=not self.starved)
        self.cycle += 1
        return frames_out

    @property
    def index(self) -> int:
        """Number of the pilot's last sample; -1 before the first."""
        return self._index

    @property
    def ran(self) -> bool:
        """Whether the pilot ran in the last step and returned set-points."""
        return self._index >= 0 and self._part == 1 and self.supervisor.phase is Phase.RUNNING

    @property
    def tilt(self) -> Reading | None:
        """The last accepted sample of the inclinometer."""
        return self._gate.last

    @property
    def sample_due(self) -> bool:
        """Whether the next step is one at which observer and controller run."""
        return self.cycle % self.settings.sample_cycles == 0

    # -- input --------------------------------------------------------------------------------------------------

    def _timing(self, now: float) -> list[Event]:
        before, self._now = self._now, now
        if before is None:
            for view in self.bus.drives:
                view.answered = now
        return timing(now, before, self.settings.bus)

    def _measure(self) -> None:
        self.positions = tuple([(view.counts - zero) / per_radian for view, per_radian, _, zero in self._scales])
        self.tensions = tuple([view.current * newton for view, _, newton, _ in self._scales])

    def _judge(self, now: float, events: list[Event]) -> None:
        if not events:
            return
        supervisor, active = self.supervisor, self.supervisor.phase in ACTIVE
        # Without power only the events of `IDLE_TOO` count.
        for event in supervisor.react(now, events if active else [e for e in events if e.name in IDLE_TOO]):
            self._record_event(event, judged=True)

    def _record_event(self, event: Event, *, judged: bool = False) -> None:
        if not judged:
            self.supervisor.react(event.time, [event])
        self.counts[event.name] += 1
        # Events that are only counted are stored once, so that they do not displace the one that stopped the run.
        if event.rule.reaction is not Reaction.COUNT or self.counts[event.name] == 1:
            self.events.append(event)

    # -- monitoring --------------------------------------------------------------------------------------------

    def _watch(self, now: float, due: bool, fresh: bool, events: list[Event]) -> None:
        phase = self.supervisor.phase
        if phase not in ACTIVE:
            return
        for i, view in enumerate(self.bus.drives):
            if view.state in (DriveState.FAULT, DriveState.REACTION):
                events.append(Event(now, "drive_fault", view.node, f"status {view.word:04X}h"))
            elif view.state is not DriveState.ENABLED and (
                phase in _MOVED or (phase is Phase.ENABLING and i < self._enabling)
            ):
                events.append(Event(now, "drive_left", view.node, f"it is {view.state.name}"))
        if phase in _MOVED:
            if phase is Phase.RAMP_IN:
                self._watches.signs(now, self.settings.bus.nodes, self.tensions, events)
            self._watches.motors(now, self.setpoints, self.positions, self.settings.bus.nodes, self.tensions, events)
            last = self._gate.last if fresh else None
            asked = self.reference if phase is Phase.RUNNING else ()
            self._watches.plausible(now, self.settings.bus.nodes, self.setpoints, self.positions, self.tensions, events,
                                    due=due, sample=last, reference=asked)  # fmt: skip
            if due:
                step = self.settings.sample_cycles * self.settings.bus.cycle
                self._watches.tilt(now, step, self.positions, last and last.values, events)
        if events:
            self._judge(now, events)
            events.clear()

    # -- phases -------------------------------------------------------------------------------------------------

    def _act(self, now: float, due: bool, fresh: bool, events: list[Event]) -> None:
        phase = self.supervisor.phase
        if phase is Phase.RUNNING:
            self._run(now, due, fresh, events)
        elif phase is Phase.ENABLING:
            self._enable(now, events)
        elif phase in (Phase.RAMP_IN, Phase.RAMP_OUT, Phase.RETREAT):
            self._ramp(now, events)
        elif phase in (Phase.DISABLING, Phase.STOPPING):
            self._switch_off(now, events)
        if self.supervisor.phase not in _MOVED:
            self._track()

    def _enable(self, now: float, events: list[Event]) -> None:
        """Enable one drive at a time; its set-point is its position until it is enabled."""
        if self._enabling_since == _NEVER:
            self._enabling_since = now
        view = self.bus.drives[self._enabling]
        if view.follows:
            self._enabling += 1
            self._enabling_since = now
            if self._enabling == len(self.bus.drives):
                self._enabling -= 1
                if self._gate.last is not None:
                    self._change(now, Signal.ENABLED)
        elif now - self._enabling_since > _ENABLE_TIME:
            why = " and does not take mode 8" if view.mode == "asked" else ""
            events.append(Event(now, "enable_timeout", view.node, f"it is {view.state.name}{why}"))

    def _ramp(self, now: float, events: list[Event]) -> None:
        """Ramp all motors to rest, P = 0, and wait there."""
        ramps = self.settings.ramps
        step = ramps.speed * self.settings.bus.cycle
        wanted = [value - min(max(value, -step), step) for value in self.setpoints]
        self._limit(now, wanted, events, count=False)
        there = all(
            abs(value) < 1e-6 and abs(position) < ramps.tolerance
            for value, position in zip(self.setpoints, self.positions, strict=True)
        )
        if not there:
            self._arrived_at = _NEVER
            most = _RAMP_TIME
            if self.supervisor.phase is Phase.RETREAT:
                # Without a sensor at most the time from the farthest set-point.
                most = min(most, self.settings.limits.position / ramps.speed + ramps.settle + 1.0)
            if now - self.supervisor.since > most:
                events.append(Event(now, "ramp_timeout", 0, "the motors do not reach their rest"))
            return
        if self._arrived_at == _NEVER:
            self._arrived_at = now
        # The run starts at a sample.
        last = (self.cycle + 1) % self.settings.sample_cycles == 0
        if now - self._arrived_at >= ramps.settle - 1e-9 and last:
            self._change(now, Signal.ARRIVED)
            if self.supervisor.phase is Phase.RUNNING:
                self._begin()

    def _begin(self) -> None:
        self._index = -1
        self._missing = 0
        self.wanted = self._from = self.setpoints
        if self._gate.last is not None:
            self._watches.align(self._gate.last.values, self.positions)
        try:
            self.pilot.start()
        except Exception as error:
            self._controller_failed(self._now or 0.0, error)

    def _run(self, now: float, due: bool, fresh: bool, events: list[Event]) -> None:
        cycles = self.settings.sample_cycles
        if due:
            self._index += 1
            self._part = 0
            self._consult(now, fresh, events)
            if self.supervisor.phase is not Phase.RUNNING:
                return
        if self._missing:
            self._missing += 0 if due else 1
            name = "setpoint_lost" if self._missing >= _MAX_LOST_CYCLES else "setpoint_missing"
            events.append(Event(now, name))
        self._part += 1
        share = min(self._part / cycles, 1.0)
        wanted = [a + share * (b - a) for a, b in zip(self._from, self.wanted, strict=True)]
        self._limit(now, wanted, events, count=True)

    def _consult(self, now: float, fresh: bool, events: list[Event]) -> None:
        """Run the pilot; any error in it stops the drives in this cycle."""
        tilt = self._gate.last
        if tilt is None:
            return
        try:
            if self.pilot.is_finished(self._index):
                self._change(now, Signal.FINISH)
                self._arrived_at = _NEVER
                self._ramp(now, events)
                return
            answer = self.pilot.step(Measurement(self._index, tilt, fresh, self.positions))
            if answer is None:
                self._missing += 1
                self._from = self.wanted
                return
            wanted = tuple(answer)
            if len(wanted) != len(self.bus.drives):
                raise ValueError(f"{len(wanted)} set-points for {len(self.bus.drives)} motors")
            if not all(map(math.isfinite, wanted)):
                raise ValueError(f"set-points {', '.join(f'{value:g}' for value in wanted)} are not finite")
        except Exception as error:
            self._controller_failed(now, error)
            return
        self._missing = 0
        self._from, self.wanted, self.reference = self.wanted, wanted, reference_of(self.pilot)

    def _controller_failed(self, now: float, error: Exception) -> None:
        self._judge(now, [Event(now, "controller_failed", 0, f"{type(error).__name__}: {error}")])

    def _limit(self, now: float, wanted: Sequence[float], events: list[Event], *, count: bool) -> None:
        values, why = [], ""
        for limiter, value, tension, led in zip(self._limiters, wanted, self.tensions, self._watches.led, strict=True):
            values.append(limiter.step(value, tension, led))
            why = why or limiter.clamped
        self.setpoints = tuple(values)
        if not count:
            return
        if why:
            events.append(Event(now, "clamped", 0, why))
        if self._clamped.over(bool(why)):
            events.append(Event(now, "clamp_persistent", 0, why))

    def _switch_off(self, now: float, events: list[Event]) -> None:
        """End the run when every drive reported in this cycle that it is off; after a stop, silence is enough."""
        stopping, late = self.supervisor.phase is Phase.STOPPING, now - self.supervisor.since > _STOP_TIME
        powered = [view for view in self.bus.drives if view.state not in OFF or not view.fresh]
        if stopping:
            powered = [view for view in self.bus.drives if view.state in POWERED and not view.silent > 5]
        if not powered or (late and stopping):
            self._change(now, Signal.OFF)
        elif late:
            events.append(Event(now, "not_off", powered[0].node, f"it is {powered[0].state.name}"))

    @property
    def starved(self) -> bool:
        """Whether guarding ends because a drive does not stop; a drive without PDOs still notices the silence."""
        phase = self.supervisor.phase
        if phase is Phase.STOPPING:
            return (self._now or 0.0) - self.supervisor.since > _OBEY_TIME
        unsure = (view.heard and (view.silent or view.state in POWERED) for view in self.bus.drives)
        return phase is Phase.STOPPED and any(unsure)

    def _change(self, now: float, signal: Signal) -> None:
        if self.supervisor.signal(now, signal):
            self._arrived_at = _NEVER

    def _track(self) -> None:
        """Set the set-points of drives without power to the motor positions; enabled drives hold theirs."""
        values = []
        for view, limiter, position in zip(self.bus.drives, self._limiters, self.positions, strict=True):
            if view.state is not DriveState.ENABLED:
                limiter.reset(position)
            values.append(limiter.value)
        self.setpoints = tuple(values)

    # -- output ------------------------------------------------------------------------------------------------

    def _goals(self) -> list[Goal]:
        goal = GOALS[self.supervisor.phase]
        if self.supervisor.phase is not Phase.ENABLING:
            return [goal] * len(self._scales)
        return [goal if i <= self._enabling else Goal.OFF for i in range(len(self._scales))]

    def _targets(self) -> list[int]:
        values = zip(self.setpoints, self._scales, strict=True)
        return [round(position * per_radian) + zero for position, (_, per_radian, _, zero) in values]
