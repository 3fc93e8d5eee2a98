"""A run in virtual time: master, frames, simulated drives, neck and inclinometer, as fast as the machine can."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, to_si
from softneck.plant import NeckParameters, VirtualNeck, has_own_tendons, settle, tendons_of
from softneck.robot import Robot

from ..bus._file import DrivesFile, Neck, default_drives
from ..bus._link import VirtualLink
from ..master import Frame, Master
from ..master._gate import Reading
from ..simulated import SimulatedNeck, SimulatedSettings
from ..simulated._springs import SimulatedSprings, SpringSettings

# A run is over at the latest this long after its loop, whatever happens [s].
_TIMEOUT_S = 120.0

# Called after each cycle: (now, frames in, frames out, sample of the inclinometer or None, master).
Watch = Callable[[float, Sequence[Frame], Sequence[Frame], Reading | None, Master], None]
# Noise of the stand-in's sensor where the robot gives none [rad]: none at all would look frozen.
_DEFAULT_NOISE_RAD = 1e-5
# The tilt that tells the gain: the middle of what the neck does [rad of theta_i].
_GAIN_AMPLITUDE_RAD = 3.0


def simulated_neck(file: DrivesFile, parameters: NeckParameters, **how: Any) -> SimulatedNeck:
    """Return the virtual neck, or a robot built like it, with drives as in `file`.

    Args:
        file: of the drives, and what they move.
        parameters: physics.
        how: `sample_time`, `homed`, `seed`, `quirks`: see `SimulatedSettings`.

    Raises:
        SettingsError: a robot without tendons, or that the neck's physics does not fit.
    """
    return SimulatedNeck(parameters, _settings(file, **how), file.moves)


def simulated_springs(file: DrivesFile, **how: Any) -> SimulatedSprings:
    """Return drives on springs, for a robot without virtual plant; its directions give the outputs.

    Gain and lag of the outputs are those that the drives file watches for, motors and winches its own.
    Raises SettingsError: the robot's directions are to be identified: nobody knows yet what its motors do.
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
        noise_std=(robot.noise_std or 0.0) * to_si(robot.outputs.unit)[0] or _DEFAULT_NOISE_RAD,
    )
    return SimulatedSprings(springs, _settings(file, **how))


def simulated_plant(file: DrivesFile, neck: NeckParameters | None, **how: Any) -> SimulatedNeck | SimulatedSprings:
    """Return the plant of the simulated drives of `file`: the virtual plant, or springs.

    `file`: of the drives, and what they move. `neck`: physics of the virtual plant; None: those that the robot names.
    `how`: see `simulated_neck`.
    """
    physics = physics_of(file.moves, neck)
    return simulated_springs(file, **how) if physics is None else simulated_neck(file, physics, **how)


def physics_of(robot: Robot, neck: NeckParameters | None = None) -> NeckParameters | None:
    """Return the physics of a robot's virtual plant: `neck`, or the one that it names; None without any."""
    if robot.tendon_angles is None or (neck is None and robot.neck is None):
        return None
    return VirtualNeck.of(robot, neck).parameters


def stand_in(file: DrivesFile, neck: NeckParameters | None) -> str:
    """Return the note on simulated drives without virtual plant; "" for others."""
    if physics_of(file.moves, neck) is not None or file.moves.weights() is None:
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
        cycles = round((most + _TIMEOUT_S) / self.link.cycle)
        for _ in range(cycles):
            if self.master.finished:
                return
            self.step()


def neck_drives(parameters: NeckParameters, robot: Robot | None = None) -> DrivesFile:
    """Return `default_drives` for the neck of `parameters`; those of the paper's neck are the default itself.

    Or for `robot` with that physics.

    Current limit, gear, winch and motor constant are the neck's. What belongs to them keeps its proportion to the
    default: the tension at which a run stops to what the motors can pull (1.9 times as much), the current that
    tightens the tendons in `zero` and the tension of one that hangs to the pretension, the watch's gain and
    tolerance and how far a hanging tendon may be let out to how far the neck tilts.
    """
    file, paper = default_drives(robot=robot), NeckParameters.paper()
    drives = tuple(
        replace(entry, current_limit=parameters.current_limit, scale=replace(entry.scale, gear=parameters.gear_ratio))
        for entry in file.drives
    )
    neck = Neck(
        winch_radius=parameters.winch_radius,
        torque_constant=parameters.torque_constant,
        efficiency=parameters.gear_efficiency,
    )
    pulls = _newton_per_ampere(parameters) / _newton_per_ampere(paper)
    pretension = parameters.pretension / paper.pretension
    upright = file.zero.tilt
    if not has_own_tendons(file.moves):
        # Friction of the gears leaves four tendons that are tightened one by one 6 deg off, where three leave 2 deg.
        upright = 2.0 * upright + _rest(VirtualNeck(parameters.without_noise(), file.moves))
    angles = (parameters.tendon_angle_1, parameters.tendon_angle_2, parameters.tendon_angle_3)
    tilts = _tilt(VirtualNeck(parameters.without_noise(), file.moves)) / _tilt(VirtualNeck(paper.without_noise()))
    return replace(
        file,
        drives=drives,
        neck=neck,
        limits=replace(
            file.limits,
            position=min(file.limits.position, parameters.position_limit),
            tension=file.limits.tension * pulls * parameters.current_limit / paper.current_limit,
            slack=file.limits.slack * pretension,
            slack_unwind=file.limits.slack_unwind * tilts,
        ),
        zero=replace(file.zero, current=file.zero.current * pretension / pulls, tilt=upright),
        watch=replace(file.watch, gain=file.watch.gain * tilts, tilt=file.watch.tilt * tilts, tendon_angles=angles),
    )


def _newton_per_ampere(p: NeckParameters) -> float:
    return p.torque_constant * p.gear_ratio * p.gear_efficiency / p.winch_radius


def _rest(neck: VirtualNeck) -> float:
    """Return how far the pretension alone bends it, where its tendons do not pull against each other [rad]."""
    out = settle(neck.block(), np.zeros(len(neck.robot.motors.names))).outputs
    return max(abs(float(angle)) for angle in out[: len(neck.robot.outputs.names)])


def _tilt(neck: VirtualNeck) -> float:
    """Return how far the neck tilts when its tendons are moved as Eq. 9 and 10 have it, without payload [rad]."""
    # Along the first output's direction, so that the motors come to as much together.
    meant = np.cos(np.radians(neck.robot.directions.angles_for(neck.robot.outputs.names)))
    P: Vector = _GAIN_AMPLITUDE_RAD / np.dot(meant, meant) * np.cos(tendons_of(neck.robot, neck.parameters))
    out = settle(neck.block(), P).outputs
    return math.hypot(*(float(angle) for angle in out[: len(neck.robot.outputs.names)]))
