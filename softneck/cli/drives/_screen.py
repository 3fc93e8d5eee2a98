"""What the live view of a drives run draws, and the process that draws it: lines of JSON in, a terminal out.

rich because it is here already (tables, progress bars) and redraws in place on every terminal. One picture costs some
10 ms of Python; in a thread that would hold the interpreter's lock against the control loop, so it is a process of its
own with low priority (`python -m softneck.cli.drives._screen`), which `LiveView` starts. It imports rich and nothing of
the drives: that would cost seconds of processor time while the run begins.
"""

from __future__ import annotations

import json
import math
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table
    from rich.text import Text


_BAR = 20
# What all of it needs [columns], [lines]: with a fault's line and five events.
_WIDE, _HIGH = 104, 31
_NICE = 10


def render(picture: dict[str, Any], size: tuple[int, int] = (_WIDE, _HIGH)) -> RenderableType:
    """Return a panel with all of `picture`.

    Args:
        picture: what `picture_of` returns, with title and duration.
        size: columns and lines of the terminal; on 80 x 24 columns move together and empty lines are left out.
    """
    from rich.console import Group
    from rich.panel import Panel

    narrow, low = size[0] < _WIDE, size[1] < _HIGH
    # A fault that needs two lines takes an event's place.
    events = 5 - (len(picture["fault"] or "") > min(size[0], _WIDE) - 4)
    blocks: list[list[RenderableType]] = [
        [_head(picture, narrow=narrow)],
        [_angles(picture, narrow=narrow)],
        [_motors(picture, narrow=narrow, low=low)],
        [_drives(picture, narrow=narrow)],
        [_timing(picture, narrow=narrow)],
        [*_events(picture, events)],
        [_counts(picture)],
    ]
    parts = [line for k, block in enumerate(blocks) for line in (block if low or not k else ["", *block])]
    style = "red" if picture["fault"] is not None else "none"
    return Panel(Group(*parts), title=_title(picture["title"]), title_align="left", border_style=style)


def _head(picture: dict[str, Any], *, narrow: bool) -> Text:
    from rich.text import Text

    text = Text()
    text.append(picture["phase"], style=picture["phase_style"])
    of = "" if picture["duration"] is None else f" of {picture['duration']:.1f}"
    text.append(f"   loop {picture['run_time']:.2f}{of} s")
    if not narrow:
        text.append(f"   since start {picture['since']:.2f} s")
    text.append(f"   bus cycle {picture['cycle']}")
    text.append("   validity ")
    text.append(_number(picture["validity"], ".2f"), style="bold red" if picture["validity"] < 0.5 else "none")
    if picture["fault"] is not None:
        text.append(f"\n{picture['fault']}", style="bold red")
    return text


def _angles(picture: dict[str, Any], *, narrow: bool) -> Table:
    table = _table(narrow, "angle [deg]", "reference", "measured", "estimate", "error")
    for name, (reference, measured, estimate) in zip(picture["outputs"], picture["angles"], strict=True):
        row = (reference, measured, estimate, reference - measured)
        table.add_row(name, *(_number(math.degrees(value), ".2f") for value in row))
    return table


def _motors(picture: dict[str, Any], *, narrow: bool, low: bool) -> Table:
    table = _table(narrow, "motor", "set-point [rad]", "position [rad]", "lag [rad]", "tension [N]", "of limit")
    table.columns[5].justify = "left"
    most = picture["tension_limit"]
    for j, (setpoint, position, tension) in enumerate(picture["motors"]):
        table.add_row(
            str(j + 1), _number(setpoint, ".3f"), _number(position, ".3f"), _number(setpoint - position, ".3f"),
            _number(tension, ".1f"), _bar(tension, most, _BAR // 2 if narrow else _BAR),
        )  # fmt: skip
    if low:
        return table
    table.caption = f"tension: from the drives' current; its limit is {most:g} N"
    table.caption_justify = "left"
    return table


def _drives(picture: dict[str, Any], *, narrow: bool) -> Table:
    from rich.text import Text

    word = "status" if narrow else "status word"
    table = _table(narrow, "drive", "state", "NMT", word, "silent [cycles]", "emergency")
    table.columns[1].justify = table.columns[2].justify = "left"
    for drive in picture["drives"]:
        table.add_row(
            f"node {drive['node']}",
            Text(drive["state"], style=drive["state_style"]),
            Text(drive["nmt"], style=drive["nmt_style"]),
            f"{drive['word']:04X}h",
            Text(str(drive["silent"]), style="yellow" if drive["silent"] else "none"),
            Text(f"{drive['emergency']:04X}h", style="bold red") if drive["emergency"] else "-",
        )
    return table


def _bar(value: float, most: float, length: int) -> Text:
    from rich.text import Text

    share = min(max(value / most, 0.0), 1.0) if math.isfinite(value) else 0.0
    full = round(share * length)
    style = "red" if share > 0.9 else "yellow" if share > 0.75 else "green"
    return Text("█" * full, style=style) + Text("·" * (length - full), style="dim")


def _timing(picture: dict[str, Any], *, narrow: bool) -> Text:
    from rich.text import Text

    text = Text.assemble(("cycle [ms]  " if narrow else "cycle time [ms]  ", "bold"), picture["times"])
    late = picture["counts"].get("late_cycle", 0)
    due = f"due {1e3 * picture['period']:g}"
    text.append(f"   {due}   " if narrow else f"   (of {picture['cycles']} cycles, {due})   ")
    text.append(f"late {late}" if narrow else f"late cycles {late}", style="yellow" if late else "none")
    return text


def _events(picture: dict[str, Any], most: int) -> list[Text]:
    from rich.text import Text

    lines = [Text("last events", style="bold")]
    for time, name, text, serious in picture["events"][-most:]:
        line = f"{time:9.2f} s  {name}  {text}"
        lines.append(Text(line, style="red" if serious else "none", no_wrap=True, overflow="ellipsis"))
    if not picture["events"]:
        lines.append(Text("  none", style="dim"))
    return lines


def _counts(picture: dict[str, Any]) -> Text:
    from rich.text import Text

    counted = "   ".join(f"{name} {count}" for name, count in sorted(picture["counts"].items()))
    return Text.assemble(("counts  ", "bold"), counted or "none")


def _table(narrow: bool, *names: str) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 1 if narrow else 2), header_style="bold")
    for i, name in enumerate(names):
        # As text: rich takes [rad] in a string for markup.
        table.add_column(Text(name), justify="left" if i == 0 else "right", no_wrap=True)
    return table


def _title(title: str) -> Text | None:
    from rich.text import Text

    return Text(title) if title else None


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def from_line(line: bytes, size: tuple[int, int] = (_WIDE, _HIGH)) -> RenderableType:
    """Return what is drawn of a line of `LiveView` on a terminal of `size`."""
    return render(json.loads(line), size)


def main() -> None:
    """Draw the newest line that came on standard input, on standard error, until there are no more."""
    from rich.console import Console
    from rich.live import Live
    from rich.panel import Panel

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
