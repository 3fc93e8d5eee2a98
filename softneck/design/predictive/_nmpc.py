"""Nonlinear model predictive control: what is asked, and the controller that does it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    SettingsError,
    Vector,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    write_archive,
)
from softneck.estimation import AxisPlant
from softneck.estimation._settings import ORDERS
from softneck.identification import Model
from softneck.runtime import Block, Port, State
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..linear._ports import controller_inputs, controller_outputs, limit_ports
from ._nmpc_part import NmpcPart, SampleSolution, explain
from ._nmpc_prepared import NonlinearProblem, controller_arrays
from ._settings import spaced_starts
from ._tuning import move_weight

# Kinds of model whose derivatives the runtime has.
NONLINEAR_KINDS = ("nn", "play", "greybox", "nss")
# The model is moved by this much of a redefined input to learn its gain and its time constant [rad].
_PROBE = 1.0
_PROBE_SECONDS = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NmpcSettings:
    """Nonlinear predictive control of both axes over `nn`, `play`, `greybox` or `nss`.

    One Gauss-Newton iteration for each sample, from the shifted plan of the sample before (real-time iteration, Diehl
    et al. 2005); `converged` iterates to the end.

    Attributes:
        bandwidth: of the linear loop without dead time that has the same weights [rad/s].
        window: samples over which the output disturbance is estimated.
        disturbance_time: time constant of the disturbance's rate [s]; None for the model's own.
        reference_time: time constant of the reference filter [s].
        preview: how far ahead the reference is known [s].
        horizon: N, samples from now, the dead time among them.
        moves: times at which the motors move.
        converged: iterate until nothing changes, for reference.
        position_limit, slew_limit, lead_limit, least_position: of each motor [rad], [rad/s], [rad], [rad].
        angle_limit: soft limit of pitch and roll [rad]; None for none.
        cocontraction_weight: on the error of co-contraction, against that of the tilt's inputs, squared.
        slack_weight: on violations of soft limits, against errors of the angles, squared.
        budget: iterations of the QP solver.
        order: of the loop; "jacobi" needs a model that was identified with its delays.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    bandwidth: float = 8.0
    window: int = 8
    disturbance_time: float | None = None
    reference_time: float = 0.2
    preview: float = 0.0
    horizon: int = 20
    moves: int = 10
    converged: bool = False
    position_limit: float = 6.0
    slew_limit: float = 12.5
    lead_limit: float = 1.0
    least_position: float = -6.0
    angle_limit: float | None = None
    cocontraction_weight: float = 1.0
    slack_weight: float = 1e3
    budget: int = 200
    order: str = "sequential"
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())

    def __post_init__(self) -> None:
        require_between("bandwidth", self.bandwidth, 0.5, 100.0, "rad/s")
        require_whole("window", self.window, 2, 100)
        if self.disturbance_time is not None:
            require_between("disturbance_time", self.disturbance_time, 0.02, 20.0, "s")
        require_between("reference_time", self.reference_time, 0.0, 60.0, "s")
        require_between("preview", self.preview, 0.0, 4.0, "s")
        require_whole("horizon", self.horizon, 2, 100)
        require_whole("moves", self.moves, 1, self.horizon)
        require_between("position_limit", self.position_limit, 0.01, 6.0, "rad")
        require_between("slew_limit", self.slew_limit, 0.01, 1000.0, "rad/s")
        require_between("lead_limit", self.lead_limit, 0.01, 12.0, "rad")
        require_between("least_position", self.least_position, -6.0, self.position_limit - 1e-3, "rad")
        if self.angle_limit is not None:
            require_between("angle_limit", self.angle_limit, 0.01, 0.8, "rad")
        for name in ("cocontraction_weight", "slack_weight"):
            require_positive(name, getattr(self, name))
        require_whole("budget", self.budget, 1, 10_000)
        require_one_of("order", self.order, ORDERS)
        if self.order != "sequential":
            raise SettingsError("nonlinear predictive control is for `order=sequential`, as on the hardware.")

    def design(self, model: Model) -> NmpcController:
        """Return the controller for an identified nonlinear `model`.

        Raises:
            SettingsError: a model of another kind, or one that its inputs do not move.
        """
        if not isinstance(model, Model) or model.kind not in NONLINEAR_KINDS:
            got = model.kind if isinstance(model, Model) else type(model).__name__
            raise SettingsError(
                f"nonlinear predictive control is over {', '.join(NONLINEAR_KINDS)}; got {got}. "
                "For a linear model use `softneck design mpc`."
            )
        model.robot.require_neck("nonlinear predictive control")
        plants = probed(model, redefinition_matrix(np.array(self.tendon_angles)))
        found = {
            axis: {
                "static_gain": plant.static_gain,
                "pole": -math.log(float(plant.denominator[1] * -1.0)) / plant.sample_time,
                "delay": plant.delay,
            }
            for axis, plant in zip(("pitch", "roll"), plants, strict=True)
        }
        return NmpcController(settings=self, model=model, found=found)


@dataclass(frozen=True, eq=False, kw_only=True)
class NmpcController:
    """A nonlinear predictive controller of pitch and roll; `NmpcSettings.design` makes it.

    Attributes:
        settings: what was asked.
        model: that it predicts with.
        found: static gain, pole and dead time of the model near rest, by axis.
    """

    settings: NmpcSettings
    model: Model
    found: Mapping[str, Mapping[str, float]]

    kind = "nmpc"

    @property
    def sample_time(self) -> float:
        """Of the model and of the loop [s]."""
        return self.model.sample_time

    @property
    def preview(self) -> float:
        """How far ahead the reference is known [s]."""
        return round(self.settings.preview / self.sample_time) * self.sample_time

    @cached_property
    def inputs(self) -> tuple[Port, ...]:
        """The ports of a controller, and with preview those of the reference ahead."""
        ahead = tuple(
            Port(name=f"{axis}_reference_ahead", unit="rad", minimum=-0.8, maximum=0.8,
                 description=f"wanted {axis} {self.preview:g} s from now")
            for axis in ("pitch", "roll")
        ) if self.preview > 0.0 else ()  # fmt: skip
        return (*controller_inputs(), *ahead)

    @cached_property
    def outputs(self) -> tuple[Port, ...]:
        """The set-points."""
        return controller_outputs()

    @cached_property
    def parameters(self) -> tuple[Port, ...]:
        """The limits that can be changed at the start."""
        s = self.settings
        return limit_ports((s.position_limit, s.slew_limit, s.lead_limit, s.least_position, -6.0))[:4]

    def plants(self) -> tuple[AxisPlant, AxisPlant]:
        """Return the linear plants that the model is near rest."""
        first, second = (_plant(self.found[axis], self.sample_time) for axis in ("pitch", "roll"))
        return first, second

    def problem(self) -> NonlinearProblem:
        """Return what is asked, in numbers."""
        s, plants = self.settings, self.plants()
        weights = np.tile([1.0 / plant.static_gain**2 for plant in plants], (s.horizon, 1))
        # What follows the horizon: an error that dies out as fast as the loop.
        weights[-1] /= 1.0 - math.exp(-2.0 * s.bandwidth * self.sample_time)
        return NonlinearProblem(
            model=self.model,
            horizon=s.horizon,
            starts=spaced_starts(s.horizon, s.moves),
            T=redefinition_matrix(np.array(s.tendon_angles)),
            weights=weights,
            move_weight=1.5 * max(move_weight(plant, s.bandwidth) for plant in plants),
            cocontraction_weight=s.cocontraction_weight,
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

    def part(self, *, solver: str = "own") -> Any:
        """Return the controller as a part of a loop that tells what each sample decided.

        Args:
            solver: "own", or "casadi" for each sample's optimum by ipopt: slow, a reference to compare with.
        """
        from ._optimal import OptimalPart

        require_one_of("solver", solver, ("own", "casadi"))
        return NmpcPart(self._block) if solver == "own" else OptimalPart(self)

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return self._block

    @cached_property
    def _block(self) -> Block:
        plant = self.model.block()
        return Block(
            kind="nmpc",
            role="controller",
            runtime=f"softneck.design.predictive._nmpc_runtime({plant.runtime}:{len(plant.arrays)})",
            sample_time=self.sample_time,
            arrays=(*controller_arrays(self), *plant.arrays),
            inputs=self.inputs,
            outputs=self.outputs,
            parameters=self.parameters,
        )

    def summary(self) -> str:
        """Return some lines for people."""
        s = self.settings
        lines = [
            f"nmpc controller over {self.model.kind}, {1e3 * self.sample_time:g} ms, {s.order} order",
            f"  {3 * s.moves} unknowns, horizon {s.horizon} samples, bandwidth {s.bandwidth:g} rad/s, disturbance over "
            f"{s.window} samples, {'converged' if s.converged else 'one iteration a sample'}",
        ]
        for axis in ("pitch", "roll"):
            f = self.found[axis]
            lines.append(
                f"  {axis}: the model near rest is {math.degrees(f['static_gain']):.3g} deg/rad, pole {f['pole']:.3g} "
                f"1/s, dead time {1e3 * f['delay'] * self.sample_time:g} ms"
            )
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller with its model to one `.npz` file."""
        m = self.model
        header = {
            "kind": "nmpc",
            "settings": asdict(self.settings),
            "found": {axis: dict(values) for axis, values in self.found.items()},
            "model": {
                "kind": m.kind, "sample_time": m.sample_time, "arrays": list(m.arrays), "settings": dict(m.settings),
                "findings": dict(m.findings),
            },
        }  # fmt: skip
        arrays = {f"model_{name}": array for name, array in m.arrays.items()}
        write_archive(path, header, {**arrays, "model_training_rows": m.training_rows}, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> NmpcController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        names = [*header["model"]["arrays"], "training_rows"]
        model = Model.from_archive(dict(header["model"]), {name: arrays[f"model_{name}"] for name in names})
        settings = dict(header["settings"])
        settings["tendon_angles"] = tuple(settings["tendon_angles"])
        return cls(settings=NmpcSettings(**settings), model=model, found=header["found"])


def probed(model: Model, T: np.ndarray) -> tuple[AxisPlant, AxisPlant]:
    """Return one-pole plants with dead time that step as the model does near rest.

    Raises:
        SettingsError: an input that does not move its angle.
    """
    block = model.block()
    rows = round(_PROBE_SECONDS / model.sample_time)
    plants = []
    for axis, name in enumerate(("pitch", "roll")):
        ends = []
        for sign in (0.0, 1.0):
            u = np.full((rows, 8), np.nan)
            u[:, :3] = sign * _PROBE * np.linalg.inv(T)[:, axis]
            ends.append(block.run(block.initial_state(use_measurement=0.0), u)[1][:, axis])
        y = (ends[1] - ends[0]) / _PROBE
        if not np.isfinite(y).all() or abs(y[-1]) < 1e-3:
            raise SettingsError(f"the model's {name} does not follow its input (Eq. 9, 10); identify it again.")
        share = y / y[-1]
        dead, risen = (int(np.argmax(share > part)) for part in (0.05, 0.632))
        a = math.exp(-1.0 / max(1, risen - dead))
        plants.append(_plant({"static_gain": y[-1], "a": a, "delay": dead}, model.sample_time))
    return plants[0], plants[1]


def _plant(found: Mapping[str, float], sample_time: float) -> AxisPlant:
    a = found["a"] if "a" in found else math.exp(-found["pole"] * sample_time)
    return AxisPlant(
        np.array([found["static_gain"] * (1.0 - a)]), np.array([1.0, -a]), int(found["delay"]), sample_time
    )
