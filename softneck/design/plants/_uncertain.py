"""The uncertain plant of a design: a nominal plant and samples for each axis, and the step and load test on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    ReprMixin,
    SettingsError,
    SoftneckError,
    Vector,
    require_one_of,
    require_positive,
)
from softneck.estimation import AXES, AxisPlant, LinearNeck, axis_plant, directions_of, robot_of
from softneck.identification import Draws, remove_unreachable_states, to_state_space
from softneck.robot import TIME_CONSTANT, Robot
from softneck.signals import require_same_robot

if TYPE_CHECKING:
    import control

# Scaled [rad of theta_i].
_SCALED_LOAD = -0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class StepAndLoad:
    """A step and a load as test of a controller on every plant.

    Attributes:
        reference: the step at t = 0 [rad].
        position_limit: of `|u|` [rad].
        slew_limit: of u, per sample [rad].
        load: added to the plant's input [rad].
        load_at: from when on [s].
        duration: [s].
        sample_time: [s].
        size: what scales outputs: 10 deg over `reference`.
    """

    reference: float = math.radians(10.0)
    position_limit: float = 6.0
    slew_limit: float = 0.25
    load: float = _SCALED_LOAD
    load_at: float = 3.5
    duration: float = 6.0
    sample_time: float = 0.02
    size: float = 1.0

    def __post_init__(self) -> None:
        for name in ("reference", "position_limit", "slew_limit", "load_at", "sample_time"):
            require_positive(name, getattr(self, name))
        if not self.load_at < self.duration < math.inf:
            raise SettingsError(f"`duration` must be beyond `load_at` {self.load_at:g} s; got {self.duration:g} s.")

    @property
    def gain_unit(self) -> float:
        """A scaled gain of 1 from output to input; of the neck 1."""
        return self.size * self.load / _SCALED_LOAD

    @property
    def rows(self) -> int:
        """Samples of a run."""
        return round(self.duration / self.sample_time) + 1

    @property
    def load_row(self) -> int:
        """The first sample with the load."""
        return round(self.load_at / self.sample_time)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StepAndLoadResult:
    """The results of a step and a load on every plant.

    Attributes:
        settling: (plants,) time after which the angle stays within 5 % of the step, until the load [s]; inf if never.
        overshoot: (plants,) beyond the step, until the load [%].
        load_rms: (plants,) rms of the error from the load on [deg].
        angles: (plants, time) [rad].
        inputs: (plants, time) within their limits [rad].
        nominal: index of the nominal plant.
    """

    settling: Vector
    overshoot: Vector
    load_rms: Vector
    angles: Matrix
    inputs: Matrix
    nominal: int

    @property
    def row(self) -> dict[str, float]:
        """The three figures that controllers are compared by."""
        return {
            "nominal_settling_s": float(self.settling[self.nominal]),
            "worst_overshoot_pct": float(self.overshoot.max()),
            "worst_load_rms_deg": float(self.load_rms.max()),
        }


def judge(angles: Matrix, inputs: Matrix, test: StepAndLoad, nominal: int) -> StepAndLoadResult:
    """Return the figures of runs, `angles` and `inputs` (plants, time)."""
    before, after = angles[:, : test.load_row], angles[:, test.load_row :]
    # 1e-12: the border itself belongs to the band, whatever rounding says.
    outside = np.abs(before - test.reference) > (0.05 + 1e-12) * test.reference
    last = before.shape[1] - np.argmax(outside[:, ::-1], axis=1)
    settled = np.where(outside[:, -1], math.inf, last * test.sample_time)
    return StepAndLoadResult(
        settling=np.where(outside.any(axis=1), settled, 0.0),
        overshoot=100.0 * np.maximum(before.max(axis=1) / test.reference - 1.0, 0.0),
        load_rms=np.degrees(np.sqrt(np.mean((after - test.reference) ** 2, axis=1))),
        angles=angles,
        inputs=inputs,
        nominal=nominal,
    )


# Coefficients below this part of the largest are rounding of a characteristic polynomial.
_COEFFICIENT_TOLERANCE = 1e-11
_INPUTS = {"pitch": "theta_i", "roll": "phi_i"}


@dataclass(frozen=True, slots=True)
class ModelUncertainty:
    """Uncertainty that a design adds to the identified plants.

    Attributes:
        least_delay: the dead time is taken as at least this [s]; a fit of simulations hides it in the pole.
        small_move_pole: the plant is taken as well with its main pole as fast as this [1/s], at the same static gain;
            0 for the identified plant alone. Fits to large moves come out slower than small moves are, for there the
            drives run at their current limit.
        gain_spread: relative; a plant without samples of its own is taken at both ends of it as well.
    """

    least_delay: float
    small_move_pole: float
    gain_spread: float = 0.2


# The dead time and the pole of the paper's neck (Eq. 31: 0.08 s, 5.293 1/s), of a robot with tendons whose file gives
# its time constant in parts of that; nothing of the kind is known of others.
_LEAST_DELAY, _SMALL_MOVE_POLE = 0.08, 5.293
_NO_UNCERTAINTY = ModelUncertainty(0.0, 0.0)


def default_uncertainty(robot: Robot) -> ModelUncertainty:
    """Return the default uncertainty of a design."""
    if robot.time_constant_s is None or robot.tendon_angles is None:
        return _NO_UNCERTAINTY
    second = robot.time_constant_s / TIME_CONSTANT
    return ModelUncertainty(_LEAST_DELAY * second, _SMALL_MOVE_POLE / second)


@dataclass(frozen=True, slots=True, eq=False)
class UncertainAxis:
    """The uncertain plant of one axis.

    `nominal`: the plant that synthesis takes. `samples`: every plant that the controller must hold on; the nominal one
    is the first. `test`: what a controller is judged by on all of them; None where nobody judges. `uncertainty`: what
    is allowed for besides. `family`: how many plants were given, 1 for a model alone. `band`: lowest and highest
    frequency [rad/s] that their recordings support; None where it is not known. `followed`: whose response a feedback
    beside feedforward follows; None: that of the nominal one.
    """

    nominal: AxisPlant
    samples: tuple[AxisPlant, ...]
    test: StepAndLoad | None = None
    uncertainty: ModelUncertainty = _NO_UNCERTAINTY
    family: int = 1
    band: tuple[float, float] | None = None
    followed: AxisPlant | None = None

    @property
    def sample_time(self) -> float:
        """[s]."""
        return self.nominal.sample_time

    def same_as(self, other: UncertainAxis) -> bool:
        """Return whether both are the same plants, so that one synthesis does for both."""
        mine, its = ((item.followed or item.nominal, item.nominal, *item.samples) for item in (self, other))
        return len(mine) == len(its) and all(
            a.delay == b.delay
            and np.array_equal(a.numerator, b.numerator)
            and np.array_equal(a.denominator, b.denominator)
            for a, b in zip(mine, its, strict=True)
        )

    def apply_assumptions(self) -> UncertainAxis:
        """Return the axis with the minimum nominal dead time and the model of small moves as a sample."""
        nominal = self.nominal.with_min_delay(self.uncertainty.least_delay)
        pole = self.uncertainty.small_move_pole
        faster = nominal.with_faster_pole(pole) if pole > 0.0 else nominal
        more = () if faster is nominal else (faster,)
        return replace(self, nominal=nominal, samples=(nominal, *more, *self.samples[1:]))

    def spread_gain(self) -> UncertainAxis:
        """Return it with each plant at both ends of the gain's spread, unless it has samples of its own."""
        taken, gain = self.apply_assumptions(), self.uncertainty.gain_spread
        if len(self.samples) > 1 or gain == 0.0:
            return taken
        more = (scale_gain(plant, scale) for plant in taken.samples for scale in (1.0 - gain, 1.0 + gain))
        return replace(taken, samples=(*taken.samples, *more))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class UncertainPlant(ReprMixin):
    """The uncertain plant of all axes, on which every design works; of a neck pitch and roll.

    `axes`: output -> what its axis may be. `robot`: whose plant it is. `weights`: (outputs, motors) of the motors in
    the redefined input of each axis; None: those that the robot gives. `uncertainty`: what a design allows for; None
    for what is usual of the robot. `draws`: nonlinear models of the plant; None where there are none.
    """

    axes: Mapping[str, UncertainAxis]
    robot: Robot = field(default_factory=Robot.preset)
    weights: Matrix | None = None
    uncertainty: ModelUncertainty | None = None
    draws: Draws | None = None

    @property
    def sample_time(self) -> float:
        """[s]."""
        return next(iter(self.axes.values())).sample_time

    @property
    def names(self) -> tuple[str, ...]:
        """The outputs."""
        return tuple(self.axes)

    def axis(self, name: str) -> UncertainAxis:
        """Return the axis of an output."""
        require_one_of("axis", name, self.names)
        return replace(self.axes[name], uncertainty=self.uncertainty or default_uncertainty(self.robot))

    @property
    def redefinition(self) -> tuple[Matrix, Matrix]:
        """T from motors to the redefined inputs of all axes and co-contraction (Eq. 9-11), and its inverse."""
        return self.robot.redefinition(self.weights)

    def assumptions(self) -> dict[str, float]:
        """Return the dead time and the pole that a design assumes where the plant itself has less."""
        if self.uncertainty is not None:
            return {}
        found = {}
        for axis in map(self.axis, self.names):
            delay, pole, plant = axis.uncertainty.least_delay, axis.uncertainty.small_move_pole, axis.nominal
            if plant.with_min_delay(delay).delay > plant.delay:
                found["least_delay"] = delay
            if plant.with_faster_pole(pole) is not plant:
                found["small_move_pole"] = pole
        return dict(sorted(found.items()))

    def tf(self, output: str) -> control.TransferFunction:
        """Return the nominal plant of an axis, as a model's `tf`."""
        return self.axis(output).nominal.tf()

    def samples(self, output: str) -> list[control.TransferFunction]:
        """Return the samples of an axis, as a family's `samples`."""
        return [plant.tf() for plant in self.axis(output).samples]


def scale_gain(plant: AxisPlant, factor: float) -> AxisPlant:
    """Return the plant with its gain times `factor`."""
    return replace(plant, numerator=factor * plant.numerator)


def uncertain_plant(source: Any, robot: Robot | None = None) -> UncertainPlant:
    """Return the uncertain plant of a model, family, system or mapping.

    Args:
        source: a family, an identified linear model, a discrete `control.StateSpace` or `TransferFunction`, a list
            of those (the first is nominal), or a mapping of "pitch" and "roll" to such systems or lists. A
            scalar system without names stands for both axes; one of two outputs is read by its signal names
            (theta_i, phi_i to pitch, roll), or in that order where it has none.
        robot: whose limits and sensor count instead of those that the plant says.

    Raises:
        SettingsError: not linear, discrete or stable; different sample times; names that do not match.
        DataError: a plant that is zero, not strictly proper or not finite, or of the other sign; or another's robot.
    """
    import control

    if robot is not None:
        found = uncertain_plant(source)
        require_same_robot(found.robot, robot, "the plant and `robot`")
        return replace(found, robot=robot)
    if isinstance(source, UncertainPlant):
        return source
    if isinstance(source, Mapping):
        return _of_mapping(source)
    if isinstance(source, Sequence) and not isinstance(source, str):
        if not source:
            raise DataError("the list of samples is empty; the first is the nominal plant.")
        each = [uncertain_plant(item) for item in source]
        for item in each[1:]:
            require_same_robot(item.robot, each[0].robot, "plants")
        joined = {axis: [s for item in each for s in item.axis(axis).samples] for axis in each[0].names}
        return replace(_combine_axes(joined), robot=each[0].robot, weights=each[0].weights, draws=each[0].draws)
    if isinstance(source, control.StateSpace | control.TransferFunction):
        return _combine_axes({axis: [_axis_from_system(_of_system(source, axis), axis, "the plant")] for axis in AXES})
    if not hasattr(source, "tf"):
        raise SettingsError(
            f"a linear model is needed, one with `tf`; got {type(source).__name__}. "
            "Identify `rls`, or give a discrete control.TransferFunction."
        )
    robot = robot_of(source)
    joined = _combine_axes({axis: _of_model(source, axis) for axis in robot.outputs.names})
    if callable(band := getattr(source, "band", None)):
        joined = replace(joined, axes={axis: replace(item, band=band(axis)) for axis, item in joined.axes.items()})
    return replace(joined, robot=robot, weights=directions_of(source), draws=getattr(source, "draws", None))


def _of_model(model: Any, axis: str) -> list[AxisPlant]:
    nominal = axis_plant(model, axis)
    samples = model.samples(axis) if callable(getattr(model, "samples", None)) else []
    plants = (_axis_from_system(item, axis, f"sample {i} of the family") for i, item in enumerate(samples))
    return [nominal, *(replace(plant, second=nominal.second) for plant in plants)]


def _of_mapping(source: Mapping[str, Any]) -> UncertainPlant:
    if set(source) != set(AXES):
        got = ", ".join(str(name) for name in source) or "nothing"
        raise SettingsError(f"the plant must have the axes pitch and roll; got {got}.")
    axes: dict[str, list[AxisPlant]] = {}
    for axis in AXES:
        value = source[axis]
        items = list(value) if isinstance(value, Sequence) else [value]
        if not items:
            raise DataError(f"{axis} has no samples; the first is the nominal plant.")
        axes[axis] = [
            item
            if isinstance(item, AxisPlant)
            else _axis_from_system(_scalar(item, axis), axis, f"sample {i} of {axis}")
            for i, item in enumerate(items)
        ]
    return _combine_axes(axes)


def _combine_axes(axes: Mapping[str, list[AxisPlant]]) -> UncertainPlant:
    times = {axis: plants[0].sample_time for axis, plants in axes.items()}
    if max(times.values()) - min(times.values()) > 1e-9 * max(times.values()):
        raise SettingsError(
            f"{' and '.join(times)} have different sample times, "
            f"{' and '.join(f'{time:g} s' for time in times.values())}; resample one."
        )
    for axis, plants in axes.items():
        for i, plant in enumerate(plants):
            if not math.isclose(plant.sample_time, times[axis], rel_tol=1e-9):
                raise SettingsError(
                    f"sample {i} of {axis} has a sample time of {plant.sample_time:g} s, the nominal plant "
                    f"{times[axis]:g} s; identify or resample it at {times[axis]:g} s."
                )
            if plant.static_gain * plants[0].static_gain <= 0.0:
                raise DataError(
                    f"sample {i} of {axis} has a static gain of {plant.static_gain:.4g} rad/rad, the nominal plant "
                    f"{plants[0].static_gain:.4g}: no controller with integral action holds both signs. "
                    "Leave that sample out, or check the signs of its recording."
                )
    return UncertainPlant(
        {axis: UncertainAxis(plants[0], tuple(plants), family=len(plants)) for axis, plants in axes.items()}
    )


def _axis_from_system(system: Any, axis: str, what: str) -> AxisPlant:
    import control

    tf: Any = _polynomials(system) if isinstance(system, control.StateSpace) else system
    neck = LinearNeck(pitch=tf, roll=tf)
    try:
        # It knows the outputs of a neck alone, of which any stands for another robot's.
        return axis_plant(neck, axis if axis in AXES else AXES[0])
    except SoftneckError as error:
        raise type(error)(f"{what}: {error}") from error


def _polynomials(system: Any) -> control.TransferFunction:
    """Return the transfer function of a state space, without the other axis and rounding errors of its dead time."""
    import control
    from scipy.signal import ss2tf

    found: Any = ss2tf(*remove_unreachable_states(system.A, system.B, system.C), system.D)
    num, den = found[0][0], found[1]
    for part in (num, den):
        part[np.abs(part) < _COEFFICIENT_TOLERANCE * np.abs(part).max(initial=0.0)] = 0.0
    return control.TransferFunction(num, den, system.dt)


def _scalar(system: Any, axis: str) -> Any:
    """Return `system`, which must be scalar and, where it has names, that of `axis`."""
    import control

    if not isinstance(system, control.StateSpace | control.TransferFunction):
        raise SettingsError(
            f"{axis} must be a discrete control.StateSpace or TransferFunction; got {type(system).__name__}."
        )
    if system.ninputs != 1 or system.noutputs != 1:
        raise SettingsError(f"{axis} must have one input and one output; got {system.ninputs} and {system.noutputs}.")
    names = ((system.input_labels[0], _INPUTS[axis]), (system.output_labels[0], axis))
    for label, wanted in names:
        if label in (*_INPUTS, *_INPUTS.values()) and label != wanted:
            raise SettingsError(
                f"a signal of {axis} is named {label}; it must be {wanted}. Rename it or swap the axes."
            )
    return system


def _of_system(system: Any, axis: str) -> Any:
    """Return the part of `system` from the axis' redefined input to its angle."""
    if system.ninputs == 1 and system.noutputs == 1:
        label = system.output_labels[0]
        if label in AXES:
            raise SettingsError(f"the system is that of {label} alone; give both, as {{'pitch': ..., 'roll': ...}}.")
        return system
    inputs, outputs = list(system.input_labels), list(system.output_labels)
    if len(inputs) == len(outputs) == 2 and all(name.startswith(("u[", "y[")) for name in (*inputs, *outputs)):
        i = AXES.index(axis)
        return system[i, i]
    if _INPUTS[axis] not in inputs or axis not in outputs:
        raise SettingsError(
            f"the system's signals are {', '.join(inputs)} to {', '.join(outputs)}; a design needs theta_i, phi_i to "
            "pitch, roll. Rename them with `system.update_names(inputs=..., outputs=...)`; `lqg`, `mpc` and "
            "`custom` take systems of any size."
        )
    return system[outputs.index(axis), inputs.index(_INPUTS[axis])]


# Of the paper's loop [s].
DEFAULT_SAMPLE_TIME_S = 0.02


def discretize_zoh(plant: Any, period: float) -> tuple[float | None, Any]:
    """Return the plant with each continuous `control` system of it made discrete by a zero-order hold, and its period.

    At the samples both agree, as set-points are held in between. A plant that is discrete stays as it is, with None.
    Raises SettingsError: a system that has no state space.
    """
    return (period, _discretize(plant, period)) if _any_continuous(plant) else (None, plant)


def sampling_line(design: Mapping[str, Any]) -> list[str]:
    """Return a line on a continuous plant, none for another."""
    # Files before 0.3 have it among the settings.
    period = design.get("held_s", design.get("settings", {}).get("sample_time"))
    return [] if period is None else [f"  the plant is continuous, its inputs held for {1e3 * period:g} ms (exact)"]


def _any_continuous(plant: Any) -> bool:
    if isinstance(plant, Mapping | list | tuple):
        return any(_any_continuous(item) for item in (plant.values() if isinstance(plant, Mapping) else plant))
    return _is_continuous(plant)


def _is_continuous(plant: Any) -> bool:
    import control

    return isinstance(plant, control.StateSpace | control.TransferFunction) and control.isctime(plant, strict=True)


def _discretize(plant: Any, period: float) -> Any:
    if isinstance(plant, Mapping):
        return {name: _discretize(item, period) for name, item in plant.items()}
    if isinstance(plant, Sequence):
        return [_discretize(item, period) for item in plant]
    if not _is_continuous(plant):
        return plant
    system = to_state_space(plant)
    if not all(np.isfinite(part).all() for part in (system.A, system.B, system.C, system.D)):
        raise SettingsError("the plant has entries that are not finite.")
    return system.sample(period, method="zoh")
