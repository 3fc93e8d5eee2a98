"""A robot's plant in scaled quantities (`softneck.robot._scaling`), and the limits of its predictive controller."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, to_si
from softneck.estimation import plants_scaling
from softneck.robot import MOTOR_RANGE, OUTPUT_RANGE, Robot, Scaling
from softneck.runtime import sized_name

from ..linear._ports import ControllerLimits, limits_of, motor_ranges, reference_ranges
from ..plants._coupled import CoupledPlant
from ..plants._coupled_axis import AnyAxes, AnyAxis, CoupledAxis
from ..plants._uncertain import Doubts, UncertainPlant, doubts_of
from . import _mpc_state_runtime as rt

# Motor that one scaled output takes up: radius of the tendons' attachment over that of the winch, 52 mm / 7.5 mm (lab
# code; paper, section 3.1).
TAUTNESS_LEVER = 6.93
# How far a set-point may be from its motor: more than the drives of the neck fall behind at the paper's fastest
# signals, 0.4 rad; and what the slew makes in so many scaled seconds.
_LEAD, _LEADING = 1.0, 0.08
# Beyond all bounds.
_FREE = 1e12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScaledPlant:
    """What a predictive design works on.

    Attributes:
        axes: a nominal plant of each output, in scaled quantities and seconds.
        samples: what else each of them may be.
        robot: whose plant it is.
        redefinition: T (outputs + 1, motors) to scaled redefined inputs, and its inverse.
        scaling: of the robot.
        inputs: (outputs,) units of the redefined inputs in SI.
        doubts: what a design allows for besides.
        identified: whether recordings told the plant.
        sample_time: [s].
    """

    axes: AnyAxes
    samples: tuple[AnyAxes, ...]
    robot: Robot
    redefinition: tuple[Matrix, Matrix]
    scaling: Scaling
    inputs: Vector
    doubts: Doubts
    identified: bool
    sample_time: float

    @property
    def has_tendons(self) -> bool:
        """Whether tendons are to be kept taut, and co-contraction pulls them."""
        return self.robot.tendon_angles is not None and bool(self.redefinition[1][:, -1].any())


def scaled_plant(plant: UncertainPlant | CoupledPlant, *, identified: bool = False) -> ScaledPlant:
    """Return a plant in scaled quantities.

    Raises:
        SettingsError: the robot does not say where its set-points end.
    """
    robot, axes = plant.robot, list(plant.axes.values())
    (T, inverse), m = (part.copy() for part in plant.redefinition), len(axes)
    scaling = plants_scaling(robot, [axis.nominal for axis in axes], T[:m], "a controller")
    inputs = scaling.input_units(T[:m])
    T[:m] *= scaling.motor_unit / inputs[:, None]
    inverse[:, :m] *= inputs / scaling.motor_unit
    gains = inputs / scaling.output_unit[:, None]

    def scaled(item: Any, axis: int) -> AnyAxis:
        seconds = item.sample_time / scaling.second
        if isinstance(item, CoupledAxis):
            return replace(item, B=gains[axis] * item.B, sample_time=seconds)
        return replace(item, numerator=float(gains[axis, axis]) * item.numerator, sample_time=seconds)

    return ScaledPlant(
        axes=tuple(scaled(axis.nominal, i) for i, axis in enumerate(axes)),
        samples=tuple(tuple(scaled(item, i) for item in axis.samples[1:]) for i, axis in enumerate(axes)),
        robot=robot,
        redefinition=(T, inverse),
        scaling=scaling,
        inputs=inputs,
        doubts=getattr(plant, "doubts", None) or doubts_of(robot),
        identified=identified,
        sample_time=plant.sample_time,
    )


def predictive_limits(settings: Any, plant: ScaledPlant) -> ControllerLimits:
    """Return the limits of a predictive controller: what the robot's file says, and the lead of its settings.

    Raises:
        SettingsError: one that the robot does not have, that its file does not give, or that contradicts another.
    """
    robot, scaling = plant.robot, plant.scaling
    (factor, _), unit, lead = to_si(robot.motors.unit), robot.motors.unit, settings.lead_limit
    limits = limits_of(robot, lead_limit=lead or 1.0, least_cocontraction=None)
    if lead is None:
        slew = limits.slew_limit * scaling.second / scaling.motor_unit
        limits = replace(limits, lead_limit=max(_LEAD, _LEADING * slew) * scaling.motor_unit)
    if settings.angle_limit is not None:
        if to_si(robot.outputs.unit)[1] != "rad":
            raise SettingsError(
                f"`angle_limit` is for outputs that are angles; those of {robot.label()} are in "
                f"{robot.outputs.unit}. Leave it out."
            )
        least, most = 0.01 * float(scaling.output_unit.min()), float(reference_ranges(robot)[1].max())
        require_between("angle_limit", settings.angle_limit, least, most, "rad")
    taut, most = settings.minimum_tautness, limits.position_limit / factor
    if isinstance(taut, str) or taut is None:
        return limits
    if not plant.has_tendons:
        raise SettingsError(
            f"`minimum_tautness` is for tendons at known angles; {robot.label()} has none that co-contraction pulls. "
            "Leave it out."
        )
    if taut >= most:
        raise SettingsError(
            f"`minimum_tautness` {taut:g} {unit} and `position_limit` {most:g} {unit} contradict each other: no motor "
            "could pull that far. Lower the first."
        )
    return limits


def scale_numbers(plant: ScaledPlant, limits: ControllerLimits) -> tuple[float, ...]:
    """Return the scaled bounds and units that follow the runtime's constants; none where they equal its own."""
    robot, unit, outputs = plant.robot, plant.scaling.motor_unit, plant.scaling.output_unit
    ranges: Any = motor_ranges(robot, limits.position_limit)
    motors, (low, high) = np.array(ranges) / unit, np.array(reference_ranges(robot)) / outputs
    own = [MOTOR_RANGE] * motors.shape[1], [OUTPUT_RANGE] * len(outputs)
    found = [*motors.ravel(), *low, motors[0].min(), *high, motors[1].max(), unit, *outputs, *plant.inputs]
    usual = [*(-np.array(own[0])), *own[0], *(-np.array(own[1])), -MOTOR_RANGE, *own[1], MOTOR_RANGE,
             *[1.0] * (2 * len(outputs) + 1)]  # fmt: skip
    return () if found == usual else tuple(map(float, found))


def runtime_of(arrays: tuple[Matrix, ...]) -> str:
    """Return the runtime of a controller's arrays."""
    T = rt.MpcArrays(arrays).T
    return sized_name("softneck.design.predictive._mpc_runtime", T.shape[1], T.shape[0] - 1)


def units_of(arrays: tuple[Matrix, ...]) -> tuple[float, Vector, Vector]:
    """Return the units in SI of motors, outputs (outputs,) and redefined inputs (outputs,)."""
    a = rt.MpcArrays(arrays)
    m = a.T.shape[0] - 1
    if a.constants.size == rt.MPC_NUMBERS:
        return 1.0, np.ones(m), np.ones(m)
    return float(a.constants[-2 * m - 1]), a.constants[-2 * m : -m], a.constants[-m:]


def unbound(arrays: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
    """Return the arrays with all units one and no bounds: the controller in scaled quantities."""
    a = rt.MpcArrays(arrays)
    if a.constants.size == rt.MPC_NUMBERS:
        return arrays
    m, motors = a.T.shape[0] - 1, a.T.shape[1]
    free = [*[-_FREE] * motors, *[_FREE] * motors, *[-_FREE] * (m + 1), *[_FREE] * (m + 1)]
    constants = np.concatenate([a.constants[: rt.MPC_NUMBERS], free, np.ones(2 * m + 1)])
    return tuple(constants if name == "constants" else item for name, item in zip(a.names(), arrays, strict=True))
