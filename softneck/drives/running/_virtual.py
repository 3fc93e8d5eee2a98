"""A run in virtual time: master, frames, simulated drives, neck and inclinometer, as fast as the machine can."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import SettingsError, to_si
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot

from ..bus._file import DrivesFile
from ..bus._link import VirtualLink
from ..master import Frame, Master
from ..master._gate import Reading
from ..simulated import SimulatedNeck, SimulatedSettings
from ..simulated._springs import SimulatedSprings, SpringSettings

# A run is over at the latest this long after its loop, whatever happens [s].
_PATIENCE = 120.0

# Called after each cycle: (now, frames in, frames out, sample of the inclinometer or None, master).
Watch = Callable[[float, Sequence[Frame], Sequence[Frame], Reading | None, Master], None]
# Noise of the stand-in's sensor where the robot gives none [rad]: none at all would look frozen.
_LITTLE = 1e-5


def simulated_neck(file: DrivesFile, parameters: NeckParameters, **how: Any) -> SimulatedNeck:
    """Return the virtual neck, or a robot built like it, with drives that are set up as `file` says the real ones are.

    Args:
        file: of the drives, and what they move.
        parameters: physics.
        how: `sample_time`, `homed`, `seed`, `habits`: see `SimulatedSettings`.

    Raises:
        SettingsError: a robot without tendons, or that the neck's physics does not fit.
    """
    return SimulatedNeck(parameters, _settings(file, **how), file.moves)


def simulated_springs(file: DrivesFile, **how: Any) -> SimulatedSprings:
    """Return drives on what stands for a robot without virtual plant: springs, and outputs by its directions.

    Gain and lag of the outputs are those that the drives file watches for, motors and winches its own.

    Raises:
        SettingsError: the robot's directions are to be identified: nobody knows yet what its motors do.
    """
    robot, neck = file.moves, file.neck
    weights = robot.weights()
    if weights is None:
        raise SettingsError(
            f"robot {robot.label()}: its directions are to be identified, so that nothing can stand for it; simulated "
            'drives need `directions` of kind "tendons" or "matrix".'
        )
    springs = SpringSettings(
        outputs=robot.outputs.names,
        weights=np.ascontiguousarray(file.watch.gain * weights),
        pole=file.watch.pole,
        reach=tuple(max(-low, high) for low, high, _ in file.ranges),
        torque_constant=neck.torque_constant,
        efficiency=neck.efficiency,
        current_limit=tuple(entry.current_limit for entry in file.drives),
        winch_radius=neck.winch_radius,
        pretension_current=file.zero.current,
        noise_std=(robot.noise_std or 0.0) * to_si(robot.outputs.unit)[0] or _LITTLE,
    )
    return SimulatedSprings(springs, _settings(file, **how))


def simulated_plant(file: DrivesFile, neck: NeckParameters | None, **how: Any) -> SimulatedNeck | SimulatedSprings:
    """Return what the simulated drives of `file` turn: the virtual plant, or springs where nothing stands for a robot.

    Args:
        file: of the drives, and what they move.
        neck: physics of the virtual plant; None: those that the robot names.
        how: see `simulated_neck`.
    """
    physics = physics_of(file.moves, neck)
    return simulated_springs(file, **how) if physics is None else simulated_neck(file, physics, **how)


def physics_of(robot: Robot, neck: NeckParameters | None = None) -> NeckParameters | None:
    """Return the physics of what stands for a robot: `neck`, or what the robot names; None where nothing does."""
    if robot.tendon_angles is None or (neck is None and robot.neck is None):
        return None
    return VirtualNeck.of(robot, neck).parameters


def stand_in(file: DrivesFile, neck: NeckParameters | None) -> str:
    """Return what to say of simulated drives that turn no virtual plant, "" of the others."""
    if physics_of(file.moves, neck) is not None:
        return ""
    gain, pole = file.watch.gain, file.watch.pole
    return (
        f"robot {file.moves.label()} has no virtual plant here: each motor turns a spring, and the outputs follow its "
        f"directions by {gain:.3g} rad/rad with one time constant, {1.0 / pole:.3g} s ([watch] of the drives file)"
    )


def _settings(file: DrivesFile, *, sample_time: float, **how: Any) -> SimulatedSettings:
    scales = [entry.scale for entry in file.drives]
    return SimulatedSettings(
        nodes=file.nodes,
        profile=file.profile,
        gear=tuple(scale.gear for scale in scales),
        counts_per_turn=tuple(scale.counts_per_turn for scale in scales),
        reversed=tuple(scale.reversed for scale in scales),
        peak_current=tuple(scale.peak_current for scale in scales),
        slow_loop=tuple(scale.slow_loop for scale in scales),
        sample_time=sample_time,
        cycle=file.cycle,
        hold=sample_time,
        **{name: value for name, value in how.items() if value is not None},
    )


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
    newest: Reading | None = None
    watches: tuple[Watch, ...] = ()

    def step(self) -> None:
        """One cycle: sensor, master, frames, and the time until the next."""
        link, master = self.link, self.master
        link.sampling = False
        now = link.now
        if self.cycles % master.settings.sample_cycles == 0:
            link.neck.sample(now)
            self.newest = link.newest
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
