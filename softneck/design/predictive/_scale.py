"""Robots of other units, sizes and speeds than the neck's, as plants of a neck's size.

The weights, tolerances and soft limits of predictive control are in rad of a neck. So another robot's motors are taken
in a unit in which they have a neck's range, its redefined inputs in one in which they pull as theta_i does, and each
output in one in which its static gain is a neck's: the QP is the same in all units of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, to_si
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.runtime._bundle import sized_name

from ..linear._ports import MAX_MOTOR, MAX_REFERENCE, ControllerLimits, limits_of
from ..plants._coupled import CoupledPlant
from ..plants._coupled_axis import CoupledAxis
from ..plants._uncertain import UncertainAxis, UncertainPlant
from . import _mpc_state_runtime as rt

if TYPE_CHECKING:
    import control


# The paper's static gain [rad/rad], 27.69 / 5.293 deg/rad (Eq. 31).
_NECK_GAIN = math.radians(27.69 / 5.293)
# Of theta_i = P_1 - P_2 / 2 - P_3 / 2 (Eq. 9).
_NECK_WEIGHT = math.sqrt(1.5)
# Motor that one radian of a neck takes up [rad/rad]: radius of the tendons' attachment over that of the winch,
# 52 mm / 7.5 mm (lab code; paper, section 3.1).
TAUTNESS_LEVER = 6.93
# Beyond all bounds.
_FREE = 1e12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scale:
    """Another robot's units and bounds.

    Attributes:
        motors: unit of the motors in SI.
        outputs: (outputs,) units of the outputs in SI.
        inputs: (outputs,) units of the redefined inputs in SI.
        bounds: lowest and highest set-points, and references, in these units.
    """

    motors: float
    outputs: Vector
    inputs: Vector
    bounds: Vector

    def numbers(self) -> tuple[float, ...]:
        """Return what the runtime reads behind its constants."""
        return (*self.bounds.tolist(), self.motors, *self.outputs.tolist(), *self.inputs.tolist())


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SizedPlant:
    """Another robot's plant in such units, or a coupled one; what a predictive design works on.

    Attributes:
        axes: output -> what its axis may be.
        robot: whose plant it is.
        redefinition: T (outputs + 1, motors) and its inverse.
        scale: the units; None for a neck's own.
    """

    axes: Mapping[str, UncertainAxis]
    robot: Robot
    redefinition: tuple[Matrix, Matrix]
    scale: Scale | None

    @property
    def uncertain(self) -> bool:
        """Whether there are samples beside the nominal plant."""
        return all(len(axis.samples) > 1 for axis in self.axes.values())

    def tf(self, output: str) -> control.TransferFunction:
        """Return the nominal plant of an axis."""
        return self.axes[output].nominal.tf()

    def samples(self, output: str) -> list[control.TransferFunction]:
        """Return the samples of an axis."""
        return [plant.tf() for plant in self.axes[output].samples]


def predictive_limits(settings: Any, robot: Robot) -> ControllerLimits:
    """Return the limits of a predictive controller: what the robot's file says, and the lead of its settings.

    Raises:
        SettingsError: one that the robot does not have, that its file does not give, or that contradicts another.
    """
    limits = limits_of(robot, lead_limit=settings.lead_limit, least_cocontraction=NeckDefault(-MAX_MOTOR))
    unit, angle = robot.motors.unit, settings.angle_limit
    if angle is not None:
        if robot.is_neck:
            require_between("angle_limit", angle, 0.01, MAX_REFERENCE, "rad")
        elif to_si(robot.outputs.unit)[1] != "rad":
            raise SettingsError(
                f"`angle_limit` is for outputs that are angles; those of {robot.label()} are in "
                f"{robot.outputs.unit}. Leave it out."
            )
    taut, most = settings.minimum_tautness, limits.position_limit / to_si(unit)[0]
    if taut is not None and not robot.is_neck and not isinstance(taut, NeckDefault):
        raise SettingsError(f"`minimum_tautness` is for necks; {robot.label()} is none. Leave it out.")
    if taut is not None and taut >= most:
        raise SettingsError(
            f"`minimum_tautness` {taut:g} {unit} and `position_limit` {most:g} {unit} contradict each other: no motor "
            "could pull that far. Lower the first."
        )
    return limits


def sized_plant(
    plant: UncertainPlant | CoupledPlant, limits: ControllerLimits, redefinition: tuple[Matrix, Matrix]
) -> SizedPlant:
    """Return another robot's plant as one of a neck's size; a coupled neck as it is."""
    if plant.robot.is_neck:
        return SizedPlant(axes=plant.axes, robot=plant.robot, redefinition=redefinition, scale=None)
    T, inverse = (part.copy() for part in redefinition)
    robot, m = plant.robot, len(plant.names)
    numbers = limits.constants(plant.sample_time)[1:]
    low, high = np.split(numbers[: 2 * T.shape[1]], 2)
    unit = float((high - low).max()) / (2.0 * rt.MPC_MOTOR_LIMIT)
    inputs = unit * np.linalg.norm(T[:m], axis=1) / _NECK_WEIGHT
    outputs = np.array([abs(axis.nominal.static_gain) for axis in plant.axes.values()]) * inputs / _NECK_GAIN
    T[:m] *= unit / inputs[:, None]
    inverse[:, :m] *= inputs / unit
    references = np.split(numbers[2 * T.shape[1] :], 2)
    bounds = np.concatenate([low / unit, high / unit, *(part / np.append(outputs, unit) for part in references)])
    axes = {
        name: UncertainAxis(_scaled(axis.nominal, i, gains), tuple(_scaled(item, i, gains) for item in axis.samples))
        for i, ((name, axis), gains) in enumerate(zip(plant.axes.items(), inputs / outputs[:, None], strict=True))
    }
    scale = Scale(motors=unit, outputs=outputs, inputs=inputs, bounds=bounds)
    return SizedPlant(axes=axes, robot=robot, redefinition=(T, inverse), scale=scale)


def _scaled(plant: Any, axis: int, gains: Vector) -> Any:
    """Return an axis with its gains from the redefined inputs of all axes times `gains`."""
    if isinstance(plant, CoupledAxis):
        return replace(plant, B=gains * plant.B)
    return replace(plant, numerator=float(gains[axis]) * plant.numerator)


def runtime_of(arrays: tuple[Matrix, ...]) -> str:
    """Return the runtime of a controller's arrays."""
    T = rt.MpcArrays(arrays).T
    return sized_name("softneck.design.predictive._mpc_runtime", T.shape[1], T.shape[0] - 1)


def units_of(arrays: tuple[Matrix, ...]) -> tuple[float, Vector, Vector]:
    """Return the units in SI of motors, outputs (outputs,) and redefined inputs (outputs,); ones for a neck."""
    a = rt.MpcArrays(arrays)
    m = a.T.shape[0] - 1
    if a.constants.size == rt.MPC_NUMBERS:
        return 1.0, np.ones(m), np.ones(m)
    return float(a.constants[-2 * m - 1]), a.constants[-2 * m : -m], a.constants[-m:]


def unbound(arrays: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
    """Return the arrays with all units one and no bounds: the controller in the units of its size."""
    a = rt.MpcArrays(arrays)
    if a.constants.size == rt.MPC_NUMBERS:
        return arrays
    m, motors = a.T.shape[0] - 1, a.T.shape[1]
    free = [*[-_FREE] * motors, *[_FREE] * motors, *[-_FREE] * (m + 1), *[_FREE] * (m + 1)]
    constants = np.concatenate([a.constants[: rt.MPC_NUMBERS], free, np.ones(2 * m + 1)])
    return tuple(constants if name == "constants" else item for name, item in zip(a.names(), arrays, strict=True))
