"""A whole run: pre-flight, enabling, ramps, the loop, ramps, off; on simulated drives or on a bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from softneck.core import CheckFailedError, load
from softneck.cosim import FmuPart, LoopSetup, describe_excess_range
from softneck.loop import BlockPart, Loop, Part
from softneck.plant import NeckParameters, has_own_tendons
from softneck.robot import Robot, is_set_point
from softneck.signals import NECK, require_same_robot

from ..bus._file import DrivesFile
from ..bus._link import CanLink, VirtualLink
from ..logs._result import DrivesResult
from ..master import Frame, Master
from ..sensing._sources import Sensor
from ._bus_loop import Session, run_session
from ._pilot import LoopPilot, RunLog
from ._virtual import simulated_plant


@dataclass(frozen=True, slots=True, eq=False)
class Deployment:
    """A loop that is ready for drives.

    `loop`: with the controller that is to run. `neck`: the loop's plant if that is a virtual neck, else None. `notes`:
    what of the loop file does not apply on drives.
    """

    loop: Loop
    neck: NeckParameters | None
    notes: tuple[str, ...] = ()


def prepare(setup: LoopSetup, controller: Path | None = None, robot: Robot | None = None) -> Deployment:
    """Return the loop of `setup` with the controller in file `controller`, an FMU or a softneck file.

    Args:
        setup: the loop, as its file describes it.
        controller: that is to run; None: the loop's own.
        robot: what the drives move; None: the neck.

    Raises:
        SettingsError: a controller that does not fit the loop.
        DataError: one of another robot.
        CheckFailedError: one that may send motors beyond the robot's range.
    """
    loop, notes = setup.loop, []
    if controller is not None:
        part: Part
        if controller.suffix.lower() == ".fmu":
            part = FmuPart(controller, role="controller")
        else:
            found = load(controller, role="controller")
            require_same_robot(robot or NECK, getattr(found, "robot", NECK), f"{controller} and drives")
            part = BlockPart(found.block())
        loop = replace(loop, controller=part)
    beyond = "" if robot is None else describe_excess_range(loop.controller, loop.controller_parameters, robot)
    if beyond:
        raise CheckFailedError(f"{beyond}, and so were its certificates. Design and certify it for that robot.")
    if loop.faults:
        notes.append(f"the loop file's {len(loop.faults)} fault(s) are not applied to drives")
    return Deployment(loop, neck_of(loop), tuple(notes))


def neck_of(loop: Loop) -> NeckParameters | None:
    """Return the virtual neck that a loop's plant is, with the loop's own values; None for any other plant."""
    block = getattr(loop.plant, "block", None)
    ports = getattr(loop.plant, "parameters", None) or getattr(block, "parameters", ())
    starts = {port.name: port.start for port in ports}
    # The tendons of another robot stand where its robot file says.
    names = [
        name for name in NeckParameters.names() if has_own_tendons(loop.robot) or not name.startswith("tendon_angle")
    ]
    if not all(name in starts for name in names):
        return None
    values = {name: starts[name] for name in names}
    values |= {name: value for name, value in loop.plant_parameters.items() if name in values}
    return NeckParameters(**values)


def noise_seed(loop: Loop) -> int:
    """Return the seed of the loop's virtual neck."""
    return int(loop.plant_parameters.get("noise_seed", 0))


def run_simulated(
    deployed: Deployment,
    file: DrivesFile,
    *,
    neck: NeckParameters | None = None,
    report: Callable[[float], None] | None = None,
    hook: Callable[[VirtualLink], None] | None = None,
    **how: Any,
) -> DrivesResult:
    """Run the whole loop on simulated drives, in virtual time.

    Args:
        deployed: the loop.
        file: how drives and master are set up.
        neck: the virtual neck; if not given, that of the loop, else that of the robot.
        report: called now and then with the done fraction.
        hook: called after each bus cycle, to let things go wrong.
        how: see `Session`; of `files` a replay looks for "loop" and "controller".

    Raises:
        CheckFailedError: the pre-flight failed.
    """
    loop = deployed.loop
    pilot = LoopPilot(loop, file.moves)
    virtual = simulated_plant(file, neck or deployed.neck, sample_time=pilot.sample_time, seed=noise_seed(loop))
    disturbances = {name: value for name, value in loop.plant_inputs.items() if not is_set_point(name)}
    virtual.set(**disturbances)
    link = VirtualLink(virtual)
    more = () if hook is None else (lambda _now, _in, _out, _tilt, _master: hook(link),)
    return _run(deployed, pilot, Session(file=file, link=link, watches=more, **how), report)


def run_on_bus(
    deployed: Deployment,
    file: DrivesFile,
    link: CanLink,
    sensor: Sensor,
    *,
    report: Callable[[float], None] | None = None,
    **how: Any,
) -> DrivesResult:
    """Run the loop on the drives of `link`, at the pace of the monotonic clock.

    Args:
        deployed: the loop.
        file: how drives and master are set up.
        link: an open bus.
        sensor: the inclinometer.
        report: called now and then with the done fraction.
        how: see `Session`; of `files` a replay looks for "loop" and "controller".

    Raises:
        CheckFailedError: the pre-flight failed; nothing moved.
    """
    pilot = LoopPilot(deployed.loop, file.moves)
    pilot.warm()
    return _run(deployed, pilot, Session(file=file, link=link, sensor=sensor, **how), report)


def _run(
    deployed: Deployment, pilot: LoopPilot, session: Session, report: Callable[[float], None] | None
) -> DrivesResult:
    log = RunLog(pilot, truth=session.simulated, folder=session.folder)
    rows = max(1, round(deployed.loop.duration / pilot.sample_time))
    neck = session.link.neck if isinstance(session.link, VirtualLink) else None

    def watch(now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Any, master: Master) -> None:
        row = log.take(now, master, None if neck is None else neck.truth())
        if not master.ran:
            return
        if session.log is not None:
            session.log.signals(row)
        if report is not None and master.index % 50 == 0:
            report(min(1.0, master.index / rows))

    try:
        ended = run_session(
            replace(session, watches=(watch, *session.watches)),
            pilot,
            sample_time=pilot.sample_time,
            most=deployed.loop.duration,
        )
    finally:
        pilot.close()
    master, (found, speeds, notes) = ended.master, log.finish(pilot.sample_time)
    return DrivesResult(
        signals=found,
        phase=str(master.supervisor.phase),
        fault=master.supervisor.fault,
        counts=dict(master.counts),
        events=tuple(master.events),
        rehome=master.supervisor.rehome,
        cycles=master.cycle,
        cycle=master.settings.bus.cycle,
        wall_time=ended.wall_time,
        simulated=session.simulated,
        times=ended.times,
        notes=(*deployed.notes, *notes),
        terminated=ended.terminated,
        speeds=speeds,
        robot=session.file.moves,
        error=ended.error,
    )
