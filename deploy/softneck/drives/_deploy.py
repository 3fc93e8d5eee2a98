"""A whole run: pre-flight, enabling, ramps, the loop, ramps, off; on simulated drives or on a bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from softneck.core import SettingsError, SoftneckError, load
from softneck.cosim import FmuPart, LoopSetup
from softneck.loop import BlockPart, Loop, Part
from softneck.plant import NeckParameters

from ._file import DrivesFile
from ._link import CanLink, VirtualLink
from ._objects import disarm_writes
from ._pilot import LoopPilot
from ._preflight import Report, preflight
from ._result import DrivesResult, RunLog
from ._sdo import Objects, SdoError, load_eds
from ._virtual import VirtualRun, simulated_neck
from .master import Command as NmtCommand
from .master import Frame, Master, MasterSettings, Tilt, nmt_frame

# Before the first cycle on a bus each drive is given this time to become operational [s].
_START_TIME = 0.1
_NECK = "virtual_neck"


class Sensor(Protocol):
    """An inclinometer on hardware."""

    def take(self, frames: Sequence[Frame]) -> None:
        """Look at frames of a cycle in which no sample is due; a sensor that is not on the bus ignores them."""
        ...

    def read(self, now: float, frames: Sequence[Frame]) -> Tilt | None:
        """Return the newest sample, None if none came since the last call."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Deployed:
    """A loop that is ready for drives.

    Attributes:
        loop: with the controller that is to run.
        neck: the virtual neck that the loop's plant is, None if it is none.
        notes: what of the loop file does not apply on drives.
    """

    loop: Loop
    neck: NeckParameters | None
    notes: tuple[str, ...] = ()


def prepare(setup: LoopSetup, controller: Path | None = None) -> Deployed:
    """Return the loop of `setup` with the controller in file `controller`, an FMU or a file of ours.

    Raises:
        SettingsError: a controller that does not fit the loop.
    """
    loop, notes = setup.loop, []
    if controller is not None:
        part: Part
        if controller.suffix.lower() == ".fmu":
            part = FmuPart(controller, role="controller")
        else:
            part = BlockPart(load(controller, role="controller").block())
        loop = replace(loop, controller=part)
    if loop.faults:
        notes.append(f"the loop file's {len(loop.faults)} fault(s) are not acted out on drives")
    return Deployed(loop, neck_of(loop), tuple(notes))


def neck_of(loop: Loop) -> NeckParameters | None:
    """Return the virtual neck that a loop's plant is, with the loop's own values; None for any other plant."""
    block = getattr(loop.plant, "block", None)
    ports = getattr(loop.plant, "parameters", None) or getattr(block, "parameters", ())
    starts = {port.name: port.start for port in ports}
    names = NeckParameters.names()
    if not all(name in starts for name in names):
        return None
    values = {name: starts[name] for name in names}
    values |= {name: value for name, value in loop.plant_parameters.items() if name in values}
    return NeckParameters(**values)


def noise_seed(loop: Loop) -> int:
    """Return the seed of the loop's virtual neck."""
    return int(loop.plant_parameters.get("noise_seed", 0))


def run_simulated(
    deployed: Deployed,
    file: DrivesFile,
    *,
    neck: NeckParameters | None = None,
    override: Collection[str] = (),
    pace: float | None = None,
    report: Callable[[float], None] | None = None,
    hook: Callable[[VirtualRun], None] | None = None,
    settings: Callable[[MasterSettings], MasterSettings] | None = None,
    watch: Callable[[Master, float], None] | None = None,
) -> DrivesResult:
    """Run the whole loop on simulated drives, in virtual time.

    Args:
        deployed: the loop.
        file: how drives and master are set up.
        neck: the virtual neck; that of the loop where it has one and none is given.
        override: names of pre-flight checks that may fail.
        pace: at this multiple of real time; as fast as possible if not given.
        report: called now and then with the done fraction.
        hook: called after each bus cycle, to let things go wrong.
        settings: changes the master's settings, for tests.
        watch: called after each bus cycle with the master and the cycle's time; it looks and changes nothing.

    Raises:
        CheckFailedError: the pre-flight failed.
        SettingsError: no neck is known.
    """
    parameters = neck or deployed.neck
    if parameters is None:
        raise SettingsError("the loop's plant is no virtual neck; say which one the drives shall turn (--neck).")
    loop = deployed.loop
    pilot = LoopPilot(loop)
    virtual = simulated_neck(file, parameters, sample_time=pilot.sample_time, seed=noise_seed(loop))
    disturbances = {name: value for name, value in loop.plant_inputs.items() if not name.startswith("motor_")}
    virtual.set(**disturbances)
    link = VirtualLink(virtual)
    checked = preflight(link, file, override=override, homed=True)
    checked.require()
    master = _master(pilot, file, checked, settings)
    link.send([nmt_frame(NmtCommand.START, node) for node in file.nodes])
    link.receive(_START_TIME)
    log = RunLog(pilot)
    run = VirtualRun(link, master)
    rows = max(1, round(loop.duration / pilot.sample_time))
    begin, first = time.perf_counter(), link.now

    def after(state: VirtualRun) -> None:
        index = master.index
        if master.ran:
            log.take(master, index, virtual.truth())
            if report is not None and index % 50 == 0:
                report(min(1.0, index / rows))
        if hook is not None:
            hook(state)
        if watch is not None:
            watch(master, link.now)
        if pace is not None:
            rest = begin + (link.now - first + link.cycle) / pace - time.perf_counter()
            if rest > 0.0:
                time.sleep(rest)

    run.watch = after
    master.start()
    try:
        run.run(loop.duration)
    finally:
        pilot.close()
    _disarm(link, file, checked.guarding)
    wall = time.perf_counter() - begin
    return _result(master, log, pilot, wall, simulated=True, notes=deployed.notes)


def run_on_bus(
    deployed: Deployed,
    file: DrivesFile,
    link: CanLink,
    sensor: Sensor,
    *,
    override: Collection[str] = (),
    report: Callable[[float], None] | None = None,
    stopped: Callable[[], bool] | None = None,
    watch: Callable[[Master, float], None] | None = None,
) -> DrivesResult:
    """Run the loop on the drives behind `link`, at the pace of the monotonic clock.

    Args:
        deployed: the loop.
        file: how drives and master are set up.
        link: an open bus.
        sensor: the inclinometer.
        override: names of pre-flight checks that may fail.
        report: called now and then with the done fraction.
        stopped: asked each cycle whether the operator wants to stop.
        watch: called after each bus cycle, its frames sent, with the master and the cycle's time; it looks and
            changes nothing.

    Raises:
        CheckFailedError: the pre-flight failed; nothing moved.
    """
    pilot = LoopPilot(deployed.loop)
    pilot.warm()
    checked = preflight(link, file, override=override, homed=True)
    checked.require()
    master = _master(pilot, file, checked, None)
    link.send([nmt_frame(NmtCommand.START, node) for node in file.nodes])
    time.sleep(_START_TIME)
    link.receive(0.0)
    log = RunLog(pilot)
    rows = max(1, round(deployed.loop.duration / pilot.sample_time))
    begin = time.perf_counter()
    master.start()
    try:
        longest = _cycle(link, master, sensor, log, stopped, report, watch, rows)
    except BaseException:
        # Whatever happens here must not leave a drive on: this loop is what feeds them.
        _emergency_stop(link, file)
        raise
    finally:
        pilot.close()
    _disarm(link, file, checked.guarding)
    wall = time.perf_counter() - begin
    return _result(master, log, pilot, wall, simulated=False, notes=deployed.notes, longest=longest)


def _cycle(
    link: CanLink,
    master: Master,
    sensor: Sensor,
    log: RunLog,
    stopped: Callable[[], bool] | None,
    report: Callable[[float], None] | None,
    watch: Callable[[Master, float], None] | None,
    rows: int,
) -> float:
    """Step the master at its period until it is done; return its longest step [s]."""
    period = master.settings.bus.cycle
    due, longest = link.now, 0.0
    while not master.finished:
        rest = due - link.now
        if rest > 0.0:
            time.sleep(rest)
        now = link.now
        # All that is there, so that one late TPDO does not leave a lag for ever.
        frames = link.receive(0.0)
        tilt = None
        if master.sample_due:
            tilt = sensor.read(now, frames)
        else:
            sensor.take(frames)
        if stopped is not None and stopped():
            master.stop("asked to")
        out = master.step(now, frames, tilt)
        link.send(out)
        longest = max(longest, link.now - now)
        if master.ran:
            log.take(master, master.index, None)
            if report is not None and master.index % 50 == 0:
                report(min(1.0, master.index / rows))
        if watch is not None:
            watch(master, now)
        due = max(due + period, now + 0.5 * period) if link.now - due > period else due + period
    return longest


def _master(
    pilot: LoopPilot,
    file: DrivesFile,
    checked: Report,
    change: Callable[[MasterSettings], MasterSettings] | None,
) -> Master:
    settings = file.master_settings(pilot.sample_time, guarding=checked.guarding)
    return Master(settings if change is None else change(settings), pilot)


def _disarm(link: CanLink | VirtualLink, file: DrivesFile, guarding: str) -> None:
    """End the guarding of drives that are off; one that does not answer keeps it, and faults: so be it."""
    dictionary = load_eds(file.profile, file.eds)
    for node in file.nodes:
        objects = Objects(link, node, dictionary)
        try:
            for write in disarm_writes(guarding):
                objects.write(write.index, write.subindex, write.value)
        except (SdoError, SoftneckError):
            continue


def _emergency_stop(link: CanLink, file: DrivesFile) -> None:
    from ._zero import stop

    try:
        stop(link, file)
    except SoftneckError:
        return


def _result(
    master: Master,
    log: RunLog,
    pilot: LoopPilot,
    wall: float,
    *,
    simulated: bool,
    notes: Sequence[str],
    longest: float = 0.0,
) -> DrivesResult:
    return DrivesResult(
        signals=log.result(pilot.sample_time, truth=simulated),
        phase=str(master.supervisor.phase),
        fault=master.supervisor.fault,
        counts=dict(master.counts),
        events=tuple(master.events),
        rehome=master.supervisor.rehome,
        cycles=master.cycle,
        cycle=master.settings.bus.cycle,
        wall_time=wall,
        simulated=simulated,
        longest_step=longest,
        notes=tuple(notes),
    )
