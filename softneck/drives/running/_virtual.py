"""A run in virtual time: master, frames, simulated drives, neck and inclinometer, as fast as the machine can."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from softneck.plant import NeckParameters

from ..bus._file import DrivesFile
from ..bus._link import VirtualLink
from ..master import Frame, Master, Tilt
from ..simulated import SimulatedNeck, SimulatedSettings

# A run is over at the latest this long after its loop, whatever happens [s].
_PATIENCE = 120.0

# Called after each cycle: (now, frames in, frames out, sample of the inclinometer or None, master).
Watch = Callable[[float, Sequence[Frame], Sequence[Frame], Tilt | None, Master], None]


def simulated_neck(
    file: DrivesFile, parameters: NeckParameters, *, sample_time: float, homed: bool = True, seed: int = 0
) -> SimulatedNeck:
    """Return the virtual neck with drives that are set up as `file` says the real ones are."""
    one, two, three = (entry.scale for entry in file.drives)
    settings = SimulatedSettings(
        nodes=file.nodes,
        profile=file.profile,
        gear=(one.gear, two.gear, three.gear),
        counts_per_turn=(one.counts_per_turn, two.counts_per_turn, three.counts_per_turn),
        reversed=(one.reversed, two.reversed, three.reversed),
        peak_current=(one.peak_current, two.peak_current, three.peak_current),
        slow_loop=(one.slow_loop, two.slow_loop, three.slow_loop),
        sample_time=sample_time,
        cycle=file.cycle,
        hold=sample_time,
        homed=homed,
        seed=seed,
    )
    return SimulatedNeck(parameters, settings)


@dataclass(slots=True)
class VirtualRun:
    """One run in virtual time; `step` is one bus cycle.

    Attributes:
        link: to the simulated drives.
        master: what runs them.
        host_stopped: the host process hangs or is gone: its master is not stepped.
        watch: called after each step.
        watches: called after each step of the master with what it got and sent.
        cycles: number of steps so far.
        newest: the inclinometer's sample that the master did not read yet.
    """

    link: VirtualLink
    master: Master
    host_stopped: bool = False
    watch: Callable[[VirtualRun], None] | None = None
    cycles: int = 0
    newest: Tilt | None = None
    watches: tuple[Watch, ...] = ()

    def step(self) -> None:
        """One cycle: sensor, master, frames, and the time until the next."""
        link, master = self.link, self.master
        link.sampling = False
        now = link.now
        if self.cycles % master.settings.sample_cycles == 0:
            sample = link.neck.sample(now)
            self.newest = Tilt(sample.pitch, sample.roll, sample.pitch_rate, sample.roll_rate, sample.valid)
        if self.host_stopped:
            link.send(())
        else:
            tilt = None
            if master.sample_due:
                tilt, self.newest = self.newest, None
            frames = link.drain()
            out = master.step(now, frames, tilt)
            link.send(out)
            for watch in self.watches:
                watch(now, frames, out, tilt, master)
        if self.watch is not None:
            self.watch(self)
        link.pass_time()
        self.cycles += 1

    def run(self, most: float) -> None:
        """Step until the master is done, for at most `most` + 120 s of virtual time."""
        cycles = round((most + _PATIENCE) / self.link.cycle)
        for _ in range(cycles):
            if self.master.finished:
                return
            self.step()


def recorded(link: VirtualLink) -> list[tuple[float, bool, Frame]]:
    """Return a list that will hold every frame on the wire: (time, from the master, frame)."""
    frames: list[tuple[float, bool, Frame]] = []
    link.tap = lambda now, from_master, frame: frames.append((now, from_master, frame))
    return frames
