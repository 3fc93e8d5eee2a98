"""The plant that a predictive controller predicts, in scaled quantities, and the limits of its set-points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, to_si
from softneck.estimation import plants_scaling, slowest_seconds
from softneck.identification import Model, weights_of
from softneck.robot import MOTOR_RANGE, OUTPUT_RANGE, Robot, Scaling
from softneck.runtime import sized_name

from ..linear._ports import ControllerLimits, limits_of, motor_ranges, reference_ranges
from ..plants._coupled import AnyAxes, AnyAxis, CoupledAxis, CoupledPlant, scale_gains
from ..plants._uncertain import ModelUncertainty, UncertainPlant, default_uncertainty
from . import _mpc_state_runtime as rt

# Motor that one scaled output takes up: radius of the tendons' attachment over that of the winch, 52 mm / 7.5 mm (lab
# code; paper, section 3.1).
TAUTNESS_LEVER = 6.93
# How far a set-point may be from its motor: more than the drives of the neck fall behind at the paper's fastest
# signals, 0.4 rad; and what the slew makes in so many scaled seconds.
_MIN_LEAD, _LEAD_TIME_S = 1.0, 0.08
# Beyond all bounds.
_NO_LIMIT = 1e12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScaledPlant:
    """The scaled plant of a predictive design.

    Attributes:
        axes: a nominal plant of each output, in scaled quantities and seconds.
        samples: what else each of them may be.
        robot: whose plant it is.
        redefinition: T (outputs + 1, motors) to scaled redefined inputs, and its inverse.
        scaling: of the robot.
        inputs: (outputs,) units of the redefined inputs in SI.
        uncertainty: what a design allows for besides.
        identified: whether recordings told the plant.
        sample_time: [s].
    """

    axes: AnyAxes
    samples: tuple[AnyAxes, ...]
    robot: Robot
    redefinition: tuple[Matrix, Matrix]
    scaling: Scaling
    inputs: Vector
    uncertainty: ModelUncertainty
    identified: bool
    sample_time: float

    @property
    def has_tendons(self) -> bool:
        """Whether tendons are to be kept taut, and co-contraction pulls them."""
        return self.robot.tendon_angles is not None and bool(self.redefinition[1][:, -1].any())


def scaled_plant(plant: UncertainPlant | CoupledPlant, *, identified: bool = False) -> ScaledPlant:
    """Return a plant in scaled quantities. Raises SettingsError: the robot does not say where its set-points end."""
    robot, axes = plant.robot, list(plant.axes.values())
    (T, inverse), m = (part.copy() for part in plant.redefinition), len(axes)
    scaling = plants_scaling(robot, [axis.nominal for axis in axes], T[:m], "a controller")
    inputs = scaling.input_units(T[:m])
    T[:m] *= scaling.motor_unit / inputs[:, None]
    inverse[:, :m] *= inputs / scaling.motor_unit
    gains = inputs / scaling.output_unit[:, None]

    def to_scaled(item: Any, axis: int) -> AnyAxis:
        seconds = item.sample_time / scaling.second
        if isinstance(item, CoupledAxis):
            return replace(item, B=gains[axis] * item.B, sample_time=seconds)
        return replace(item, numerator=float(gains[axis, axis]) * item.numerator, sample_time=seconds)

    return ScaledPlant(
        axes=tuple(to_scaled(axis.nominal, i) for i, axis in enumerate(axes)),
        samples=tuple(tuple(to_scaled(item, i) for item in axis.samples[1:]) for i, axis in enumerate(axes)),
        robot=robot,
        redefinition=(T, inverse),
        scaling=scaling,
        inputs=inputs,
        uncertainty=getattr(plant, "doubts", None) or default_uncertainty(robot),
        identified=identified,
        sample_time=plant.sample_time,
    )


def predictive_limits(settings: Any, plant: ScaledPlant) -> ControllerLimits:
    """Return the limits of a predictive controller: the robot's, and the lead of its settings.

    Raises SettingsError: one that the robot does not have, that its file does not give, or that contradicts another.
    """
    robot, scaling = plant.robot, plant.scaling
    (factor, _), unit, lead = to_si(robot.motors.unit), robot.motors.unit, settings.lead_limit
    limits = limits_of(robot, lead_limit=lead or 1.0, least_cocontraction=None)
    if lead is None:
        slew = limits.slew_limit * scaling.second / scaling.motor_unit
        limits = replace(limits, lead_limit=max(_MIN_LEAD, _LEAD_TIME_S * slew) * scaling.motor_unit)
    if settings.angle_limit is not None:
        if to_si(robot.outputs.unit)[1] != "rad":
            raise SettingsError(
                f"`angle_limit` is for outputs that are angles; those of {robot.label()} are in "
                f"{robot.outputs.unit}. Leave it out."
            )
        least, most = 0.01 * float(scaling.output_unit.min()), float(reference_ranges(robot)[1].max())
        require_between("angle_limit", settings.angle_limit, least, most, "rad")
    taut, most = settings.minimum_tautness, limits.position_limit
    if isinstance(taut, str) or taut is None:
        return limits
    if not plant.has_tendons:
        raise SettingsError(
            f"`minimum_tautness` is for tendons at known angles; {robot.label()} has none that co-contraction pulls. "
            "Leave it out."
        )
    if taut >= most:
        raise SettingsError(
            f"`minimum_tautness` {taut / factor:g} {unit} and `position_limit` {most / factor:g} {unit} contradict "
            "each other: no motor could pull that far. Lower the first."
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


def remove_limits(arrays: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
    """Return the arrays with all units one and no bounds: the controller in scaled quantities."""
    a = rt.MpcArrays(arrays)
    if a.constants.size == rt.MPC_NUMBERS:
        return arrays
    m, motors = a.T.shape[0] - 1, a.T.shape[1]
    free = [*[-_NO_LIMIT] * motors, *[_NO_LIMIT] * motors, *[-_NO_LIMIT] * (m + 1), *[_NO_LIMIT] * (m + 1)]
    constants = np.concatenate([a.constants[: rt.MPC_NUMBERS], free, np.ones(2 * m + 1)])
    return tuple(constants if name == "constants" else item for name, item in zip(a.names(), arrays, strict=True))


# That many samples of a family judge robustness; they are spread evenly over all.
_JUDGED_SAMPLES = 12
# A fit of simulations hides more of the dead time than a plant of one's own has: by so much.
HIDDEN_DELAY_FACTOR = 1.25

# Small moves that tell whether tendons hang, of a scaled redefined input, and the scaled seconds that a model settles.
_PROBE_MOVE, _SETTLE_S = 0.3, 3.0
# Tendons are taut where such a move does this part of the most that it does anywhere.
_TAUT_GAIN_RATIO = 0.9
# Scaled co-contractions that are tried, from rest on.
_COCONTRACTION_STEP, _MAX_COCONTRACTION = 0.25, 4.0

# Part of `least_delay` that is a sensor's at most.
_SENSOR_DELAY_RATIO = 0.5

S = TypeVar("S", bound=Any)


def samples_ahead(look_ahead: float, sample_time: float) -> int:
    """Return the whole samples of a look-ahead [s]: dead time counted too long costs speed, too short stability."""
    return math.floor(look_ahead / sample_time + 1e-9)  # of rounding


def predicted_plants(settings: Any, plant: ScaledPlant) -> AnyAxes:
    """Return the plant of each output that is predicted, with settings in scaled seconds."""
    return tuple(_predicted_plant(settings, plant, axis) for axis in range(len(plant.axes)))


def list_assumptions(settings: Any, asked: Any, plant: ScaledPlant) -> dict[str, float]:
    """Return the assumed dead time and pole that change the plant, where the settings do not give their own."""
    found: dict[str, float] = {}
    for name in ("least_delay", "small_move_pole", "taut_pole"):
        value, second = float(getattr(settings, name)), plant.scaling.second
        if getattr(asked, name) is not None or value == 0.0:
            continue
        if name == "least_delay":
            changes = any(axis.with_min_delay(value / second).delay > axis.delay for axis in plant.axes)
        else:
            changes = any(axis.with_faster_pole(value * second) is not axis for axis in plant.axes)
        found |= {name: value} if changes else {}
    return found


def families(nominal: AnyAxes, small_move_pole: float) -> list[AnyAxes]:
    """Return the plants of the robot: as identified, and faster."""
    if small_move_pole == 0.0:
        return [nominal]
    fast = tuple(plant.with_faster_pole(small_move_pole) for plant in nominal)
    return [nominal] if fast == nominal else [nominal, fast]


def _predicted_plant(settings: Any, whole: ScaledPlant, axis: int) -> AnyAxis:
    plant = set_dead_time(whole.axes[axis], settings)
    if settings.taut_pole == 0.0 or isinstance(plant, CoupledAxis):
        return plant
    # Recordings in which tendons hang say less than a taut neck does, none says more.
    ratios = [abs(sample.static_gain / plant.static_gain) for sample in whole.samples[axis]]
    (taut,) = scale_gains((plant.with_faster_pole(settings.taut_pole),), max([1.0, *ratios]))
    return taut


def set_dead_time(plant: AnyAxis, timing: Any) -> Any:
    """Return a plant with the dead time after the observer's look-ahead, and a minimum."""
    late = plant.with_min_delay(timing.least_delay)
    return replace(late, delay=max(0, late.delay - samples_ahead(timing.look_ahead, plant.sample_time)))


def sample_pairs(plant: ScaledPlant, timing: Any) -> list[AnyAxes]:
    """Return samples of a family, axes joined by the order of their static gains; none for a single model."""
    axes = [
        sorted((set_dead_time(item, timing) for item in each), key=lambda item: item.static_gain)
        for each in plant.samples
    ]
    count = min(_JUDGED_SAMPLES, *(len(plants) for plants in axes))
    picks = [np.linspace(0, len(plants) - 1, count).round().astype(int) for plants in axes]
    return [tuple(plants[i] for plants, i in zip(axes, chosen, strict=True)) for chosen in zip(*picks, strict=True)]


def over(settings: S, observer: Any) -> S:
    """Return settings for a loop with this observer; given values stay.

    `settings`: of `mpc` or `nmpc`. `observer`: whose `lead` becomes `look_ahead`, of `mpc` at most half of
    `least_delay`; if it tells a payload, its model says `payload_tautness`. Raises SettingsError: what is no observer.
    """
    if not hasattr(observer, "lead"):
        raise SettingsError(f"an observer is needed, of `softneck observer`; got {type(observer).__name__}.")
    found: dict[str, float] = {}
    if settings.look_ahead is None:
        # What `least_delay` adds stands for a dead time that recordings hide, and no sensor is later for that.
        least = getattr(settings, "least_delay", 0.0)
        least = HIDDEN_DELAY_FACTOR * default_uncertainty(observer.robot).least_delay if least is None else least
        found["look_ahead"] = min(observer.lead, _SENSOR_DELAY_RATIO * least or math.inf)
    told, wished = getattr(observer, "payloads", None), settings.minimum_tautness is not None
    asks = getattr(settings, "payload_tautness", 0.0) is None
    if asks and wished and told is not None and told[1] > 0.0 and observer.robot.tendon_angles is not None:
        # On top of `minimum_tautness`: what is in reserve without payload is there with it.
        found["payload_tautness"] = least_taut_cocontraction(observer.model, told[1]) / told[1]
    return replace(settings, **found)


def least_taut_cocontraction(model: Model, payload: float) -> float:
    """Return the smallest co-contraction [SI] above rest at which small moves act fully under a payload."""
    tried = np.arange(0.0, _MAX_COCONTRACTION + _COCONTRACTION_STEP / 2, _COCONTRACTION_STEP)
    gains = np.array([_mean_gain(model, payload, common) for common in tried])
    return float(tried[np.argmax(gains >= _TAUT_GAIN_RATIO * gains.max())]) * _scaling(model).motor_unit


def _scaling(model: Model) -> Scaling:
    motors = model.robot.motors
    ends = None
    if motors.setpoint_min is not None and motors.setpoint_max is not None:
        ends = to_si(motors.unit)[0] * np.array([motors.setpoint_min, motors.setpoint_max])
    return Scaling.of(model.robot, set_points=ends, time_constant=slowest_seconds(model))


def _mean_gain(model: Model, payload: float, common: float) -> float:
    """Return the mean static gain of small moves to both sides of a scaled co-contraction, of all axes."""
    block, weights, scaling = model.block(), weights_of(model), _scaling(model)
    inverse = model.robot.redefinition(weights)[1]
    moves = _PROBE_MOVE * scaling.input_units(weights)
    rows, motors, found = round(_SETTLE_S * scaling.second / model.sample_time), inverse.shape[0], []
    for axis in range(len(model.robot.outputs.names)):
        inputs = np.full((3 * rows, len(block.inputs)), np.nan)
        for part, side in enumerate((0.0, 1.0, -1.0)):
            inputs[part * rows : (part + 1) * rows, :motors] = (
                scaling.unscale_motors(np.full(motors, common)) + side * moves[axis] * inverse[:, axis]
            )
        _, outputs = block.run(block.initial_state(use_measurement=0.0, payload=payload), inputs)
        found.append(abs(outputs[2 * rows - 1, axis] - outputs[-1, axis]) / (2.0 * moves[axis]))
    return float(np.mean(found))
