"""Nonlinear model predictive control: what is asked, the controller that does it, and what its samples decided."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    FileFormatError,
    Matrix,
    SettingsError,
    Vector,
    require_between,
    require_whole,
    to_si,
    write_archive,
)
from softneck.core._shown import Shown
from softneck.estimation import AxisPlant
from softneck.identification import Model
from softneck.identification.models._arrays import without_validity
from softneck.identification.models._linear_systems import weights_of
from softneck.identification.models._model import nested, nested_model
from softneck.loop import BlockPart
from softneck.robot import Robot
from softneck.robot._neck_default import NeckCount, NeckDefault
from softneck.robot._redefined import redefinition_of
from softneck.runtime import Block, Port, State
from softneck.runtime._bundle import sized_name
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..linear._ports import LIMITS, MAX_MOTOR, ControllerLimits, controller_inputs, controller_outputs
from ..plants._uncertain import UncertainAxis, UncertainPlant
from ._nmpc_prepared import BUDGET, SLACK_WEIGHT, NonlinearProblem, controller_arrays
from ._nmpc_probe import plant_of, probed, require_horizon, risen
from ._nmpc_state_runtime import NMPC_NUMBERS, NmpcArrays, NmpcState
from ._predicted import over
from ._scale import TAUTNESS_LEVER, SizedPlant, predictive_limits, sized_plant
from ._tuning import move_weight, require_given, require_solvable, samples_ahead, spaced_starts

_STATUS_NAMES = ("not started", "optimal", "softened", "previous plan", "holding")
_RUNTIME = "softneck.design.predictive._nmpc_runtime"
# Kinds of model whose derivatives the runtime has.
NONLINEAR_KINDS = ("nn", "play", "greybox")
# Of another robot, stretched by its slowest pole: the horizon behind the dead time, and the window [s], as a neck's 20
# and 8 samples.
_HORIZON, _WINDOW = 0.32, 0.16
_LONGEST = 100
# What earlier versions let set, and files of theirs may hold; none of it is another number here.
_GONE = {
    "converged": False, "disturbance_time": None, "cocontraction_weight": 1.0, "slack_weight": SLACK_WEIGHT,
    "budget": BUDGET, "tautness_lever": TAUTNESS_LEVER, "order": "sequential",
    "tendon_angles": TENDON_ANGLES.tolist(),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NmpcSettings(Shown):
    """Nonlinear predictive control of all axes over `nn`, `play` or `greybox`, in sequential loops.

    One Gauss-Newton iteration for each sample, from the shifted plan of the sample before (real-time iteration, Diehl
    et al. 2005). The defaults are the neck's; of another robot times are stretched by its slowest pole. Limits of the
    motors are those of the robot's file; what is given is in the unit of its motors.

    Attributes:
        bandwidth: of the linear loop without dead time that has the same weights [rad/s].
        rise_s: time [s] in which a step rises from 10 to 90 %, as if bandwidth and reference filter were two lags;
            where the bandwidth is too slow for it, that is raised. None: a filter of 0.2 s.
        preview: how far ahead the reference is known [s].
        horizon: N, samples from now, the dead time among them.
        moves: times at which the motors move.
        lead_limit: how far a set-point may be from its motor [rad].
        angle_limit: soft limit of pitch and roll, or of another robot's angles [rad]; None for none.
        minimum_tautness: least motor position beyond that at which a tendon follows the neck [rad], a wish that
            co-contraction is raised for, with its weight; None for none. Models that have not seen tendons hang are
            wrong where they do. For necks.
    """

    bandwidth: float = NeckDefault(8.0)
    rise_s: float | None = None
    preview: float = 0.0
    horizon: int = NeckCount(20)
    moves: int = NeckCount(10)
    lead_limit: float = NeckDefault(1.0)
    angle_limit: float | None = None
    minimum_tautness: float | None = None

    def __post_init__(self) -> None:
        require_given(self, {"bandwidth": "rad/s", "lead_limit": "", "angle_limit": "rad"})
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
        require_between("preview", self.preview, 0.0, 1e6, "s")
        require_whole("horizon", self.horizon, 2, 100)
        require_whole("moves", self.moves, 1, self.horizon)
        if self.minimum_tautness is not None:
            require_between("minimum_tautness", self.minimum_tautness, -MAX_MOTOR, MAX_MOTOR, "rad")

    def over(self, observer: Any) -> NmpcNumbers:
        """Return the settings for a loop with this observer: how far it looks ahead."""
        return over(NmpcNumbers.of(self), observer)

    def design(self, model: Model) -> NmpcController:
        """Return the controller for an identified nonlinear `model`.

        Raises:
            SettingsError: a model of another kind, one that its inputs do not move, or limits of no robot.
        """
        if not isinstance(model, Model) or model.kind not in NONLINEAR_KINDS:
            got = model.kind if isinstance(model, Model) else type(model).__name__
            raise SettingsError(
                f"nonlinear predictive control is over {', '.join(NONLINEAR_KINDS)}; got {got}. "
                "For a linear model use `softneck design mpc`."
            )
        robot = model.robot
        limits = predictive_limits(self, robot)
        directions = None if robot.is_neck else weights_of(model)
        pulled = max(0.0, self.minimum_tautness or 0.0)
        found = probed(model, redefinition(directions, robot)[1], limits, pulled)
        own = NmpcNumbers.of(self)
        own = risen(own if robot.is_neck else own.of_robot(found, model.sample_time))
        require_horizon(own, [plant_of(item, model.sample_time, robot.is_neck) for item in found.values()])
        require_solvable(own.moves, len(robot.motors.names))
        return NmpcController(settings=own, limits=limits, model=model, found=found, directions=directions)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NmpcNumbers(NmpcSettings):
    """Settings, and the numbers that follow from plant and observer.

    Attributes:
        window: samples over which the output disturbance is estimated.
        reference_time: time constant of the reference filter [s].
        look_ahead: by how much the observer of the loop runs ahead of its sensor [s]; whole samples of it count.
    """

    window: int = NeckCount(8)
    reference_time: float = NeckDefault(0.2)
    look_ahead: float = NeckDefault(0.0)

    @classmethod
    def of(cls, settings: NmpcSettings) -> Self:
        """Return the settings with these numbers."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    def of_robot(self, found: Mapping[str, Mapping[str, float]], sample_time: float) -> Self:
        """Return the settings for another robot, times stretched by its slowest plant near rest."""
        plants = [plant_of(item, sample_time, neck=False) for item in found.values()]
        stretch = max(plant.stretch for plant in plants)
        horizon = max(plant.delay for plant in plants) + round(_HORIZON * stretch / sample_time)
        others = {
            "bandwidth": self.bandwidth / stretch,
            "reference_time": self.reference_time * stretch,
            "horizon": min(max(horizon, 3), _LONGEST),
            "window": min(max(round(_WINDOW * stretch / sample_time), 2), _LONGEST),
        }
        changed = {k: v for k, v in others.items() if isinstance(getattr(self, k), NeckDefault | NeckCount)}
        if isinstance(self.moves, NeckCount):
            changed["moves"] = min(int(self.moves), int(changed.get("horizon", self.horizon)))
        return replace(self, **changed)


def redefinition(directions: Matrix | None, robot: Robot) -> tuple[Matrix, Matrix]:
    """Return T from motors to redefined inputs, and its inverse."""
    if directions is not None:
        return redefinition_of(directions, robot.outputs.names)
    T = redefinition_matrix()
    return T, np.linalg.inv(T)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SampleSolution:
    """What a sample decided.

    Attributes:
        status: "optimal", "softened", "previous plan", "holding" or "not started".
        iterations: of the QP solver, all Gauss-Newton steps together.
        residual: of the QP's KKT conditions.
        previous_plan, softened: samples so far on which those happened.
        moves: (moves, motors) that are planned next [rad], of another robot in SI.
    """

    status: str
    iterations: int
    residual: float
    previous_plan: int
    softened: int
    moves: Matrix


def explain(block: Block, values: Vector) -> SampleSolution:
    """Return what the sample decided that led a controller's `block` to the state `values`."""
    a = NmpcArrays(block.arrays)
    parts = NmpcState.parts(a)
    # Of another robot the motors' unit, before those of the outputs.
    unit = a.setup[-a.T.shape[0]] if a.setup.size > NMPC_NUMBERS else 1.0
    number = {name: float(values[place.start]) for name, place in parts.items()}
    return SampleSolution(
        status=_STATUS_NAMES[int(number["status"])],
        iterations=int(number["iterations"]),
        residual=number["residual"],
        previous_plan=int(number["shifted"]),
        softened=int(number["softened"]),
        moves=unit * values[parts["plan"]].reshape(-1, a.T.shape[1]),
    )


class NmpcPart(BlockPart):
    """A nonlinear predictive controller that a loop steps; a `softneck.loop.Part` with `info` of its last sample.

    Attributes:
        took: how long the last sample took [s].
    """

    def __init__(self, controller: Block) -> None:
        """Adapt a controller's block; the state comes with `start`."""
        super().__init__(controller)
        self.took = math.nan

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        self.took = math.nan
        return super().start(time, parameters)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        outputs = super().advance(time, inputs)
        self.took = clock.perf_counter() - begin
        return outputs

    @property
    def info(self) -> SampleSolution:
        """What the last sample decided."""
        return explain(self.block, self._state)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class NmpcController(Shown):
    """A nonlinear predictive controller of all outputs; `NmpcSettings.design` makes it.

    Attributes:
        settings: what was asked, and the numbers that follow.
        limits: what its set-points may do.
        model: that it predicts with.
        found: static gain, pole and dead time of the model near rest, by axis.
        directions: (outputs, motors) of the motors in each output of another robot than the neck.
    """

    settings: NmpcNumbers
    limits: ControllerLimits
    model: Model
    found: Mapping[str, Mapping[str, float]]
    directions: Matrix | None = None

    kind = "nmpc"

    @property
    def sample_time(self) -> float:
        """Of the model and of the loop [s]."""
        return self.model.sample_time

    @property
    def robot(self) -> Robot:
        """Whose controller it is."""
        return self.model.robot

    @property
    def preview(self) -> float:
        """How far ahead the reference is known [s]."""
        return round(self.settings.preview / self.sample_time) * self.sample_time

    @cached_property
    def inputs(self) -> tuple[Port, ...]:
        """The ports of a controller, and with preview those of the reference ahead."""
        names = self.robot.outputs.names
        ahead = tuple(
            replace(port, name=f"{port.name}_ahead", description=f"{port.description} {self.preview:g} s from now")
            for port in controller_inputs(self.robot)[: len(names)]
        ) if self.preview > 0.0 else ()  # fmt: skip
        return (*controller_inputs(self.robot), *ahead)

    @cached_property
    def outputs(self) -> tuple[Port, ...]:
        """The set-points."""
        return controller_outputs(self.robot)

    @cached_property
    def parameters(self) -> tuple[Port, ...]:
        """The limits that can be changed at the start."""
        return self.limits.ports()[:4]

    def plants(self) -> tuple[AxisPlant, ...]:
        """Return the linear plants that the model is near rest, of another robot in the units of its size."""
        if self._sized is None:
            return self._near_rest
        return tuple(axis.nominal for axis in self._sized.axes.values())

    @property
    def _near_rest(self) -> tuple[AxisPlant, ...]:
        neck = self.robot.is_neck
        return tuple(plant_of(self.found[axis], self.sample_time, neck) for axis in self.robot.outputs.names)

    @cached_property
    def _sized(self) -> SizedPlant | None:
        """Another robot's plants in the units of its size."""
        if self.directions is None:
            return None
        names = self.robot.outputs.names
        axes = {name: UncertainAxis(plant, (plant,)) for name, plant in zip(names, self._near_rest, strict=True)}
        T = redefinition(self.directions, self.robot)
        return sized_plant(UncertainPlant(axes, self.robot, self.directions), self.limits, T)

    def problem(self) -> NonlinearProblem:
        """Return what is asked, in numbers."""
        s, plants, scale = self.settings, self.plants(), None
        if self._sized is None:
            T, inverse = redefinition(None, self.robot)
        else:
            (T, inverse), scale = self._sized.redefinition, self._sized.scale
        weights = np.tile([1.0 / plant.static_gain**2 for plant in plants], (s.horizon, 1))
        # What follows the horizon: an error that dies out as fast as the loop.
        weights[-1] /= 1.0 - math.exp(-2.0 * s.bandwidth * self.sample_time)
        return NonlinearProblem(
            model=self.model,
            horizon=s.horizon,
            starts=spaced_starts(s.horizon, s.moves),
            T=T,
            T_inverse=inverse,
            weights=weights,
            move_weight=1.5 * max(move_weight(plant, s.bandwidth) for plant in plants),
            cocontraction_weight=1.0,
            scale=scale,
            look=samples_ahead(s.look_ahead, self.sample_time),
        )

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; parameters are the limits by name."""
        return self._block.initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the set-points valid now; inputs as `inputs`.

        Raises:
            DataError: wrong number of inputs, or one that is not finite.
        """
        return self._block.step(state, inputs)

    def info(self, state: State) -> SampleSolution:
        """Return what the sample that led to `state` decided."""
        return explain(self._block, state.values)

    def part(self) -> NmpcPart:
        """Return the controller as a part of a loop that tells what each sample decided."""
        return NmpcPart(self._block)

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return self._block

    @cached_property
    def _block(self) -> Block:
        # How far it can be trusted is no part of a prediction, and takes time in each of its steps.
        plant, robot = replace(self.model, arrays=without_validity(self.model.arrays)).block(), self.robot
        outer = sized_name(_RUNTIME, len(robot.motors.names), len(robot.outputs.names))
        return Block(
            kind="nmpc",
            role="controller",
            runtime=f"{outer}({plant.runtime}:{len(plant.arrays)})",
            sample_time=self.sample_time,
            arrays=(*controller_arrays(self), *plant.arrays),
            inputs=self.inputs,
            outputs=self.outputs,
            parameters=self.parameters,
        )

    def summary(self) -> str:
        """Return some lines for people."""
        s, robot = self.settings, self.robot
        lines = [
            f"nmpc controller over {self.model.kind}, {1e3 * self.sample_time:g} ms, sequential order",
            f"  {len(robot.motors.names) * s.moves} unknowns, horizon {s.horizon} samples, bandwidth "
            f"{s.bandwidth:.4g} rad/s, disturbance over {s.window} samples, "
            "one iteration a sample",
        ]
        if not robot.is_neck:
            lines += self.limits.lines(self.sample_time)
        shown, motor = to_si(robot.outputs.display_unit)[0], to_si(robot.motors.unit)[0]
        for axis in robot.outputs.names:
            f = self.found[axis]
            lines.append(
                f"  {axis}: the model near rest is {f['static_gain'] * motor / shown:.3g} "
                f"{robot.outputs.display_unit}/{robot.motors.unit}, pole {f['pole']:.3g} 1/s, dead time "
                f"{1e3 * f['delay'] * self.sample_time:g} ms"
            )
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller with its model to one `.npz` file."""
        model, arrays = nested(self.model)
        header = {
            "kind": "nmpc",
            "settings": asdict(self.settings),
            **self.limits.header(),
            "found": {axis: dict(values) for axis, values in self.found.items()},
            "model": model,
            **({} if self.directions is None else {"directions": self.directions.tolist()}),
            **self.robot.in_header(),
        }
        write_archive(path, header, arrays, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> NmpcController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        model = nested_model(header["model"], arrays)
        settings, robot = dict(header["settings"]), model.robot
        for name, usual in _GONE.items():
            if (value := settings.pop(name, usual)) != usual:
                raise FileFormatError(
                    f"`{name}` = {value} went after softneck 0.2.0, which still reads the file; design it again."
                )
        per_motor, given = to_si(robot.motors.unit)[0], header
        if "position_limit" in settings:  # of versions before 0.3, in the unit of the motors
            given = {name: per_motor * settings.pop(name) for name in LIMITS[:4]}
        directions = np.array(header["directions"]) if "directions" in header else None
        return cls(
            settings=NmpcNumbers(**settings), limits=ControllerLimits.from_header(given, robot), model=model,
            found=header["found"], directions=directions,
        )  # fmt: skip
