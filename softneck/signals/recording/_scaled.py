"""A recording in scaled quantities, as estimators see it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softneck.robot import Scaling, round_scaled, scaled_robot

from ._recording import Recording

# Channels without a unit of the robot's: they are the same in scaled quantities.
_KEPT = ("payload", "compression", "healthy", "enabled", "measurement_valid")


def scaled_recording(recording: Recording, scaling: Scaling) -> Recording:
    """Return set-points, motor positions and outputs scaled and rounded, of a robot without units; loads stay.

    Where the maps are the identity, the recording itself.
    """
    if scaling.is_identity:
        return recording
    robot = recording.robot
    channels = {name: values for name, values in recording.channels.items() if name in _KEPT}
    for names, scale in (
        (robot.set_points, scaling.scale_motors),
        (robot.motor_positions, scaling.scale_motors),
        (robot.outputs.names, scaling.scale_outputs),
    ):
        if all(name in recording.channels for name in names):
            values = round_scaled(scale(np.column_stack([recording.channels[name] for name in names])))
            channels |= dict(zip(names, values.T, strict=True))
    return replace(
        recording,
        time=recording.time / scaling.second,
        sample_time=recording.sample_time / scaling.second,
        channels=channels,
        robot=scaled_robot(robot, scaling),
    )
