"""Master and simulated drives on one virtual wire, with a pilot that does as the test says, and what to break."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

from softneck.drives import DrivesFile, default_drives
from softneck.drives.bus._link import VirtualLink
from softneck.drives.bus._objects import Write, guarding_writes, limit_writes, mode_writes, option_writes, pdo_writes
from softneck.drives.master import Frame, Master, MasterSettings, Phase
from softneck.drives.master._fieldbus import Command, nmt_frame
from softneck.drives.master._master import Measurement
from softneck.drives.master._settings import RampSettings
from softneck.drives.running._virtual import VirtualRun, simulated_plant
from softneck.drives.simulated import SimulatedDrive, SimulatedNeck
from softneck.drives.simulated._drives import SimulatedDrives
from softneck.drives.simulated._quirks import DriveQuirks
from softneck.plant import NeckParameters
from softneck.plant._neck_runtime import VirtualNeckArrays, VirtualNeckState

T = 0.01
TS = 0.02
FAULT, REACTION, ENABLED, DISABLED = 0x08, 0x0F, 0x27, 0x40
# Ramps as short as the neck allows: what is tested comes after them.
FAST = RampSettings(speed=3.0, settle=0.04, tolerance=0.2)


def tear(neck: SimulatedDrives, tendon: int) -> None:
    """Make a tendon slack, one metre too long; the first has number 1."""
    assert isinstance(neck, SimulatedNeck)
    neck._x[VirtualNeckState.parts(VirtualNeckArrays(neck._arrays))["free"]][tendon - 1] += 1.0


class Script:
    """A pilot that asks for `wanted`, or does what `act` says."""

    def __init__(self, rows: int = 100_000, motors: int = 3) -> None:
        self.wanted: tuple[float, ...] = (0.5, *(-0.5 / max(motors - 1, 1),) * (motors - 1))
        self.act: Callable[[Measurement], tuple[float, ...] | None] | None = None
        self.rows, self.started, self.steps = rows, 0, 0

    def start(self) -> None:
        self.started += 1

    def step(self, measured: Measurement) -> tuple[float, ...] | None:
        self.steps += 1
        return self.wanted if self.act is None else self.act(measured)

    @property
    def reference(self) -> tuple[float, ...]:
        return getattr(self.act, "reference", ())

    def is_finished(self, index: int) -> bool:
        return index >= self.rows


class Bench:
    """One run that can be broken in every way of the fault table.

    Attributes:
        stopped_at: when the master began to stop; drive_stopped_at: when each drive left Operation Enabled.
        restarted: drives that were enabled again after they or the master had stopped.
        widest: largest set-point while the controller ran [rad].
    """

    def __init__(
        self,
        *,
        file: DrivesFile | None = None,
        off: frozenset[str] = frozenset(),
        drive_changes: tuple[Write, ...] = (),
        change: Callable[[MasterSettings], MasterSettings] | None = None,
        guarding: str = "life",
        neck: NeckParameters | None = None,
        seed: int = 0,
        rows: int = 100_000,
        profile: str = "ipos2015",
        quirks: DriveQuirks | None = None,
    ) -> None:
        self.file = replace(file or default_drives(profile), ramps=FAST)
        count = len(self.file.drives)
        self.neck = simulated_plant(self.file, neck or NeckParameters.paper(), sample_time=TS, seed=seed, quirks=quirks)
        self.link = VirtualLink(self.neck)
        self.pilot = Script(rows, count)
        late = self.file.nodes if quirks is not None and quirks.mode_when == "enabled" else ()
        settings = self.file.master_settings(TS, guarding=guarding, late_modes=late)
        settings = replace(settings, bus=replace(settings.bus, off=off))
        self.master = Master(settings if change is None else change(settings), self.pilot)
        for entry, drive in zip(self.file.drives, self.neck.drives, strict=True):
            writes = [*mode_writes(self.file), *option_writes(), *limit_writes(self.file, entry)]
            writes += [
                *guarding_writes(self.file, guarding, 127),
                *pdo_writes(entry, self.file.profile),
                *drive_changes,
            ]
            configure(drive, [write for write in writes if not (late and write.at == 0x6060)])
        self.link.send([nmt_frame(Command.START, 0)])
        self.link.drain()
        self.run = VirtualRun(self.link, self.master)
        self.advance: Callable[[], None] = self.run.step
        self.jobs: list[tuple[float, Callable[[Bench], object]]] = []
        self.stopped_at: float | None = None
        self.drive_stopped_at: list[float | None] = [None] * count
        self._enabled_once = [False] * count
        self.restarted: set[int] = set()
        self.widest = 0.0
        self.trace = hashlib.sha256()
        self.link.tap = self._tapped

    @property
    def now(self) -> float:
        return self.link.now

    @property
    def phase(self) -> Phase:
        return self.master.supervisor.phase

    @property
    def states(self) -> list[int]:
        return [drive.axis.state for drive in self.neck.drives]

    def at(self, time: float, job: Callable[[Bench], object]) -> None:
        """Do `job` before the cycle at `time` [s]."""
        self.jobs.append((time, job))

    def _tapped(self, now: float, from_master: bool, frame: Frame) -> None:
        self.trace.update(f"{now:.4f}{from_master}{frame}".encode())

    def step(self) -> None:
        for time, job in [pair for pair in self.jobs if pair[0] <= self.now + 1e-9]:
            self.jobs.remove((time, job))
            job(self)
        time = self.now
        self.advance()
        if self.phase is Phase.RUNNING:
            self.widest = max(self.widest, *map(abs, self.master.setpoints))
        # What the master did in this cycle it did at its begin.
        if self.stopped_at is None and self.phase in (Phase.STOPPING, Phase.STOPPED, Phase.RETREAT):
            self.stopped_at = time
        for i, drive in enumerate(self.neck.drives):
            powered = drive.axis.state == ENABLED
            if powered and self.drive_stopped_at[i] is not None:
                self.restarted.add(i)
            if self._enabled_once[i] and not powered and self.drive_stopped_at[i] is None:
                self.drive_stopped_at[i] = time
            self._enabled_once[i] = self._enabled_once[i] or powered

    def pass_time(self, seconds: float) -> Bench:
        for _ in range(round(seconds / T)):
            self.step()
        return self

    def start(self, *, most: float = 6.0) -> Bench:
        """Enable, ramp in, and run for 0.2 s."""
        self.master.start()
        until = self.now + most
        while self.phase is not Phase.RUNNING and self.now < until and not self.master.finished:
            self.step()
        return self.pass_time(0.2)

    def finish(self, seconds: float = 4.0) -> Bench:
        until = self.now + seconds
        while not self.master.finished and self.now < until:
            self.step()
        return self

    def host_stopped(self, stopped: bool) -> None:
        """Hang the host's process: no step, no frame; frames for it wait in its queue."""
        self.run.host_stopped = stopped


def configure(drive: SimulatedDrive, writes: list[Write]) -> None:
    """Write objects into a drive without a bus."""
    for write in writes:
        item = drive.axis.profile.items[(write.at, write.sub)]
        data = (write.value & ((1 << 8 * item.size) - 1)).to_bytes(item.size, "little")
        code = drive._write(write.at, write.sub, data)
        assert code == 0, f"{write.at:04X}h:{write.sub} {write.value}: {code:08X}h"
