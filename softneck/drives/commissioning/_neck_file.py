"""The drives file that fits a virtual neck: what one would write after setting up its drives."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from softneck.core import Vector
from softneck.plant import NeckParameters, VirtualNeck, settle
from softneck.plant._neck import has_own_tendons, tendons_of
from softneck.robot import Robot

from ..bus._file import DrivesFile, Neck, default_drives

# The tilt that tells the gain: the middle of what the neck does [rad of theta_i].
_PULLED = 3.0


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
    meant = np.cos(np.radians(neck.robot.directions.angles_deg))
    P: Vector = _PULLED / np.dot(meant, meant) * np.cos(tendons_of(neck.robot, neck.parameters))
    out = settle(neck.block(), P).outputs
    return math.hypot(*(float(angle) for angle in out[: len(neck.robot.outputs.names)]))
