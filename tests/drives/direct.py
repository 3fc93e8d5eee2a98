"""Master and simulated drives without frames: what would be on the wire goes from one to the other at once.

For hours of motion in virtual time; `test_plausibility` holds it to the frames, bit by bit.
"""

from __future__ import annotations

from collections.abc import Sequence

from softneck.drives.master import Frame
from softneck.drives.master._cia402 import Goal, control_word, state_of
from softneck.drives.master._events import Event
from softneck.drives.master._fieldbus import Fieldbus
from softneck.drives.simulated._servo_runtime import SERVO_POSITION

from .bench import Bench


class DirectBus(Fieldbus):
    """Reads and writes the objects of enabled drives themselves, as their cyclic frames would.

    Attributes:
        counts_off: of each drive: what is added to the position that it says [counts].
    """

    def __init__(self, bench: Bench) -> None:
        """Take over from the bus of `bench`, with what is under way there."""
        before = bench.master.bus
        super().__init__(before.settings)
        self.drives = before.drives
        # A control word that the drive has already changes nothing.
        self._axes = [(drive.axis, drive.axis.getters[(0x207E, 0)]) for drive in bench.neck.drives]
        self._words = [-1] * len(self._axes)
        self.counts_off = [0] * len(self._axes)
        before.receive(bench.now, bench.link.drain())
        self._told = [(view.word, view.counts, view.current) for view in self.drives]

    def receive(self, now: float, frames: Sequence[Frame]) -> list[Event]:
        """Take what the drives said at the last SYNC."""
        del now, frames
        for view, (word, counts, current), off in zip(self.drives, self._told, self.counts_off, strict=True):
            if word != view.word:
                view.word, view.state = word, state_of(word)
            view.counts, view.current, view.fresh = counts + off, current, True
        return []

    def send(self, goals: Sequence[Goal], targets: Sequence[int], *, guard: bool = True) -> list[Frame]:
        """Do what set-points and SYNC do in the drives."""
        del guard
        told = []
        for k, (axis, current) in enumerate(self._axes):
            word = control_word(self.drives[k].state, goals[k])
            axis._set_target(targets[k])
            if word != self._words[k]:
                axis._control(word)
                self._words[k] = word
            axis.synchronise()
            told.append((axis.status_word(), int(axis.motion[SERVO_POSITION]), current()))
            axis.watch()
        self._told = told
        return []


def direct(bench: Bench) -> Bench:
    """Let a bench whose drives are enabled go on without frames."""
    link, master, run = bench.link, bench.master, bench.run
    master.bus = DirectBus(bench)

    def step() -> None:
        """Do what `VirtualRun.step` does."""
        now, tilt = link.now, None
        if run.cycles % master.settings.sample_cycles == 0:
            link.neck.sample(now)
            tilt = link.newest
        master.step(now, (), tilt)
        for watch in run.watches:
            watch(now, (), (), tilt, master)
        link.pass_time()
        run.cycles += 1

    bench.advance = step
    return bench
