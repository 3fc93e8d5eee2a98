"""What the logs of runs on drives hold, for softneck info."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softneck.drives.master import Frame


_CANDUMP = re.compile(rb"\(\d+\.\d+\) \S+ [0-9A-Fa-f]{3,8}#")


def is_candump(file: Path) -> bool:
    """Return whether a `.log` begins as `candump -L` writes."""
    with file.open("rb") as stream:
        return _CANDUMP.match(stream.read(64)) is not None


def describe_log(file: Path) -> dict[str, Any]:
    """Return what a run's log holds: frames, duration, nodes, first error, and where it is cut."""
    from softneck.drives.logs._frame_log import FrameLog

    if file.suffix.lower() == ".mcap":
        return _run(file)
    log = FrameLog(file)
    frames = [(time, frame) for time, _, frame in log]
    first = _first_error(frames)
    return {
        "type": "log of CAN frames",
        "frames": len(frames),
        "duration_s": round(frames[-1][0] - frames[0][0], 6) if frames else 0.0,
        "nodes": _nodes(frame for _, frame in frames),
        "first_error": first or "none",
        "cut": log.cut or "no",
    }


def _run(file: Path) -> dict[str, Any]:
    from softneck.drives import read_run_log

    log = read_run_log(file)
    cycles = log.cycles
    begin = cycles[0].time if cycles else 0.0
    settings, files = log.settings(), log.facts.get("files", {})
    fault = next((f"t = {time - begin:.3f} s: {text}" for time, name, text in log.events if _stops(name)), "none")
    return {
        "type": "log of a run on drives" + (" (simulated)" if log.facts.get("simulated") else ""),
        "cycles": len(cycles),
        "cycle_s": settings.bus.cycle,
        "frames": sum(len(cycle.received) + len(cycle.sent) for cycle in cycles),
        "duration_s": round(cycles[-1].time - begin, 6) if cycles else 0.0,
        "nodes": ", ".join(str(node) for node in settings.bus.nodes),
        "samples": len(log.rows),
        "phase": cycles[-1].phase if cycles else "none",
        "first_error": fault,
        "files": ", ".join(f"{role} {entry.get('path')}" for role, entry in files.items()) or "none",
        "cut": log.cut or "no",
        "replay": f"softneck drives replay {file}",
        "import": f"softneck import {file} -o {file.stem}.csv",
    }


def _stops(name: str) -> bool:
    from softneck.drives.master._events import RULES, Reaction

    rule = RULES.get(name)
    return rule is not None and rule.reaction in (Reaction.STOP, Reaction.RETREAT)


def _nodes(frames: Iterable[Frame]) -> str:
    """Nodes that said something of their own: PDO, emergency, SDO answer, error control."""
    found = {
        frame.identifier & 0x7F
        for frame in frames
        if not frame.remote and not frame.error and frame.identifier & 0x780 in (0x080, 0x180, 0x580, 0x700)
    }
    return ", ".join(str(node) for node in sorted(found - {0})) or "none"


def _first_error(frames: Iterable[tuple[float, Frame]]) -> str:
    from softneck.drives.bus._meaning import meaning

    begin: float | None = None
    for time, frame in frames:
        begin = time if begin is None else begin
        emergency = frame.identifier & 0x780 == 0x80 and frame.identifier != 0x80 and any(frame.data[:2])
        if frame.error or emergency:
            return f"t = {time - begin:.3f} s: {meaning(frame)}"
    return ""
