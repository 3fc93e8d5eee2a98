"""A controller whose gains vary as it runs, in loops, FMUs and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import Matrix, Vector, write_archive
from softneck.core._shown import Shown
from softneck.robot import Robot
from softneck.runtime import Block, Port, State
from softneck.runtime._bundle import declared, sized
from softneck.runtime._layout import Arrays

from ..linear._controller import robot_in
from ..linear._ports import ControllerLimits, controller_inputs, controller_outputs


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class VaryingController(Shown):
    """A designed controller of pitch and roll whose gains follow what it learns.

    Attributes:
        kind: "adaptive".
        runtime: dotted name of the runtime module, which declares `arrays`.
        sample_time: [s].
        arrays: by name, in the runtime's order.
        limits: of the set-points.
        order: of the loop it is for.
        parameters: more parameters of the block, after the limits.
        lines: for `summary`.
        design: JSON values: settings and what was found.
    """

    kind: str
    runtime: str
    sample_time: float
    arrays: Mapping[str, Matrix]
    limits: ControllerLimits
    order: str
    parameters: tuple[Port, ...] = ()
    lines: tuple[str, ...] = ()
    design: Mapping[str, Any] = field(default_factory=dict)

    @property
    def robot(self) -> Robot:
        """Whose controller it is."""
        return self.limits.robot

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return Block(
            kind=self.kind,
            role="controller",
            runtime=sized(self.runtime, len(self.robot.motors.names), len(self.robot.outputs.names)),
            sample_time=self.sample_time,
            arrays=tuple(self.arrays.values()),
            inputs=controller_inputs(self.robot),
            outputs=controller_outputs(self.robot),
            parameters=(*self.limits.ports(), *self.parameters),
        )

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; parameters are the limits by name."""
        return self.block().initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the set-points valid now; inputs and outputs as in `block()`."""
        return self.block().step(state, inputs)

    def summary(self) -> str:
        """Return some lines for people."""
        head = (
            f"{self.kind} controller, {self.sample_time * 1e3:g} ms, {self.order} order, "
            f"{self.design.get('extra_delay', 0)} samples of delay added to the plant for it"
        )
        return "\n".join([head, *self.limits.lines(self.sample_time), *self.lines])

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the controller to one `.npz` file."""
        block = self.block()
        header = {
            "kind": self.kind,
            "sample_time": self.sample_time,
            "limits": self.limits.header(),
            "order": self.order,
            "names": list(self.arrays),
            # None of them is an integer, and files of format 1 do not say so.
            "parameters": _ports(self.parameters),
            "lines": list(self.lines),
            "design": dict(self.design),
            "inputs": [port.name for port in block.inputs],
            "outputs": [port.name for port in block.outputs],
            "units": {port.name: port.unit for port in (*block.inputs, *block.outputs)},
            **self.robot.in_header(),
        }
        write_archive(path, header, self.arrays, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> VaryingController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        kind = str(header["kind"])
        return cls(
            kind=kind,
            runtime=RUNTIMES[kind],
            sample_time=float(header["sample_time"]),
            arrays=declared(RUNTIMES[kind], Arrays).read(arrays),
            limits=ControllerLimits.from_header(header["limits"], robot_in(header)),
            order=str(header["order"]),
            parameters=tuple(Port(**port) for port in header["parameters"]),
            lines=tuple(str(line) for line in header["lines"]),
            design=dict(header["design"]),
        )


def _ports(ports: tuple[Port, ...]) -> list[dict[str, Any]]:
    return [{k: v for k, v in asdict(port).items() if k not in ("integer", "display_unit")} for port in ports]


RUNTIMES = {
    "adaptive": "softneck.design.varying._adaptive_runtime",
}
