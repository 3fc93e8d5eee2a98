"""A controller of one's own, made with python-control, on the neck's limits, conditioning and allocation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softneck.core import DataError, Matrix, SettingsError
from softneck.identification import to_state_space
from softneck.robot import Robot

from ..plants._coupled import AnyAxes, coupled_plant
from ..plants._uncertain import UncertainAxis, UncertainPlant, default_uncertainty
from ._axis_loop import coarse_frequencies, conditioning_gain, error_feedback, feedback_response, innovations_gain
from ._controller import AxisController, LinearController
from ._multivariable import MultivariableDesign, multivariable_controller
from ._settings import AxisDesign, AxisSettings

# A loop slower than a hundredth of its plant's pole hardly acts: gains in deg or kPa make it 57 or 1,000 times slower.
_SLOWEST_LOOP = 0.01
_INPUTS = {"pitch": "theta_i", "roll": "phi_i"}


@dataclass(frozen=True, slots=True, kw_only=True)
class CustomSettings(AxisSettings):
    """A discrete `control` system as the controller of each axis, or of all; limits and filter are as everywhere.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`. One system of all
    outputs (from `mixsyn`, say) is taken as it is: `reference_time` is 0 where it is not given, and nothing is reduced.

    Attributes:
        controller: K of `v = K (r - y)` in SI units (rad, Pa, m, V), or a system of two inputs, reference and angle,
            `v = K (r, y)`; one for both axes, or a mapping of "pitch" and "roll" (or another robot's outputs) to one
            each, or one system with as many outputs as the robot, from as many errors, or from all references and then
            all outputs. Inputs named `pitch_reference` and `pitch` are found by name, in any order.
    """

    KIND: ClassVar[str] = "custom"

    controller: Any = None

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if isinstance(self.controller, Mapping):
            for system in self.controller.values():
                _require_system(system, 1)
        else:
            _require_system(self.controller, getattr(self.controller, "noutputs", 1))

    def _design_axes(self, uncertain: UncertainPlant) -> LinearController:
        names = uncertain.names
        if isinstance(self.controller, Mapping) and set(self.controller) != set(names):
            given = ", ".join(map(str, self.controller)) or "none"
            raise SettingsError(f"`controller` must be given for {' and '.join(names)}; got {given}.")
        if self._is_multivariable():
            axes = [self._prepare_axis(uncertain.axis(name)).samples for name in names]
            count = max(len(samples) for samples in axes)
            plants = [tuple(samples[min(k, len(samples) - 1)] for samples in axes) for k in range(count)]
            return self._design_multivariable(uncertain.robot, plants, uncertain.redefinition)
        return AxisSettings._design_axes(self, uncertain)

    def _design_plant(self, plant: Any, robot: Robot | None) -> LinearController:
        whole: Any = coupled_plant(plant, robot=robot)
        if whole is None or (whole.robot.directions.names and not self._is_multivariable()):
            return AxisSettings._design_plant(self, plant, robot)
        if isinstance(self.controller, Mapping):
            raise SettingsError(
                f"outputs that answer to each other need one `controller` of {' and '.join(whole.names)}."
            )
        samples = [tuple(row.with_min_delay(default_uncertainty(whole.robot).least_delay) for row in whole.own_rows)]
        return self.of_robot(whole)._design_multivariable(whole.robot, samples, whole.own_redefinition)

    def _period(self, robot: Robot | None) -> float:  # noqa: ARG002
        # It says itself how often it runs.
        one = next(iter(self.controller.values())) if isinstance(self.controller, Mapping) else self.controller
        return float(one.dt)

    def _is_multivariable(self) -> bool:
        return not isinstance(self.controller, Mapping) and self.controller.noutputs > 1

    def _design_multivariable(
        self, robot: Robot, samples: Sequence[AnyAxes], redefinition: tuple[Matrix, Matrix]
    ) -> LinearController:
        """Return the controller of all outputs at once."""
        names, K = robot.outputs.names, self.controller
        if K.noutputs != len(names):
            raise SettingsError(f"`controller` has {K.noutputs} outputs; {' and '.join(names)} ask for {len(names)}.")
        _require_sample_time(K, samples[0][0].sample_time)
        made = MultivariableDesign(
            law=_law(K, names), samples=samples, redefinition=redefinition, gains={}, notes={"imported": True}
        )
        return multivariable_controller(self, made, robot, filtered=False)

    def _is_shared(self) -> bool:
        return not isinstance(self.controller, Mapping)

    def _settings_json(self) -> dict[str, Any]:
        stored = AxisSettings._settings_json(self)
        return {key: value for key, value in stored.items() if key != "controller"}

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:

        K = self.controller[name] if isinstance(self.controller, Mapping) else self.controller
        _require_sample_time(K, axis.sample_time)
        made = error_feedback(to_state_space(K)) if K.ninputs == 1 else _two_input_axis(K, name)
        return AxisDesign(made, {}, {"imported": True, **_remark_slow_loop(made, axis)})


def _remark_slow_loop(controller: AxisController, axis: UncertainAxis) -> dict[str, str]:
    """Return a remark on a loop far slower than its plant, as gains in another unit than SI make it."""
    plant = axis.nominal
    w = coarse_frequencies(plant)
    loop = np.abs(feedback_response(controller, np.exp(1j * w * plant.sample_time)) * plant.response(w))
    crossover = float(w[loop >= 1.0].max(initial=0.0))
    if crossover * plant.time_constant > _SLOWEST_LOOP:
        return {}
    return {
        "remark": f"the loop's gain is below 1 from {crossover:.2g} rad/s on, where the plant's pole is at "
        f"{1.0 / plant.time_constant:.2g} rad/s: is `controller` in SI units (rad, Pa, m, V)?"
    }


def _require_sample_time(K: Any, sample_time: float) -> None:
    if not math.isclose(float(K.dt), sample_time, rel_tol=1e-9):
        raise SettingsError(
            f"the controller runs every {K.dt:g} s, the plant every {sample_time:g} s; design it at {sample_time:g} s, "
            f"or identify the plant at {K.dt:g} s."
        )


def _require_system(K: Any, outputs: int) -> None:
    import control

    if not isinstance(K, control.StateSpace | control.TransferFunction):
        raise SettingsError(f"`controller` must be a control.StateSpace or TransferFunction; got {type(K).__name__}.")
    if K.noutputs != outputs or K.ninputs not in (outputs, 2 * outputs):
        raise SettingsError(
            f"`controller` must have as many inputs as outputs (errors), or twice as many (references and angles); got "
            f"{K.ninputs} inputs and {K.noutputs} outputs. Give one system of all outputs, or {{'pitch': ..., 'roll': "
            "...}} of one output each."
        )
    if K.dt is None or isinstance(K.dt, bool) or not K.dt > 0.0:
        raise SettingsError(
            f"`controller` must be discrete, its dt is {K.dt}; use control.sample_system(K, 0.02, 'tustin')."
        )
    system = to_state_space(K)
    if not all(np.isfinite(np.asarray(part)).all() for part in (system.A, system.B, system.C, system.D)):
        raise DataError("`controller` has entries that are not finite.")


def _two_input_axis(K: Any, name: str) -> AxisController:
    """Return the axis of a system from reference and angle, found by name where it has names."""

    labels = list(K.input_labels)
    wanted = [f"{name}_reference", name]
    if all(label.startswith("u[") for label in labels):
        order = [0, 1]
    elif set(labels) == set(wanted):
        order = [labels.index(label) for label in wanted]
    else:
        raise SettingsError(
            f"the inputs of the controller of {name} are {', '.join(labels)}; they must be {' and '.join(wanted)}. "
            "Rename them with `system.update_names(inputs=...)`."
        )
    output = K.output_labels[0]
    known = _INPUTS.get(name, f"{name}_input")
    if not output.startswith("y[") and output not in (known, f"{name}_input"):
        raise SettingsError(f"the output of the controller of {name} is {output}; it must be {known}.")
    system = to_state_space(K)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C, system.D))
    Br, By = B[:, order[:1]], B[:, order[1:]]
    Dr, Dy = float(D[0, order[0]]), float(D[0, order[1]])
    return AxisController(A=A, Br=Br, By=By, C=C, Dr=Dr, Dy=Dy, L=conditioning_gain(A, Br, C, Dr))


def _law(K: Any, names: Sequence[str]) -> tuple[Matrix, ...]:
    """Return A, Br, By, C, Dr, Dy and the conditioning L of a system of all outputs."""

    m, labels = len(names), list(K.input_labels)
    wanted = [*(f"{name}_reference" for name in names), *names]
    system = to_state_space(K)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C, system.D))
    if K.ninputs == m:
        Br, By, Dr, Dy = B, -B, D, -D
    else:
        if set(labels) == set(wanted):
            order = [labels.index(label) for label in wanted]
        elif all(label.startswith("u[") for label in labels):
            order = list(range(2 * m))
        else:
            raise SettingsError(f"the inputs of the controller are {', '.join(labels)}; name them {', '.join(wanted)}.")
        B, D = B[:, order], D[:, order]
        Br, By, Dr, Dy = B[:, :m], B[:, m:], D[:, :m], D[:, m:]
    return A, Br, By, C, Dr, Dy, innovations_gain(A, Br, C, Dr)
