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
from ..master._measured import Motors
from ._pilot import LoopPilot

# So many of the last events are copied.
_EVENTS = 5


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
        outputs: names of what is measured, of a neck pitch and roll.
        references: of the outputs and of co-contraction [rad]; NaN while the controller does not run.
        angles: outputs of the last believed sample of the inclinometer [rad]; NaN before the first.
        estimates: outputs as the observer has them [rad]; NaN while it does not run, or if there is none.
        setpoints, positions: of the motors, as sent and as measured [rad].
        tensions: of the tendons, from the current that the drives report (TPDO) over the motor's constant [N].
        drives: all of them.
        events: the last five.
        counts: event name -> how often so far.
        fault: what ended the run, None if nothing did.
        period: of the bus [s].
        sample_time: of the controller [s].
        tension_limit: beyond which a run stops [N].
        validity: of the model that stands for the plant in the loop file, told what is measured; NaN without one, for
            an FMU, which nothing runs beside the hardware, and for a model that does not know.
    """

    time: float
    cycle: int
    phase: Phase
    index: int
    references: Motors
    angles: tuple[float, ...]
    estimates: tuple[float, ...]
    setpoints: Motors
    positions: Motors
    tensions: Motors
    drives: tuple[DriveSnapshot, ...]
    events: tuple[Event, ...]
    counts: Mapping[str, int]
    fault: Event | None
    period: float
    sample_time: float
    tension_limit: float
    outputs: tuple[str, ...] = ("pitch", "roll")
    validity: float = math.nan

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
        outputs = ("pitch", "roll") if settings.channels is None else settings.channels.outputs
        signals = self._signals(master, outputs)
        # A deque is indexed in constant time at its ends only; copying all of it would take longer with each event.
        newest = tuple([events[i] for i in range(-min(_EVENTS, len(events)), 0)])
        return Snapshot(
            time=now,
            cycle=master.cycle,
            phase=supervisor.phase,
            index=master.index,
            references=signals[: len(outputs) + 1],
            angles=(math.nan,) * len(outputs) if tilt is None else tilt.values,
            estimates=signals[len(outputs) + 1 : 2 * len(outputs) + 1],
            validity=signals[-1],
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
            outputs=outputs,
        )  # fmt: skip

    def _signals(self, master: Master, outputs: tuple[str, ...]) -> Motors:
        """Return references of the outputs and of co-contraction, estimates of the outputs, and validity."""
        pilot = master.pilot
        # Beyond the run they would be the last ones, and say something that nobody asks for any more.
        if not isinstance(pilot, LoopPilot) or master.index < 0 or master.supervisor.phase is not Phase.RUNNING:
            return (math.nan,) * (2 * len(outputs) + 2)
        if pilot is not self._pilot:
            self._pilot = pilot
            wanted = [("reference", f"{name}_reference") for name in (*outputs, "cocontraction")]
            wanted += [("observer", name) for name in outputs]
            self._slots = tuple(pilot.slot(part, port) for part, port in wanted)
        signals = pilot.signals
        seen = [math.nan if slot is None else float(signals[slot]) for slot in self._slots]
        return (*seen, pilot.validity)
