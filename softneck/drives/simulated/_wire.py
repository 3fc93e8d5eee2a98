"""What real wires and controllers do to frames: late SDO answers, queues with an end, one frame at a time.

Everything is off by default: then a frame is there when it is sent.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence

from ._frame import CanFrame
from ._habits import WireHabits

_OVERRUN = 0x8110


def frame_bits(frame: CanFrame) -> int:
    """Return the most bits that a frame of 11-bit identifier takes, stuffed, with the pause behind it.

    `47 + 8 n + floor((34 + 8 n - 1)/4)` for n bytes (Davis et al., Real-Time Systems 35, 2007, Eq. 1).
    """
    n = 0 if frame.remote else len(frame.data)
    return 47 + 8 * n + (34 + 8 * n - 1) // 4


class Wire:
    """The wire of some drives.

    Attributes:
        habits: as given.
        lost: frames that found a queue full, by drive.
        bits: that went over the wire so far.
    """

    def __init__(self, habits: WireHabits, cycle: float) -> None:
        """Begin with empty queues; within one `cycle` [s] of the bus frames come out with what went in."""
        self.habits = habits
        self.lost: defaultdict[int, int] = defaultdict(int)
        self.bits = 0
        self._late: list[tuple[float, int, CanFrame]] = []
        self._queues: defaultdict[int, deque[CanFrame]] = defaultdict(deque)
        self._most = cycle * habits.bitrate
        self._free, self._at = self._most, 0.0

    def passed(self, now: float, heard: Sequence[CanFrame], said: Sequence[Sequence[CanFrame]]) -> list[CanFrame]:
        """Return what comes out at `now` [s] after `heard` went in and each drive `said` something.

        Answers come with their request while the wire has time left in this cycle; the others wait for it.
        """
        for row, frames in enumerate(said):
            for frame in frames:
                if self.habits.sdo_latency and 0x580 <= frame.identifier < 0x600:
                    self._late.append((now + self.habits.sdo_latency, row, frame))
                else:
                    self._queue(row, frame)
        due = [entry for entry in self._late if entry[0] <= now + 1e-9]
        self._late = [entry for entry in self._late if entry[0] > now + 1e-9]
        for _, row, frame in due:
            self._queue(row, frame)
        return self._arbitrated(now, heard)

    def overrun(self, row: int) -> int:
        """Return the EMCY code of a drive that lost frames since it was asked last, or 0."""
        lost, self.lost[row] = self.lost[row], 0
        return _OVERRUN if lost else 0

    def _queue(self, row: int, frame: CanFrame) -> None:
        if self.habits.queue and len(self._queues[row]) >= self.habits.queue:
            self.lost[row] += 1
        else:
            self._queues[row].append(frame)

    def _arbitrated(self, now: float, heard: Sequence[CanFrame]) -> list[CanFrame]:
        """Take from the queues the lowest identifiers while the wire has time: that of one cycle at most."""
        rate, out = self.habits.bitrate, []
        if rate:
            self._free = min(self._free + (now - self._at) * rate, self._most)
            self._at = now
            spent = sum(map(frame_bits, heard))
            self._free -= spent
            self.bits += spent
        while any(self._queues.values()):
            row = min((q[0].identifier, row) for row, q in self._queues.items() if q)[1]
            size = frame_bits(self._queues[row][0])
            if rate and self._free < size:
                break
            self._free -= size if rate else 0
            self.bits += size
            out.append(self._queues[row].popleft())
        return out
