"""A neck of three lines for the moves of a commissioning: tendons with slack, springs, friction, and a late sensor."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from softneck.drives.commissioning._mover import Mover
from softneck.drives.commissioning._moves import Guards, Moves
from softneck.drives.master import Tilt
from softneck.drives.master._master import Measurement

STEP = 0.02
COUNTS, TURN = 7717.0, 2048.0
WAYS = tuple((math.cos(a), math.sin(a)) for a in (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0))


@dataclass
class Toy:
    """What the motors turn; `counts` are those of one radian, `pull` 1 or -1, `slack` in radians of the winch."""

    counts: tuple[float, ...] = (COUNTS, COUNTS, COUNTS)
    turn: tuple[float, ...] = (TURN, TURN, TURN)
    pull: tuple[int, ...] = (1, 1, 1)
    slack: tuple[float, ...] = (1.0, 1.0, 1.0)
    gain: float = 0.09
    force: float = 20.0
    friction: float = 5.0
    late: int = 3
    sees: float = 1.0
    push: float = 0.0
    stuck: tuple[int, ...] = ()
    largest: float = 0.0
    rows: int = 0
    _past: deque[tuple[float, float]] = field(default_factory=deque)

    def run(self, mover: Mover, *, most: float = 900.0, push_at: float = math.inf) -> Moves:
        """Step `mover` until it is over, stopped by a guard, or `most` seconds passed."""
        views = tuple(SimpleNamespace(counts=0, current=0.0) for _ in WAYS)
        mover.watch(SimpleNamespace(bus=SimpleNamespace(drives=views)))  # type: ignore[arg-type]
        mover.start()
        believed = [0.0] * len(WAYS)
        for index in range(round(most / STEP)):
            now, before = index * STEP, believed
            tilt = self._tilt(views, push=self.push if now >= push_at else 0.0)
            if mover.is_finished(index) or mover.stopped:
                break
            positions = tuple(view.counts / COUNTS for view in views)
            asked = mover.step(Measurement(index, Tilt(*tilt), True, positions))
            believed = list(asked or believed)
            for j, view in enumerate(views):
                if j not in self.stuck:
                    self._move(j, view, believed[j], before[j], mover)
            self.rows = index
        return Moves(tuple(mover.done), mover.stopped)

    def _move(self, j: int, view: Any, wanted: float, before: float, mover: Mover) -> None:
        view.counts = round(wanted * COUNTS)
        taut = max(0.0, self.pull[j] * view.counts / self.counts[j] - self.slack[j])
        moving = (wanted > before) - (wanted < before)
        view.current = self.friction * moving + self.pull[j] * self.force * taut
        if mover.motor == j + 1:
            turn = math.floor((view.counts + 700) / self.turn[j])
            if turn != math.floor((round(before * COUNTS) + 700) / self.turn[j]):
                mover.captured = round(max(turn, 0 if turn < 0 else turn) * self.turn[j])

    def _tilt(self, views: tuple[Any, ...], *, push: float) -> tuple[float, float]:
        pitch = roll = 0.0
        for j, (x, y) in enumerate(WAYS):
            taut = max(0.0, self.pull[j] * views[j].counts / self.counts[j] - self.slack[j])
            pitch, roll = pitch + self.gain * taut * x, roll + self.gain * taut * y
        pitch += push
        self.largest = max(self.largest, math.hypot(pitch, roll))
        self._past.append((self.sees * pitch, self.sees * roll))
        return self._past.popleft() if len(self._past) > self.late else self._past[0]


def mover_of(guards: Guards | None = None, motors: tuple[int, ...] = (1, 2, 3)) -> Mover:
    """Return what moves the toy's motors, as drives with the right scales would be."""
    guards = Guards() if guards is None else guards
    return Mover(guards, (1, 2, 3), (COUNTS,) * 3, (TURN,) * 3, motors=motors, sample_time=STEP)
