"""The live terminal view of a drives run: the loop leaves a snapshot per cycle, another process draws the newest.

Between the two a thread wakes eight times a second and writes one line to the other process. The control loop itself
takes no lock and waits for nothing; a view that is slow, stopped or dead holds up no cycle. The line holds numbers and
words only, so that the drawing process imports no more than rich: importing the drives costs seconds of processor time,
just when a run begins.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Vector
from softneck.drives.master import Phase
from softneck.drives.master._cia402 import DriveState

if TYPE_CHECKING:
    from softneck.drives.logs._times import CycleFigures
    from softneck.drives.master import Frame, Master, Tilt
    from softneck.drives.master._gate import Reading
    from softneck.drives.running._snapshot import DriveSnapshot, Snapshot
    from softneck.drives.running._virtual import Watch

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
        "outputs": list(snapshot.outputs),
        "validity": snapshot.validity,
        "angles": list(zip(snapshot.references[:-1], snapshot.angles, snapshot.estimates, strict=True)),
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
    from softneck.drives.master._cia301 import NodeState

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


_PERIOD = 1.0 / 8.0
# Percentiles are of so many of the last bus cycles: 10 s at 100 Hz.
_CYCLES = 1000
# At the end of a run the drawing process gets this long for its last picture (it may still be starting) [s].
_PATIENCE = 10.0


class LiveView:
    """Shows the newest snapshot eight times a second while it is open; the last picture stays."""

    def __init__(
        self,
        *,
        title: str = "",
        duration: float | None = None,
        terminal: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Prepare; `duration` [s] is the loop's, `terminal` a file descriptor (default: standard error)."""
        from softneck.drives import Snapshots

        self._title, self._duration, self._terminal, self._clock = title, duration, terminal, clock
        self._snapshots = Snapshots()
        self._newest: Snapshot | None = None
        self._begin, self._before = math.nan, math.nan
        self._gaps: Vector = np.zeros(_CYCLES)
        self._shown = 0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._screen: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> LiveView:
        """Begin to draw."""
        # A session of its own: Ctrl-C is for the run, whose last picture is still to be drawn then.
        self._screen = subprocess.Popen(
            [sys.executable, "-m", "softneck.cli.drives._screen"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._terminal,
            env={**os.environ, "PYTHONSAFEPATH": "1"},
            start_new_session=True,
        )
        self._thread = threading.Thread(target=self._feed, args=(self._screen,), name="live view", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Draw a last time and leave that on the terminal."""
        self._over.set()
        if self._screen is None or self._thread is None:
            return
        try:
            self._screen.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._screen.kill()
            self._screen.wait()
        self._thread.join()

    def watch(
        self, now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Tilt | Reading | None, master: Master
    ) -> None:
        """Look at `master` after its cycle at `now` [s]; one of the `watches` of a run."""
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

    def line(self) -> bytes | None:
        """Return what the drawing process gets now; None before the first snapshot."""
        newest = self._newest
        if newest is None:
            return None
        return to_line(newest, self._times(), begin=self._begin, title=self._title, duration=self._duration)

    def _times(self) -> CycleFigures:
        from softneck.drives.logs._times import CycleFigures

        return CycleFigures.of(self._gaps[: min(self._shown, _CYCLES)].copy())

    def _feed(self, screen: subprocess.Popen[bytes]) -> None:
        # A process that draws no more ends the view, not the run.
        with contextlib.suppress(OSError):
            over = False
            while not over:
                over = self._over.wait(_PERIOD)
                line = self.line()
                if line is not None and screen.stdin is not None:
                    screen.stdin.write(line)
                    screen.stdin.flush()
        if screen.stdin is not None:
            with contextlib.suppress(OSError):
                screen.stdin.close()


@contextlib.contextmanager
def live_view(title: str, duration: float, *, wanted: bool) -> Iterator[tuple[Watch, ...]]:
    """Yield the `watches` of a run; none, and nothing is drawn, if not `wanted` or stderr is not a terminal."""
    from rich.console import Console

    if not (wanted and Console(stderr=True).is_terminal):
        yield ()
        return
    with LiveView(title=title, duration=duration) as view:
        yield (view.watch,)
