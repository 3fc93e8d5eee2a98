"""The drives file that fits a virtual neck: what one would write after setting up its drives."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from softneck.core import Vector
from softneck.plant import NeckParameters, VirtualNeck, settle

from ..bus._file import DrivesFile, Neck, default_drives

# The tilt that tells the gain: the middle of what the neck does [rad of theta_i].
_PULLED = 3.0


def neck_drives(parameters: NeckParameters) -> DrivesFile:
    """Return `default_drives` for the neck of `parameters`; those of the paper's neck are the default itself.

    Current limit, gear, winch and motor constant are the neck's. What belongs to them keeps its proportion to the
    default: the tension at which a run stops to what the motors can pull (1.9 times as much), the current that
    tightens the tendons in `zero` and the tension of one that hangs to the pretension, the watch's gain and
    tolerance and how far a hanging tendon may be let out to how far the neck tilts.
    """
    file, paper = default_drives(), NeckParameters.paper()
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
    tilts = _tilt(parameters) / _tilt(paper)
    angles = (parameters.tendon_angle_1, parameters.tendon_angle_2, parameters.tendon_angle_3)
    return replace(
        file,
        drives=(drives[0], drives[1], drives[2]),
        neck=neck,
        limits=replace(
            file.limits,
            position=min(file.limits.position, parameters.position_limit),
            tension=file.limits.tension * pulls * parameters.current_limit / paper.current_limit,
            slack=file.limits.slack * pretension,
            slack_unwind=file.limits.slack_unwind * tilts,
        ),
        zero=replace(file.zero, current=file.zero.current * pretension / pulls),
        watch=replace(file.watch, gain=file.watch.gain * tilts, tilt=file.watch.tilt * tilts, tendon_angles=angles),
    )


def _newton_per_ampere(p: NeckParameters) -> float:
    return p.torque_constant * p.gear_ratio * p.gear_efficiency / p.winch_radius


def _tilt(parameters: NeckParameters) -> float:
    """Return how far the neck tilts when its tendons are moved as Eq. 9 and 10 have it, without payload [rad]."""
    angles = np.array([parameters.tendon_angle_1, parameters.tendon_angle_2, parameters.tendon_angle_3])
    P: Vector = _PULLED * 2.0 / 3.0 * np.cos(angles)
    out = settle(VirtualNeck(parameters.without_noise()).block(), P).outputs
    return math.hypot(float(out[0]), float(out[1]))
