"""Linear models of robots other than the neck: around the mean of their data, which need not be zero at rest."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording

from ..models._model import WARM_UP, Model
from ..models._state_space import system_of

Point = tuple[Vector, Vector]


def operating_point(recording: Recording) -> Point:
    """Return the means (motors,) of the set-points and (outputs,) of the outputs; zero of a neck, which rests there."""
    motors, outputs = recording.set_points.mean(axis=0), np.nanmean(recording.outputs, axis=0)
    return (0.0 * motors, 0.0 * outputs) if recording.robot.is_neck else (motors, outputs)


def about(recording: Recording, point: Point) -> Recording:
    """Return the recording with set-points, motor positions and outputs counted from `point`; a neck's as it is."""
    if recording.robot.is_neck:
        return recording
    robot = recording.robot
    zero = dict(zip(robot.set_points, point[0], strict=True)) | dict(zip(robot.outputs.names, point[1], strict=True))
    zero |= dict(zip(robot.motor_positions, point[0], strict=True))
    moved = {name: recording.channels[name] - level for name, level in zero.items() if name in recording.channels}
    return recording.with_channels(**moved)


def with_offset(kind: str, arrays: Mapping[str, Matrix], recording: Recording, point: Point) -> dict[str, Matrix]:
    """Return the arrays of a state space identified about `point` with its offset; a neck's as they are.

    The offset follows from the static gain; what the free run is off on the mean is put right beside it.
    """
    if recording.robot.is_neck:
        return dict(arrays)
    A, B, C, _ = system_of(arrays)
    gain = C @ np.linalg.pinv(np.eye(len(A)) - A) @ B
    offset = point[1] - gain @ point[0]
    for _ in range(2):  # the start of the free run depends on the offset a little
        model = Model(kind=kind, sample_time=recording.sample_time, arrays={**arrays, "offset": offset},
                      robot=recording.robot)  # fmt: skip
        free = model.simulate(recording)[:, : offset.size]
        late = np.concatenate([np.arange(len(run)) for run in recording.runs()]) >= WARM_UP
        error = (recording.outputs - free)[late]
        offset = offset + (np.nanmean(error, axis=0) if np.isfinite(error).any(axis=0).all() else 0.0)
    return {**arrays, "offset": offset}
