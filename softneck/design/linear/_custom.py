"""A controller of one's own, made with python-control, on the neck's limits, conditioning and allocation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softneck.core import DataError, SettingsError

from ..plants._uncertain import UncertainAxis, UncertainPlant
from ._assembly import AxisController
from ._axis_loop import conditioning_gain, error_feedback
from ._axis_settings import AxisDesign, AxisSettings
from ._controller import LinearController

_INPUTS = {"pitch": "theta_i", "roll": "phi_i"}


@dataclass(frozen=True, slots=True, kw_only=True)
class CustomSettings(AxisSettings):
    """A discrete `control` system as the controller of each axis; limits, filter and verification are as everywhere.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        controller: K of `v = K (r - y)`, or a system of two inputs, reference and angle, `v = K (r, y)`; one for
            both axes, or a mapping of "pitch" and "roll" (or another robot's outputs) to one each. Inputs named
            `pitch_reference` and `pitch` are found by name, in any order.
    """

    KIND: ClassVar[str] = "custom"

    controller: Any = None

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        for system in self.controller.values() if isinstance(self.controller, Mapping) else (self.controller,):
            _require_system(system)

    def _designed(self, uncertain: UncertainPlant) -> LinearController:
        names = uncertain.names
        if isinstance(self.controller, Mapping) and set(self.controller) != set(names):
            given = ", ".join(map(str, self.controller)) or "none"
            raise SettingsError(f"`controller` must be given for {' and '.join(names)}; got {given}.")
        return AxisSettings._designed(self, uncertain)

    def _of(self, name: str) -> Any:
        return self.controller[name] if isinstance(self.controller, Mapping) else self.controller

    def _shared(self) -> bool:
        return not isinstance(self.controller, Mapping)

    def _stored(self) -> dict[str, Any]:
        stored = AxisSettings._stored(self)
        return {key: value for key, value in stored.items() if key != "controller"}

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:
        import control

        K = self._of(name)
        if not math.isclose(float(K.dt), axis.sample_time, rel_tol=1e-9):
            raise SettingsError(
                f"the controller runs every {K.dt:g} s, the plant every {axis.sample_time:g} s; design it at "
                f"{axis.sample_time:g} s, or identify the plant at {K.dt:g} s."
            )
        made = error_feedback(control.ss(K)) if K.ninputs == 1 else _of_two(K, name)
        return AxisDesign(made, {}, {"imported": True})


def _require_system(K: Any) -> None:
    import control

    if not isinstance(K, control.StateSpace | control.TransferFunction):
        raise SettingsError(f"`controller` must be a control.StateSpace or TransferFunction; got {type(K).__name__}.")
    if K.noutputs != 1 or K.ninputs not in (1, 2):
        raise SettingsError(
            f"`controller` must have one output and one or two inputs for each axis; got {K.noutputs} and "
            f"{K.ninputs}. Give {{'pitch': ..., 'roll': ...}}."
        )
    if K.dt is None or isinstance(K.dt, bool) or not K.dt > 0.0:
        raise SettingsError(
            f"`controller` must be discrete, its dt is {K.dt}; use control.sample_system(K, 0.02, 'tustin')."
        )
    system: Any = control.ss(K)
    if not all(np.isfinite(np.asarray(part)).all() for part in (system.A, system.B, system.C, system.D)):
        raise DataError("`controller` has entries that are not finite.")


def _of_two(K: Any, name: str) -> AxisController:
    """Return the axis of a system from reference and angle, found by name where it has names."""
    import control

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
    system: Any = control.ss(K)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C, system.D))
    Br, By = B[:, order[:1]], B[:, order[1:]]
    Dr, Dy = float(D[0, order[0]]), float(D[0, order[1]])
    return AxisController(A=A, Br=Br, By=By, C=C, Dr=Dr, Dy=Dy, L=conditioning_gain(A, Br, C, Dr))
