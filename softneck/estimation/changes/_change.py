"""The change detector: a model in free run beside the loop, and what it says of the neck."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import FileFormatError, Matrix, Vector, to_si, write_archive
from softneck.core._shown import Shown
from softneck.identification import Model
from softneck.identification.models._arrays import without_validity
from softneck.identification.models._directions import NECK_SECONDS
from softneck.identification.models._nested import nested, nested_model
from softneck.identification.models._ports import payloads
from softneck.robot import Robot
from softneck.runtime import Block, Port, State, load_runtime
from softneck.signals import Recording

from .._kalman import observer_ports
from .._kalman_parts_runtime import KALMAN_LAG, KALMAN_MORE_LAGS
from .._nonlinear import model_setup
from .._offline import measured_angles
from ._change_parts_runtime import ChangeArrays
from ._change_runtime import ChangeState
from ._payload_change_runtime import PayloadChangeArrays, PayloadChangeState

_RUNTIME = "softneck.estimation.changes._change_runtime"
# Over a model that takes the payload as a parameter.
_PAYLOAD_RUNTIME = "softneck.estimation.changes._payload_change_runtime"
KIND = "change"
#: What undisturbed motion says of a model.
NAMES = ("spread", "thresholds", "chart")
#: How payloads are weighed, over a model of several.
BANK = ("bank", "telling")
_OUTPUTS = (
    Port(name="changed", description="the neck is not the one that the model was identified from", boolean=True),
    Port(name="since_s", unit="s", description="time since that was found; 0 while it is not", minimum=0.0),
    Port(name="fit", description="NRMSE fit of the model's free run of late in %, -100 at the least", minimum=-100.0,
         maximum=100.0),
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ChangeDetector(Shown):
    """Says whether the neck is still the one that the model was identified from; `ChangeSettings.design` makes it.

    Over a model of several payloads with `BANK`, it tells the payload as well, and `changed` says that none explains
    the neck.

    Attributes:
        model: of any kind; nothing corrects its state.
        arrays: see `ChangeArrays`, those of `NAMES`; of `BANK` as well where the payload is told.
        order: of the loop it is for.
        findings: what the undisturbed motion was.
    """

    model: Model
    arrays: Mapping[str, Matrix]
    order: str = "sequential"
    findings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def robot(self) -> Robot:
        """Whose outputs it watches."""
        return self.model.robot

    @property
    def sample_time(self) -> float:
        """Of the model and of the loop [s]."""
        return self.model.sample_time

    @property
    def stretch(self) -> float:
        """By how much the robot is slower than a neck."""
        return max(self.model.findings.get("time_constants_s", [NECK_SECONDS])) / NECK_SECONDS

    def block(self) -> Block:
        """Return it as a block of role "observer"."""
        return self._block

    @cached_property
    def _block(self) -> Block:
        plant = replace(self.model, arrays=without_validity(self.model.arrays)).block()
        inputs, _ = observer_ports("nonlinear", self.robot)
        ports = _payload_ports(self.payloads)
        constants = np.zeros(KALMAN_MORE_LAGS)
        constants[KALMAN_LAG] = 1.0 if self.order == "jacobi" else 0.0
        own = (model_setup(self.robot, plant, self.sample_time, self.stretch, 0.0), constants,
               plant.initial_state(use_measurement=0.0).parameters)  # fmt: skip
        return Block(
            kind=KIND,
            role="observer",
            runtime=f"{_PAYLOAD_RUNTIME if ports else _RUNTIME}({plant.runtime}:{len(plant.arrays)})",
            sample_time=self.sample_time,
            arrays=(*own, *(self.arrays[name] for name in self.names), *plant.arrays),
            inputs=inputs,
            outputs=(*_OUTPUTS, *ports[:1]),
            parameters=ports[1:],
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its arrays."""
        return (*NAMES, *BANK) if BANK[0] in self.arrays else NAMES

    @property
    def payloads(self) -> tuple[float, float] | None:
        """Least and most payload [kg] that it tells; None where it tells none."""
        return payloads(self.model.arrays) if BANK[0] in self.arrays else None

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; the payload then is a parameter of a detector that tells it."""
        return self.block().initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the outputs valid now; inputs and outputs as in `block()`."""
        return self.block().step(state, inputs)

    def watch(self, recording: Recording, **parameters: float) -> Matrix:
        """Return `changed`, `since_s` and `fit`, and the payload if it is told, at each row; each run starts anew.

        Raises:
            DataError: another sample time or another robot.
        """
        self.model.check(recording)
        start = self.initial_state(**parameters)
        return np.concatenate([self.block().run(start, self.rows(run))[1] for run in recording.runs()])

    def rows(self, run: Recording) -> Matrix:
        """Return the inputs (time, inputs) that a run gives."""
        # As for an observer: the set-points of t_k are commanded after the measurement of t_k.
        late = 0 if self.order == "jacobi" else 1
        asked = run.set_points[np.maximum(np.arange(len(run)) - late, 0)]
        return np.column_stack([asked, measured_angles(run), np.ones(len(run))])

    def states(self, run: Recording, **parameters: float) -> dict[str, Matrix]:
        """Return the parts of the state after each row of a run."""
        block, state = self.block(), self.initial_state(**parameters)
        step, x, outputs = load_runtime(block.runtime).step, state.values, state.outputs
        if self.payloads is None:
            parts = ChangeState.parts(ChangeArrays(block.arrays))
        else:
            parts = PayloadChangeState.parts(PayloadChangeArrays(block.arrays))
        *_, last = parts
        own = slice(0, parts[last].start)
        kept = np.empty((len(run), own.stop))
        for row, inputs in zip(kept, block.checked_inputs(self.rows(run)), strict=True):
            step(block.arrays, state.parameters, x, inputs, outputs)
            row[:] = x[own]
        return {name: kept[:, part] for name, part in parts.items() if name != last}

    def summary(self) -> str:
        """Return some lines for people."""
        unit = self.robot.outputs.display_unit
        rest = np.sqrt(self.arrays["spread"][:, 0]) / to_si(unit)[0]
        seconds = self.arrays["chart"][0] * self.sample_time
        lines = [
            f"change detector over {self.model.kind}, {self.sample_time * 1e3:g} ms, {self.order} order",
            f"  at rest the model misses {', '.join(f'{value:.3g}' for value in rest)} {unit}; averaged over "
            f"{seconds:.3g} s, cumulative sums beyond {', '.join(f'{h:.3g}' for h in self.arrays['thresholds'])}",
        ]
        if self.payloads is not None:
            least, most = self.payloads
            lines.append(f"  it tells the payload, from {least:g} to {most:g} kg, while the neck moves")
            if self.findings.get("alike_kg"):
                alike = ", ".join(f"{kg:g}" for kg in self.findings["alike_kg"])
                lines.append(f"  what the model misses looks like {alike} kg: none of these alone has it told anew")
        if "seconds" in self.findings:
            lines.append(
                f"  from {self.findings['seconds']:.3g} s of undisturbed motion, a false alarm in "
                f"{self.findings['hours']:g} h"
            )
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the detector with its model to one `.npz` file."""
        block, (model, arrays) = self.block(), nested(self.model)
        header = {
            "kind": KIND,
            "sample_time": self.sample_time,
            "order": self.order,
            "inputs": [port.name for port in block.inputs],
            "outputs": [port.name for port in block.outputs],
            "units": {port.name: port.unit for port in (*block.inputs, *block.outputs)},
            "findings": dict(self.findings),
            "model": model,
            **self.robot.in_header(),
        }
        write_archive(path, header, {**arrays, **self.arrays}, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> ChangeDetector:
        """Return the detector that `save` wrote; `softneck.core.load` calls this."""
        if BANK[0] in arrays and BANK[1] not in arrays:
            raise FileFormatError(
                "it has no thresholds for what tells the payload (an older version); design it again."
            )
        found = cls(
            model=nested_model(header["model"], arrays),
            arrays={
                name: np.ascontiguousarray(arrays[name], dtype=np.float64) for name in (*NAMES, *BANK) if name in arrays
            },
            order=str(header["order"]),
            findings=header["findings"],
        )
        names = ("setup", "constants", "free", *found.names)
        declared = ChangeArrays if found.payloads is None else PayloadChangeArrays
        declared.read(dict(zip(names, found.block().arrays, strict=False)))
        return found


def _payload_ports(known: tuple[float, float] | None) -> tuple[Port, ...]:
    """Return the output and, for the start, the parameter of a detector that tells the payload; none of others."""
    if known is None:
        return ()
    told = Port(name="payload", unit="kg", start=known[0], minimum=known[0], maximum=known[1],
                description="that explains the neck best")  # fmt: skip
    return told, replace(told, name="payload_start", description="known at the start")
