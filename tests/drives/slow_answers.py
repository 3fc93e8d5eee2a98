"""Simulated drives whose SDO answers take their time, as some real ones do."""

from __future__ import annotations

from collections import deque

from softneck.drives.bus._link import VirtualLink
from softneck.drives.master import Frame
from softneck.drives.simulated import SimulatedNeck


class SlowAnswers(VirtualLink):
    """Each SDO answer comes `delay` [s] later; all else at once."""

    def __init__(self, neck: SimulatedNeck, delay: float) -> None:
        super().__init__(neck)
        self.delay = delay
        self._late: deque[tuple[float, Frame]] = deque()

    def _passes(self, from_master: bool, frame: Frame) -> bool:
        if not from_master and 0x580 < frame.identifier < 0x600:
            self._late.append((self.now + self.delay, frame))
            return False
        return super()._passes(from_master, frame)

    def pass_time(self) -> None:
        super().pass_time()
        while self._late and self._late[0][0] <= self.now + 1e-9:
            self._inbox.append(self._late.popleft()[1])
