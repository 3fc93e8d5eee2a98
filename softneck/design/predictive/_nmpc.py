"""Nonlinear model predictive control: settings, controller, and decisions of its samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from softneck.core import (
    FileFormatError,
    Matrix,
    ReprMixin,
    SettingsError,
    Vector,
    require_between,
    require_finite,
    require_header,
    require_whole,
    to_si,
    write_archive,
)
from softneck.identification import Model, embed_model, embedded_model, weights_of, without_validity
from softneck.robot import Robot
from softneck.runtime import Block, Port, State, SteppedMixin, sized_name
from softneck.signals import TENDON_ANGLES

from ..linear._ports import LIMITS, ControllerLimits, controller_inputs, controller_outputs
from ..plants._uncertain import UncertainAxis, UncertainPlant
from ._controller import STATUS_NAMES, PredictivePart
from ._nmpc_problem import (
    BUDGET,
    SLACK_WEIGHT,
    NonlinearProblem,
    apply_rise_time,
    controller_arrays,
    identify_near_rest,
    plant_of,
    require_horizon,
)
from ._nmpc_state_runtime import NMPC_NUMBERS, NmpcArrays, NmpcState
from ._plant import TAUTNESS_LEVER, ScaledPlant, over, predictive_limits, samples_ahead, scaled_plant
from ._tuning import move_weight, require_positive_settings, require_solvable, spaced_starts

_RUNTIME_MODULE = "softneck.design.predictive._nmpc_runtime"
# Kinds of model whose derivatives the runtime has.
NONLINEAR_KINDS = ("nn", "play", "greybox")
# In scaled seconds: horizon and what of it is behind the dead time at least, in samples at most so many; window, time
# constant of the reference filter; moves, and bandwidth.
_HORIZON_S, _LEAST_HORIZON_S, _MAX_SAMPLES = 0.4, 0.2, 100
_WINDOW_S, _REFERENCE_TIME_S, _MOVE_COUNT, _BANDWIDTH_RAD_S = 0.16, 0.2, 10, 8.0
# What earlier versions let set, and files of theirs may hold; none of it is another number here.
_REMOVED_SETTINGS = {
    "converged": False, "disturbance_time": None, "cocontraction_weight": 1.0, "slack_weight": SLACK_WEIGHT,
    "budget": BUDGET, "tautness_lever": TAUTNESS_LEVER, "order": "sequential",
    "tendon_angles": TENDON_ANGLES.tolist(),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NmpcSettings(ReprMixin):
    """Nonlinear predictive control of all axes over `nn`, `play` or `greybox`, in sequential loops.

    One Gauss-Newton iteration for each sample, from the shifted plan of the sample before (real-time iteration, Diehl
    et al. 2005). Defaults are in ranges and time constants of the robot. Limits of the motors are those of its file;
    what is given is in the unit of its motors.

    Attributes:
        bandwidth: of the linear loop without dead time that has the same weights [rad/s]; None: 1.6 over the time
            constant, 8 of the neck.
        rise_s: time [s] in which a step rises from 10 to 90 %, as if bandwidth and reference filter were two lags;
            where the bandwidth is too slow for it, that is raised. None: a filter of the robot's time constant.
        preview: how far ahead the reference is known [s].
        horizon: N, samples from now, the dead time among them; None: two time constants, 20 samples of the neck.
        moves: times at which the motors move; None: 10.
        lead_limit: how far a set-point may be from its motor [rad]; None: as of `mpc`.
        angle_limit: soft limit of outputs that are angles [rad]; None for none.
        minimum_tautness: least motor position beyond that at which a tendon follows the outputs [rad], a wish that
            co-contraction is raised for, with its weight; None for none. Models that have not seen tendons hang are
            wrong where they do. For tendons at known angles.
    """

    bandwidth: float | None = None
    rise_s: float | None = None
    preview: float = 0.0
    horizon: int | None = None
    moves: int | None = None
    lead_limit: float | None = None
    angle_limit: float | None = None
    minimum_tautness: float | None = None

    def __post_init__(self) -> None:
        require_positive_settings(self, {"bandwidth": "rad/s", "lead_limit": "", "angle_limit": "rad"})
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
        require_between("preview", self.preview, 0.0, 1e6, "s")
        if self.horizon is not None:
            require_whole("horizon", self.horizon, 2, _MAX_SAMPLES)
        if self.moves is not None:
            require_whole("moves", self.moves, 1, self.horizon or _MAX_SAMPLES)
        if self.minimum_tautness is not None:
            require_finite("minimum_tautness", self.minimum_tautness)

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
        found = identify_near_rest(model, max(0.0, self.minimum_tautness or 0.0))
        plant = near_rest(model, found)
        limits = predictive_limits(self, plant)
        own = apply_rise_time(NmpcNumbers.of(self).fill_defaults(plant))
        require_horizon(own, [plant_of(item, model.sample_time) for item in found.values()])
        require_solvable(own.moves or 1, len(robot.motors.names))
        return NmpcController(settings=own, limits=limits, model=model, found=found)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class NmpcNumbers(NmpcSettings):
    """Settings with the numbers that follow from plant and observer; None for defaults.

    Attributes:
        window: samples over which the output disturbance is estimated.
        reference_time: time constant of the reference filter [s].
        look_ahead: by how much the observer of the loop runs ahead of its sensor [s]; whole samples of it count.
    """

    window: int | None = None
    reference_time: float | None = None
    look_ahead: float | None = None

    def __post_init__(self) -> None:
        NmpcSettings.__post_init__(self)
        if self.window is not None:
            require_whole("window", self.window, 2, _MAX_SAMPLES)

    @classmethod
    def of(cls, settings: NmpcSettings) -> Self:
        """Return the settings with these numbers."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    def fill_defaults(self, plant: ScaledPlant) -> Self:
        """Return the settings with the numbers that are usual for a plant."""
        second, Ts = plant.scaling.second, plant.axes[0].sample_time
        delay = max(item.delay for item in plant.axes)
        horizon = self.horizon or min(
            max(3, round(_HORIZON_S / Ts), delay + round(_LEAST_HORIZON_S / Ts)), _MAX_SAMPLES
        )
        usual = {
            "bandwidth": _BANDWIDTH_RAD_S / second, "reference_time": _REFERENCE_TIME_S * second, "look_ahead": 0.0,
            "horizon": horizon, "moves": min(_MOVE_COUNT, horizon),
            "window": min(max(round(_WINDOW_S / Ts), 2), _MAX_SAMPLES),
        }  # fmt: skip
        return replace(self, **{name: value for name, value in usual.items() if getattr(self, name) is None})


_COUNTS = ("window", "horizon", "moves")
_HEADER = {
    "settings": {one.name: (int if one.name in _COUNTS else float, None) for one in fields(NmpcNumbers)},
    "found": {str: {"static_gain": float, "pole": float, "delay": int}},
}


def near_rest(model: Model, found: Mapping[str, Mapping[str, float]]) -> ScaledPlant:
    """Return the linear model near rest, in scaled quantities."""
    plants = {name: plant_of(found[name], model.sample_time) for name in model.robot.outputs.names}
    axes = {name: UncertainAxis(plant, (plant,)) for name, plant in plants.items()}
    return scaled_plant(UncertainPlant(axes, model.robot, weights_of(model)), identified=True)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SampleSolution:
    """The decision of a sample.

    Attributes:
        status: "optimal", "softened", "previous plan", "holding" or "not started".
        iterations: of the QP solver, all Gauss-Newton steps together.
        residual: of the QP's KKT conditions.
        previous_plan, softened: samples so far on which those happened.
        moves: (moves, motors) that are planned next [SI].
    """

    status: str
    iterations: int
    residual: float
    previous_plan: int
    softened: int
    moves: Matrix


def explain(block: Block, values: Vector) -> SampleSolution:
    """Return the decision of the sample that led a controller's `block` to the state `values`."""
    a = NmpcArrays(block.arrays)
    parts = NmpcState.parts(a)
    # The motors' unit, before those of the outputs.
    unit = a.setup[-a.T.shape[0]] if a.setup.size > NMPC_NUMBERS else 1.0
    number = {name: float(values[place.start]) for name, place in parts.items()}
    return SampleSolution(
        status=STATUS_NAMES[int(number["status"])],
        iterations=int(number["iterations"]),
        residual=number["residual"],
        previous_plan=int(number["shifted"]),
        softened=int(number["softened"]),
        moves=unit * values[parts["plan"]].reshape(-1, a.T.shape[1]),
    )


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class NmpcController(SteppedMixin, ReprMixin):
    """A nonlinear predictive controller of all outputs; `NmpcSettings.design` makes it.

    Attributes:
        settings: what was asked, and the numbers that follow.
        limits: what its set-points may do.
        model: that it predicts with.
        found: static gain, pole and dead time of the model near rest, by axis.
    """

    settings: NmpcNumbers
    limits: ControllerLimits
    model: Model
    found: Mapping[str, Mapping[str, float]]

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

    @cached_property
    def near_rest(self) -> ScaledPlant:
        """The linear model near rest, in scaled quantities."""
        return near_rest(self.model, self.found)

    def problem(self) -> NonlinearProblem:
        """Return the optimisation problem."""
        s: Any = self.settings
        plant = self.near_rest
        (T, inverse), scaling, plants = plant.redefinition, plant.scaling, plant.axes
        weights = np.tile([1.0 / item.static_gain**2 for item in plants], (s.horizon, 1))
        # What follows the horizon: an error that dies out as fast as the loop.
        weights[-1] /= 1.0 - math.exp(-2.0 * s.bandwidth * self.sample_time)
        return NonlinearProblem(
            model=self.model,
            horizon=s.horizon,
            starts=spaced_starts(s.horizon, s.moves),
            T=T,
            T_inverse=inverse,
            weights=weights,
            move_weight=1.5 * max(move_weight(item, s.bandwidth * scaling.second) for item in plants),
            cocontraction_weight=1.0,
            look=samples_ahead(s.look_ahead, self.sample_time),
        )

    def info(self, state: State) -> SampleSolution:
        """Return the decision of the sample that led to `state`."""
        return self.explain(state.values)

    def explain(self, values: Vector) -> SampleSolution:
        """Return the same of a state's values."""
        return explain(self._block, values)

    def part(self) -> PredictivePart:
        """Return the controller as a part of a loop that reports the decision of each sample."""
        return PredictivePart(self)

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return self._block

    @cached_property
    def _block(self) -> Block:
        # How far it can be trusted is no part of a prediction, and takes time in each of its steps.
        plant, robot = replace(self.model, arrays=without_validity(self.model.arrays)).block(), self.robot
        outer = sized_name(_RUNTIME_MODULE, len(robot.motors.names), len(robot.outputs.names))
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
        s: Any = self.settings
        robot = self.robot
        lines = [
            f"nmpc controller over {self.model.kind}, {1e3 * self.sample_time:g} ms, sequential order",
            f"  {len(robot.motors.names) * s.moves} unknowns, horizon {s.horizon} samples, bandwidth "
            f"{s.bandwidth:.4g} rad/s, disturbance over {s.window} samples, "
            "one iteration a sample",
        ]
        lines += self.limits.lines(self.sample_time)
        factor, unit = robot.shown_gain
        for axis in robot.outputs.names:
            f = self.found[axis]
            lines.append(
                f"  {axis}: the model near rest is {factor * f['static_gain']:.3g} {unit}, pole "
                f"{f['pole']:.3g} 1/s, dead time {1e3 * f['delay'] * self.sample_time:g} ms"
            )
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller with its model to one `.npz` file."""
        model, arrays = embed_model(self.model)
        header = {
            "kind": "nmpc",
            "settings": asdict(self.settings),
            **self.limits.header(),
            "found": {axis: dict(values) for axis, values in self.found.items()},
            "model": model,
            **self.robot.in_header(),
        }
        write_archive(path, header, arrays, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> NmpcController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        model = embedded_model(header["model"], arrays)
        require_header(header, _HEADER)
        settings, robot = dict(header["settings"]), model.robot
        for name, usual in _REMOVED_SETTINGS.items():
            if (value := settings.pop(name, usual)) != usual:
                raise FileFormatError(
                    f"`{name}` = {value} went after softneck 0.2.0, which still reads the file; design it again."
                )
        per_motor, given = to_si(robot.motors.unit)[0], header
        if "position_limit" in settings:  # of versions before 0.3, in the unit of the motors
            given = {name: per_motor * settings.pop(name) for name in LIMITS[:4]}
        for axis in header["found"].values():
            require_whole("delay", axis["delay"], 0, _MAX_SAMPLES)
            if axis["static_gain"] == 0.0:
                raise FileFormatError("its header.found has a static gain of 0: the motors move nothing.")
        plant = near_rest(model, header["found"])
        return cls(
            # A file of an earlier version may not say all.
            settings=NmpcNumbers(**settings).fill_defaults(plant), limits=ControllerLimits.from_header(given, robot),
            model=model, found=header["found"],
        )  # fmt: skip
