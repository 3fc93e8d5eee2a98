"""The live terminal view of a drives run: the control loop leaves snapshots, a thread of rich draws the newest.

rich because it is here already (tables, progress bars), redraws in place on every terminal, and has the thread.
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from types import TracebackType

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from softneck.core import Vector
from softneck.drives import Snapshot, Snapshots
from softneck.drives.master import DriveState, Master, NodeState, Phase, Reaction

_RATE = 8.0
# Percentiles are of so many of the last bus cycles: 10 s at 100 Hz.
_CYCLES = 1000
# While the view draws, the control loop gets Python's lock back after this long [s]; the interpreter's own value of
# 5 ms would be half a bus cycle.
_SWITCH = 1e-4
_BAR = 20
_PHASES = {Phase.RUNNING: "bold green", Phase.DONE: "bold green", Phase.STOPPING: "bold red", Phase.STOPPED: "bold red",
           Phase.RETREAT: "bold yellow"}  # fmt: skip
_BAD = (DriveState.FAULT, DriveState.REACTION, DriveState.QUICK_STOP)


class LiveView:
    """Draws the newest snapshot eight times a second while it is open.

    `show` takes no lock, waits for nothing and keeps one snapshot: a slow or stopped terminal holds up nothing.
    """

    def __init__(
        self,
        console: Console,
        *,
        title: str = "",
        duration: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Draw on `console`; `duration` [s] is that of the loop, `clock` measures the bus cycle."""
        self._console, self._title, self._duration, self._clock = console, title, duration, clock
        self._snapshots = Snapshots()
        self._newest: Snapshot | None = None
        self._begin, self._before = math.nan, math.nan
        self._gaps: Vector = np.zeros(_CYCLES)
        self._shown = 0
        self._live = Live(
            console=console, get_renderable=self.render, refresh_per_second=_RATE, vertical_overflow="crop"
        )
        self._interval = 0.0

    def __enter__(self) -> LiveView:
        """Begin to draw."""
        self._interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH)
        self._live.start(refresh=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Draw a last time and leave that on the terminal."""
        try:
            self._live.stop()
        finally:
            sys.setswitchinterval(self._interval)

    def watch(self, master: Master, now: float) -> None:
        """Look at `master` after its cycle at `now` [s]; for the `watch` of a run."""
        self.show(self._snapshots.take(master, now))

    def show(self, snapshot: Snapshot) -> None:
        """Make `snapshot` the newest, and count the time since the last one as a cycle."""
        now = self._clock()
        if self._newest is None:
            self._begin = snapshot.time
        else:
            self._gaps[self._shown % _CYCLES] = now - self._before
            self._shown += 1
        self._before = now
        self._newest = snapshot

    def render(self) -> RenderableType:
        """Return what is to be drawn now."""
        newest = self._newest
        if newest is None:
            return Panel("waiting for the first bus cycle ...", title=_title(self._title), title_align="left")
        cycles = self._gaps[: min(self._shown, _CYCLES)].copy()
        return render(newest, cycles, begin=self._begin, title=self._title, duration=self._duration)


def render(
    snapshot: Snapshot, cycles: Vector, *, begin: float = 0.0, title: str = "", duration: float | None = None
) -> RenderableType:
    """Return a panel with all of `snapshot`.

    Args:
        snapshot: of one bus cycle.
        cycles: durations of the last bus cycles [s].
        begin: time of the run's first snapshot [s].
        title: what runs.
        duration: of the loop [s].
    """
    parts: list[RenderableType] = [
        _head(snapshot, begin, duration), "", _angles(snapshot), "", _motors(snapshot), "", _drives(snapshot), "",
        _timing(snapshot, cycles),
    ]  # fmt: skip
    parts += ["", *_events(snapshot, begin)]
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


def _angles(snapshot: Snapshot) -> Table:
    table = _table("angle [deg]", "reference", "measured", "estimate", "error")
    for name, reference, measured, estimate in zip(
        ("pitch", "roll"), snapshot.references[:2], snapshot.angles, snapshot.estimates, strict=True
    ):
        row = (reference, measured, estimate, reference - measured)
        table.add_row(name, *(_number(math.degrees(value), ".2f") for value in row))
    return table


def _motors(snapshot: Snapshot) -> Table:
    table = _table("motor", "set-point [rad]", "position [rad]", "lag [rad]", "tension [N]", "of limit")
    table.columns[5].justify = "left"
    most = snapshot.tension_limit
    for j, (setpoint, position, tension) in enumerate(
        zip(snapshot.setpoints, snapshot.positions, snapshot.tensions, strict=True)
    ):
        table.add_row(
            str(j + 1), _number(setpoint, ".3f"), _number(position, ".3f"), _number(setpoint - position, ".3f"),
            _number(tension, ".1f"), _bar(tension, most),
        )  # fmt: skip
    table.caption = f"tension: from the drives' current; its limit is {most:g} N"
    table.caption_justify = "left"
    return table


def _drives(snapshot: Snapshot) -> Table:
    table = _table("drive", "state", "NMT", "status word", "silent [cycles]", "emergency")
    table.columns[1].justify = table.columns[2].justify = "left"
    for drive in snapshot.drives:
        bad = drive.state in _BAD
        state = "bold red" if bad else "green" if drive.state is DriveState.ENABLED else "yellow"
        table.add_row(
            f"node {drive.node}",
            Text(drive.state.name.lower().replace("_", " "), style=state),
            Text(drive.nmt.name.lower(), style="none" if drive.nmt is NodeState.OPERATIONAL else "yellow"),
            f"{drive.word:04X}h",
            Text(str(drive.silent), style="yellow" if drive.silent else "none"),
            Text(f"{drive.emergency:04X}h", style="bold red") if drive.emergency else "-",
        )
    return table


def _bar(value: float, most: float) -> Text:
    share = min(max(value / most, 0.0), 1.0) if math.isfinite(value) else 0.0
    full = round(share * _BAR)
    style = "red" if share > 0.9 else "yellow" if share > 0.75 else "green"
    return Text("█" * full, style=style) + Text("·" * (_BAR - full), style="dim")


def _timing(snapshot: Snapshot, cycles: Vector) -> Text:
    due = snapshot.period
    text = Text.assemble(("cycle time [ms]  ", "bold"))
    if len(cycles):
        middle, high = (1e3 * float(value) for value in np.percentile(cycles, (50, 99)))
        text.append(f"p50 {middle:.2f}   p99 {high:.2f}   max {1e3 * float(cycles.max()):.2f}")
    else:
        text.append("-")
    late = snapshot.counts.get("late_cycle", 0)
    text.append(f"   (of {len(cycles)} cycles, due {1e3 * due:g})   ")
    text.append(f"late cycles {late}", style="yellow" if late else "none")
    return text


def _events(snapshot: Snapshot, begin: float) -> list[Text]:
    lines = [Text("last events", style="bold")]
    for event in snapshot.events:
        serious = event.rule.reaction in (Reaction.STOP, Reaction.RETREAT)
        line = f"{event.time - begin:9.2f} s  {event.name}  {event}"
        lines.append(Text(line, style="red" if serious else "none", no_wrap=True, overflow="ellipsis"))
    if not snapshot.events:
        lines.append(Text("  none", style="dim"))
    counted = "   ".join(f"{name} {count}" for name, count in sorted(snapshot.counts.items()))
    lines += [Text(""), Text.assemble(("counts  ", "bold"), counted or "none")]
    return lines


def _table(*names: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2), header_style="bold")
    for i, name in enumerate(names):
        # As text: rich takes [rad] in a string for markup.
        table.add_column(Text(name), justify="left" if i == 0 else "right", no_wrap=True)
    return table


def _title(title: str) -> Text | None:
    return Text(title) if title else None


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


@contextlib.contextmanager
def live_view(title: str, duration: float, *, wanted: bool) -> Iterator[Callable[[Master, float], None] | None]:
    """Yield what a run's `watch` takes; None, and nothing is drawn, if not `wanted` or stderr is no terminal."""
    console = Console(stderr=True)
    if not (wanted and console.is_terminal):
        yield None
        return
    with LiveView(console, title=title, duration=duration) as view:
        yield view.watch
