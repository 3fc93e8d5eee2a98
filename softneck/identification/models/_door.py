"""The door of identification: what an estimator learns from is scaled, and its model goes back to SI.

Set-points, motor positions and outputs are scaled and rounded first; directions and the time constant are learned from
these, in samples, so that neither unit nor pace changes a bit of them; then time is scaled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Scaling
from softneck.signals import Recording, scale_recording

from ._directions import NECK_SECONDS, Directions, directions_of
from ._drive import LoadedDrive, fit_loaded_drive
from ._fitting import fitted_model, in_display_unit
from ._model import Model

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Convert = Callable[[Mapping[str, Matrix], Scaling], dict[str, Matrix]]


@dataclass(frozen=True, slots=True, eq=False)
class Door:
    """A recording in SI, the same in scaled quantities, and the map between them.

    Attributes:
        recording: in SI.
        data: scaled; of a robot that rests at zero, without units.
        scaling: between them.
        directions: of `data`.
    """

    recording: Recording
    data: Recording
    scaling: Scaling
    directions: Directions

    @classmethod
    def of(cls, recording: Recording, *, amplitudes: bool = True, alike: bool = False) -> Door:
        """Scale a recording.

        Args:
            recording: to learn from.
            amplitudes: whether set-points and outputs are scaled too; else time alone, of equations in SI.
            alike: whether all outputs have one unit, as the motors do.

        Raises:
            DataError: an output follows no motor.
        """
        robot = recording.robot
        scaling = Scaling.of(robot, set_points=recording.set_points, outputs=recording.outputs)
        if not amplitudes:
            zero, one = np.zeros_like(scaling.motor_rest), np.ones_like(scaling.output_unit)
            scaling = replace(scaling, motor_unit=1.0, motor_rest=zero, output_unit=one, output_rest=0.0 * one)
        if alike:
            scaling = replace(scaling, output_unit=np.full_like(scaling.output_unit, scaling.output_unit.max()))
        plain = scale_recording(recording, replace(scaling, second=1.0))
        found = directions_of(plain, [run.set_points for run in plain.runs()], robot)
        scaling = replace(scaling, second=found.time_constant / NECK_SECONDS)
        return cls(recording, scale_recording(recording, scaling), scaling,
                   replace(found, seconds=found.seconds / scaling.second))  # fmt: skip

    @property
    def paced(self) -> bool:
        """Whether the robot gives its time constant, so that the paper's lags and training suit it."""
        return self.recording.robot.time_constant_s is not None

    @property
    def has_offset(self) -> bool:
        """Whether set-points or outputs at rest are not zero in SI."""
        return bool(self.scaling.motor_rest.any() or self.scaling.output_rest.any())

    @property
    def drive(self) -> LoadedDrive:
        """The motors' lag, and the limit that tendons share (`load` holds no rest of its own)."""
        tendons = self.recording.robot.tendon_angles is not None and not self.scaling.motor_rest.any()
        return fit_loaded_drive(self.data, limited=tendons)

    @property
    def gains(self) -> Vector:
        """(outputs,) what a scaled gain of each output over a motor is in SI."""
        return self.scaling.output_unit / self.scaling.motor_unit

    def seconds(self, asked: float | None, usual: float | None = None) -> float | None:
        """Return a setting [s] in scaled seconds, and what is usual where it is not given."""
        return usual if asked is None else self.scaling.scale_seconds(asked)

    def findings(self) -> dict[str, object]:
        """Return directions and time constants in SI where they were learned."""
        robot = self.recording.robot
        if robot.weights() is not None and robot.time_constant_s is not None:
            return {}
        return replace(self.directions, seconds=self.scaling.second * self.directions.seconds).findings()

    def shown(self, values: Matrix) -> Matrix:
        """Return scaled differences (.., outputs) of outputs in the unit in which people see them."""
        return in_display_unit(self.recording.robot, self.scaling.output_unit * values)

    def scaled(self, recording: Recording) -> Recording:
        """Return another recording of the robot in the same quantities."""
        return scale_recording(recording, self.scaling)

    def model(
        self, kind: str, settings: DataclassInstance, in_si: Convert, *, arrays: Mapping[str, Matrix],
        findings: Mapping[str, Any],
    ) -> Model:  # fmt: skip
        """Return the model in SI of what `settings` made of `data`.

        Args:
            kind: name in the table of kinds.
            settings: as asked for.
            in_si: converts the arrays of the kind.
            arrays: scaled.
            findings: in SI.
        """
        findings = {**findings, **self.findings()}
        arrays = arrays if self.scaling.is_identity else in_si(arrays, self.scaling)
        return fitted_model(kind, settings, self.recording, arrays=arrays, findings=findings)
