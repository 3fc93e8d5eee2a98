"""What somebody who watches a run sees of one bus cycle: numbers and names, copied from the master, none of it live.

A view has a thread of its own, and what it draws must not change meanwhile: the control loop hands over one frozen
`Snapshot` per cycle, in a time that depends neither on how long the run is nor on what happened in it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ..master import Event, Master, Phase
from ..master._cia301 import NodeState
from ..master._cia402 import DriveState
from ._pilot import LoopPilot

Triple = tuple[float, float, float]
# So many of the last events are copied.
_EVENTS = 5
_NONE: Triple = (math.nan, math.nan, math.nan)
_SIGNALS = (
    ("reference", "pitch_reference"),
    ("reference", "roll_reference"),
    ("reference", "cocontraction_reference"),
    ("observer", "pitch"),
    ("observer", "roll"),
)


@dataclass(frozen=True, slots=True)
class DriveSnapshot:
    """One drive as it last reported itself.

    Attributes:
        node: its number.
        state: of CiA 402.
        nmt: of CiA 301.
        word: status word.
        silent: bus cycles without its position.
        emergency: code of its last emergency, 0 if there was none.
    """

    node: int
    state: DriveState
    nmt: NodeState
    word: int
    silent: int
    emergency: int


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One bus cycle of a run.

    Attributes:
        time: of the cycle, on the master's clock [s].
        cycle: its number.
        phase: of the run.
        index: of the controller's sample, -1 before the first.
        references: of pitch, roll and co-contraction [rad]; NaN while the controller does not run.
        angles: pitch and roll of the last believed sample of the inclinometer [rad]; NaN before the first.
        estimates: pitch and roll as the observer has them [rad]; NaN while it does not run, or if there is none.
        setpoints, positions: of the motors, as sent and as measured [rad].
        tensions: of the tendons, from the current that the drives report (TPDO) over the motor's constant [N].
        drives: all three.
        events: the last five.
        counts: event name -> how often so far.
        fault: what ended the run, None if nothing did.
        period: of the bus [s].
        sample_time: of the controller [s].
        tension_limit: beyond which a run stops [N].
    """

    time: float
    cycle: int
    phase: Phase
    index: int
    references: Triple
    angles: tuple[float, float]
    estimates: tuple[float, float]
    setpoints: Triple
    positions: Triple
    tensions: Triple
    drives: tuple[DriveSnapshot, ...]
    events: tuple[Event, ...]
    counts: Mapping[str, int]
    fault: Event | None
    period: float
    sample_time: float
    tension_limit: float

    @property
    def run_time(self) -> float:
        """Time since the controller's first sample [s]; 0 before it."""
        return max(0, self.index) * self.sample_time


class Snapshots:
    """Takes snapshots of a master; reads only, and looks a pilot's signals up by name only once."""

    def __init__(self) -> None:
        """Know no pilot yet."""
        self._pilot: object = None
        self._slots: tuple[int | None, ...] = ()

    def take(self, master: Master, now: float) -> Snapshot:
        """Return what there is to see after the step at `now` [s]."""
        supervisor, events, tilt, settings = master.supervisor, master.events, master.tilt, master.settings
        pitch_reference, roll_reference, common, pitch, roll = self._signals(master)
        # A deque is indexed in constant time at its ends only; copying all of it would take longer with each event.
        newest = tuple([events[i] for i in range(-min(_EVENTS, len(events)), 0)])
        return Snapshot(
            time=now,
            cycle=master.cycle,
            phase=supervisor.phase,
            index=master.index,
            references=(pitch_reference, roll_reference, common),
            angles=(math.nan, math.nan) if tilt is None else (tilt.pitch, tilt.roll),
            estimates=(pitch, roll),
            setpoints=master.setpoints,
            positions=master.positions,
            tensions=master.tensions,
            drives=tuple(
                [
                    DriveSnapshot(
                        view.node, view.state, view.nmt, view.word, view.silent,
                        view.emergencies[-1][1] if view.emergencies else 0,
                    )
                    for view in master.bus.drives
                ]
            ),
            events=newest,
            counts=dict(master.counts),
            fault=supervisor.fault,
            period=settings.bus.cycle,
            sample_time=settings.sample_cycles * settings.bus.cycle,
            tension_limit=settings.limits.tension,
        )  # fmt: skip

    def _signals(self, master: Master) -> tuple[float, float, float, float, float]:
        pilot = master.pilot
        # Beyond the run they would be the last ones, and say something that nobody asks for any more.
        if not isinstance(pilot, LoopPilot) or master.index < 0 or master.supervisor.phase is not Phase.RUNNING:
            return (*_NONE, math.nan, math.nan)
        if pilot is not self._pilot:
            self._pilot = pilot
            self._slots = tuple(pilot.slot(part, port) for part, port in _SIGNALS)
        signals = pilot.signals
        a, b, c, d, e = [math.nan if slot is None else float(signals[slot]) for slot in self._slots]
        return a, b, c, d, e
