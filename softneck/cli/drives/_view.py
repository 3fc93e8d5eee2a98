"""The live terminal view of a drives run: eight pictures a second of numbers and words, which another process draws.

A thread writes the newest picture to that process. The control loop takes no lock and waits for nothing; a view that is
slow, stopped or dead holds up no cycle. A picture holds numbers and words only, so that the drawing process imports no
more than rich: importing the drives costs seconds of processor time, just when a run begins.
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
from typing import TYPE_CHECKING, Any

from softneck.drives.logs._times import CycleTimes
from softneck.drives.master import Phase
from softneck.drives.master._cia301 import NodeState
from softneck.drives.master._cia402 import DriveState
from softneck.drives.master._events import Reaction

if TYPE_CHECKING:
    from softneck.drives.master import Frame, Master
    from softneck.drives.master._fieldbus import DriveView
    from softneck.drives.master._gate import Reading
    from softneck.drives.running._virtual import Watch

_PHASES = {Phase.RUNNING: "bold green", Phase.DONE: "bold green", Phase.STOPPING: "bold red", Phase.STOPPED: "bold red",
           Phase.RETREAT: "bold yellow"}  # fmt: skip
_BAD = (DriveState.FAULT, DriveState.REACTION, DriveState.QUICK_STOP)
_PERIOD = 1.0 / 8.0
# So many of the last events are shown.
_EVENTS = 5
# At the end of a run the drawing process gets this long for its last picture (it may still be starting) [s].
_PATIENCE = 10.0


def picture_of(master: Master, now: float, times: CycleTimes, *, begin: float = 0.0) -> dict[str, Any]:
    """Return what there is to see of `master` after its step at `now` [s], in numbers and words.

    Args:
        master: of the run; it is read only.
        now: on its clock [s].
        times: of the cycles so far.
        begin: when the run began [s].
    """
    phase, fault, settings, tilt = master.supervisor.phase, master.supervisor.fault, master.settings, master.tilt
    count = len(settings.outputs)
    references, estimates, validity = _signals(master)
    figures = times.figures()
    # A deque is indexed in constant time at its ends only; copying all of it would take longer with each event.
    events = [master.events[i] for i in range(-min(_EVENTS, len(master.events)), 0)]
    return {
        "phase": str(phase),
        "phase_style": _PHASES.get(phase, "bold"),
        "run_time": max(0, master.index) * settings.sample_cycles * settings.bus.cycle,
        "since": now - begin,
        "cycle": master.cycle,
        "fault": None if fault is None else str(fault),
        "outputs": list(settings.outputs),
        "validity": validity,
        "angles": list(zip(references, tilt.values if tilt else (math.nan,) * count, estimates, strict=True)),
        "motors": list(zip(master.setpoints, master.positions, master.tensions, strict=True)),
        "tension_limit": settings.limits.tension,
        "drives": [_drive(view) for view in master.bus.drives],
        "times": str(figures) if figures.number else "-",
        "cycles": figures.number,
        "period": settings.bus.cycle,
        "events": [
            (event.time - begin, event.name, str(event), event.rule.reaction in (Reaction.STOP, Reaction.RETREAT))
            for event in events
        ],
        "counts": dict(master.counts),
    }


def _signals(master: Master) -> tuple[Sequence[float], Sequence[float], float]:
    """Return references and estimates of the outputs [rad], and the model's validity; NaN for what there is not."""
    from softneck.drives.running._pilot import LoopPilot

    pilot, outputs = master.pilot, master.settings.outputs
    # Beyond the run they would be the last ones, and say something that nobody asks for any more.
    if not isinstance(pilot, LoopPilot) or master.index < 0 or master.supervisor.phase is not Phase.RUNNING:
        return (math.nan,) * len(outputs), (math.nan,) * len(outputs), math.nan
    return pilot.reference, [pilot.value(f"observer.{name}") for name in outputs], pilot.validity


def _drive(view: DriveView) -> dict[str, Any]:
    good = view.state is DriveState.ENABLED
    return {
        "node": view.node,
        "state": view.state.name.lower().replace("_", " "),
        "state_style": "bold red" if view.state in _BAD else "green" if good else "yellow",
        "nmt": view.nmt.name.lower().replace("_", " "),
        "nmt_style": "none" if view.nmt is NodeState.OPERATIONAL else "yellow",
        "word": view.word,
        "silent": view.silent,
        "emergency": view.emergencies[-1][1] if view.emergencies else 0,
    }


class LiveView:
    """Shows a picture of a run eight times a second while it is open; the last one stays."""

    def __init__(
        self,
        *,
        title: str = "",
        duration: float | None = None,
        terminal: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Prepare; `duration` [s] is the loop's, `terminal` a file descriptor (default: standard error)."""
        self._about = {"title": title, "duration": duration}
        self._terminal, self._clock = terminal, clock
        self._times: CycleTimes | None = None
        self._last: tuple[Master, float] | None = None
        self._begin, self._drawn = math.nan, -math.inf
        self._line: bytes | None = None
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

    def __exit__(self, *error: object) -> None:
        """Draw a last time and leave that on the terminal."""
        if self._screen is None or self._thread is None:
            return
        self._draw()
        self._over.set()
        try:
            self._screen.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._screen.kill()
            self._screen.wait()
        self._thread.join()

    def watch(
        self, now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Reading | None, master: Master
    ) -> None:
        """Look at `master` after its cycle at `now` [s]; one of the `watches` of a run."""
        if self._times is None:
            self._times, self._begin = CycleTimes(master.settings.bus.cycle), now
        wall = self._clock()
        self._times.take(wall, 0.0)
        self._last = (master, now)
        if wall - self._drawn >= _PERIOD:
            self._drawn = wall
            self._draw()

    def _draw(self) -> None:
        """Make a line of what was seen last."""
        if self._last is not None and self._times is not None:
            picture = picture_of(*self._last, self._times, begin=self._begin)
            self._line = json.dumps({**self._about, **picture}).encode() + b"\n"

    def _feed(self, screen: subprocess.Popen[bytes]) -> None:
        # A process that draws no more ends the view, not the run.
        with contextlib.suppress(OSError):
            over = False
            while not over:
                over = self._over.wait(_PERIOD)
                line = self._line
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
