"""What the live view shows of one bus cycle, as one line of JSON for the process that draws it.

The line holds numbers and words only, so that the drawing process imports no more than rich: importing the drives costs
seconds of processor time, just when a run begins.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from softneck.drives.master import Phase
from softneck.drives.master._cia402 import DriveState

if TYPE_CHECKING:
    from softneck.drives.logs._times import CycleFigures
    from softneck.drives.running._snapshot import DriveSnapshot, Snapshot


_PHASES = {Phase.RUNNING: "bold green", Phase.DONE: "bold green", Phase.STOPPING: "bold red", Phase.STOPPED: "bold red",
           Phase.RETREAT: "bold yellow"}  # fmt: skip
_BAD = (DriveState.FAULT, DriveState.REACTION, DriveState.QUICK_STOP)


def to_line(
    snapshot: Snapshot, times: CycleFigures, *, begin: float = 0.0, title: str = "", duration: float | None = None
) -> bytes:
    """Return a picture as a line.

    Args:
        snapshot: of one bus cycle.
        times: of the last bus cycles.
        begin: time of the run's first snapshot [s].
        title: what runs.
        duration: of the loop [s].
    """
    from softneck.drives.master._events import Reaction

    picture: dict[str, Any] = {
        "title": title,
        "phase": str(snapshot.phase),
        "phase_style": _PHASES.get(snapshot.phase, "bold"),
        "run_time": snapshot.run_time,
        "duration": duration,
        "since": snapshot.time - begin,
        "cycle": snapshot.cycle,
        "fault": None if snapshot.fault is None else str(snapshot.fault),
        "angles": list(zip(snapshot.references[:2], snapshot.angles, snapshot.estimates, strict=True)),
        "motors": list(zip(snapshot.setpoints, snapshot.positions, snapshot.tensions, strict=True)),
        "tension_limit": snapshot.tension_limit,
        "drives": [_drive(drive) for drive in snapshot.drives],
        "times": str(times) if times.number else "-",
        "cycles": times.number,
        "period": snapshot.period,
        "events": [
            (event.time - begin, event.name, str(event), event.rule.reaction in (Reaction.STOP, Reaction.RETREAT))
            for event in snapshot.events
        ],
        "counts": dict(snapshot.counts),
    }
    return json.dumps(picture).encode() + b"\n"


def _drive(drive: DriveSnapshot) -> dict[str, Any]:
    from softneck.drives.master._nmt import NodeState

    good = drive.state is DriveState.ENABLED
    return {
        "node": drive.node,
        "state": drive.state.name.lower().replace("_", " "),
        "state_style": "bold red" if drive.state in _BAD else "green" if good else "yellow",
        "nmt": drive.nmt.name.lower().replace("_", " "),
        "nmt_style": "none" if drive.nmt is NodeState.OPERATIONAL else "yellow",
        "word": drive.word,
        "silent": drive.silent,
        "emergency": drive.emergency,
    }
