"""What the live view of a drives run draws, and the process that draws it: lines of JSON in, a terminal out.

rich because it is here already (tables, progress bars) and redraws in place on every terminal. One picture costs some
10 ms of Python; in a thread that would hold the interpreter's lock against the control loop, so it is a process of its
own with low priority (`python -m softneck.cli._drives_screen`), which `LiveView` starts.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from softneck.drives import CycleFigures, DriveSnapshot, Snapshot
from softneck.drives.master import DriveState, Event, NodeState, Phase, Reaction

_BAR = 20
# What all of it needs [columns], [lines]: with a fault's line and five events.
_WIDE, _HIGH = 104, 31
_NICE = 10
_PHASES = {Phase.RUNNING: "bold green", Phase.DONE: "bold green", Phase.STOPPING: "bold red", Phase.STOPPED: "bold red",
           Phase.RETREAT: "bold yellow"}  # fmt: skip
_BAD = (DriveState.FAULT, DriveState.REACTION, DriveState.QUICK_STOP)


def render(
    snapshot: Snapshot,
    times: CycleFigures,
    *,
    begin: float = 0.0,
    title: str = "",
    duration: float | None = None,
    size: tuple[int, int] = (_WIDE, _HIGH),
) -> RenderableType:
    """Return a panel with all of `snapshot`.

    Args:
        snapshot: of one bus cycle.
        times: of the last bus cycles.
        begin: time of the run's first snapshot [s].
        title: what runs.
        duration: of the loop [s].
        size: columns and lines of the terminal; on 80 x 24 columns move together and empty lines are left out.
    """
    narrow, low = size[0] < _WIDE, size[1] < _HIGH
    blocks: list[list[RenderableType]] = [
        [_head(snapshot, begin, duration)],
        [_angles(snapshot, narrow=narrow)],
        [_motors(snapshot, narrow=narrow, low=low)],
        [_drives(snapshot, narrow=narrow)],
        [_timing(snapshot, times, narrow=narrow)],
        [*_events(snapshot, begin)],
        [_counts(snapshot)],
    ]
    parts = [line for k, block in enumerate(blocks) for line in (block if low or not k else ["", *block])]
    style = "red" if snapshot.fault is not None else "none"
    return Panel(Group(*parts), title=_title(title), title_align="left", border_style=style)


def _head(snapshot: Snapshot, begin: float, duration: float | None) -> Text:
    text = Text()
    text.append(str(snapshot.phase), style=_PHASES.get(snapshot.phase, "bold"))
    of = "" if duration is None else f" of {duration:.1f}"
    text.append(f"   loop {snapshot.run_time:.2f}{of} s   since start {snapshot.time - begin:.2f} s")
    text.append(f"   bus cycle {snapshot.cycle}")
    if snapshot.fault is not None:
        text.append(f"\n{snapshot.fault}", style="bold red")
    return text


def _angles(snapshot: Snapshot, *, narrow: bool) -> Table:
    table = _table(narrow, "angle [deg]", "reference", "measured", "estimate", "error")
    for name, reference, measured, estimate in zip(
        ("pitch", "roll"), snapshot.references[:2], snapshot.angles, snapshot.estimates, strict=True
    ):
        row = (reference, measured, estimate, reference - measured)
        table.add_row(name, *(_number(math.degrees(value), ".2f") for value in row))
    return table


def _motors(snapshot: Snapshot, *, narrow: bool, low: bool) -> Table:
    table = _table(narrow, "motor", "set-point [rad]", "position [rad]", "lag [rad]", "tension [N]", "of limit")
    table.columns[5].justify = "left"
    most = snapshot.tension_limit
    for j, (setpoint, position, tension) in enumerate(
        zip(snapshot.setpoints, snapshot.positions, snapshot.tensions, strict=True)
    ):
        table.add_row(
            str(j + 1), _number(setpoint, ".3f"), _number(position, ".3f"), _number(setpoint - position, ".3f"),
            _number(tension, ".1f"), _bar(tension, most, _BAR // 2 if narrow else _BAR),
        )  # fmt: skip
    if low:
        return table
    table.caption = f"tension: from the drives' current; its limit is {most:g} N"
    table.caption_justify = "left"
    return table


def _drives(snapshot: Snapshot, *, narrow: bool) -> Table:
    table = _table(
        narrow, "drive", "state", "NMT", "status" if narrow else "status word", "silent [cycles]", "emergency"
    )
    table.columns[1].justify = table.columns[2].justify = "left"
    for drive in snapshot.drives:
        bad = drive.state in _BAD
        state = "bold red" if bad else "green" if drive.state is DriveState.ENABLED else "yellow"
        table.add_row(
            f"node {drive.node}",
            Text(drive.state.name.lower().replace("_", " "), style=state),
            Text(
                drive.nmt.name.lower().replace("_", " "),
                style="none" if drive.nmt is NodeState.OPERATIONAL else "yellow",
            ),
            f"{drive.word:04X}h",
            Text(str(drive.silent), style="yellow" if drive.silent else "none"),
            Text(f"{drive.emergency:04X}h", style="bold red") if drive.emergency else "-",
        )
    return table


def _bar(value: float, most: float, length: int) -> Text:
    share = min(max(value / most, 0.0), 1.0) if math.isfinite(value) else 0.0
    full = round(share * length)
    style = "red" if share > 0.9 else "yellow" if share > 0.75 else "green"
    return Text("█" * full, style=style) + Text("·" * (length - full), style="dim")


def _timing(snapshot: Snapshot, times: CycleFigures, *, narrow: bool) -> Text:
    text = Text.assemble(("cycle [ms]  " if narrow else "cycle time [ms]  ", "bold"))
    if times.number:
        text.append(str(times))
    else:
        text.append("-")
    late = snapshot.counts.get("late_cycle", 0)
    due = f"due {1e3 * snapshot.period:g}"
    text.append(f"   {due}   " if narrow else f"   (of {times.number} cycles, {due})   ")
    text.append(f"late {late}" if narrow else f"late cycles {late}", style="yellow" if late else "none")
    return text


def _events(snapshot: Snapshot, begin: float) -> list[Text]:
    lines = [Text("last events", style="bold")]
    for event in snapshot.events:
        serious = event.rule.reaction in (Reaction.STOP, Reaction.RETREAT)
        line = f"{event.time - begin:9.2f} s  {event.name}  {event}"
        lines.append(Text(line, style="red" if serious else "none", no_wrap=True, overflow="ellipsis"))
    if not snapshot.events:
        lines.append(Text("  none", style="dim"))
    return lines


def _counts(snapshot: Snapshot) -> Text:
    counted = "   ".join(f"{name} {count}" for name, count in sorted(snapshot.counts.items()))
    return Text.assemble(("counts  ", "bold"), counted or "none")


def _table(narrow: bool, *names: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 1 if narrow else 2), header_style="bold")
    for i, name in enumerate(names):
        # As text: rich takes [rad] in a string for markup.
        table.add_column(Text(name), justify="left" if i == 0 else "right", no_wrap=True)
    return table


def _title(title: str) -> Text | None:
    return Text(title) if title else None


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def to_line(snapshot: Snapshot, times: CycleFigures, *, begin: float, title: str, duration: float | None) -> bytes:
    """Return the arguments of `render` as one line of JSON."""
    value = {"snapshot": asdict(snapshot), "times": times, "begin": begin, "title": title, "duration": duration}
    return json.dumps(value).encode() + b"\n"


def from_line(line: bytes, size: tuple[int, int] = (_WIDE, _HIGH)) -> RenderableType:
    """Return what `render` draws of a line of `to_line`."""
    value = json.loads(line)
    times = CycleFigures(*value["times"])
    return render(
        _snapshot(value["snapshot"]), times, begin=value["begin"], title=value["title"], duration=value["duration"],
        size=size,
    )  # fmt: skip


def _snapshot(value: dict[str, Any]) -> Snapshot:
    drives = [
        DriveSnapshot(**{**drive, "state": DriveState(drive["state"]), "nmt": NodeState(drive["nmt"])})
        for drive in value["drives"]
    ]
    changed = {
        "phase": Phase(value["phase"]),
        "drives": tuple(drives),
        "events": tuple(Event(**event) for event in value["events"]),
        "fault": None if value["fault"] is None else Event(**value["fault"]),
    }
    return Snapshot(**{**value, **changed})


def main() -> None:
    """Draw the newest line that came on standard input, on standard error, until there are no more."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
    rest = b""
    waiting = Panel("waiting for the first bus cycle ...")
    with Live(waiting, console=Console(stderr=True), auto_refresh=False, vertical_overflow="crop") as live:
        while chunk := os.read(0, 1 << 20):
            # A slow terminal skips pictures instead of showing old ones.
            *lines, rest = (rest + chunk).split(b"\n")
            if lines:
                live.update(from_line(lines[-1], (live.console.width, live.console.height)), refresh=True)


if __name__ == "__main__":
    main()
