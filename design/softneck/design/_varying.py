"""Controllers whose gains vary as they run - scheduled or adaptive - in loops, FMUs and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import Block, FileFormatError, Matrix, Port, State, Vector, require_between, write_archive

from ._ports import MAX_MOTOR, MAX_SLEW, controller_inputs, controller_outputs, limit_ports, require_taut, taut_lines


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What set-points may do; the runtime shares each limit among the motors.

    Attributes:
        position_limit: of each motor [rad].
        slew_limit: of each motor [rad/s]; the default is 0.25 rad in 20 ms.
        lead_limit: how far a set-point may be from its motor [rad].
        least_position: no motor is let out below this [rad], co-contraction is raised instead; -6 for no such rule.
        least_cocontraction: the co-contraction reference is at least this [rad]; -6 for no such rule.
    """

    position_limit: float = MAX_MOTOR
    slew_limit: float = 12.5
    lead_limit: float = 0.8
    least_position: float = -MAX_MOTOR
    least_cocontraction: float = -MAX_MOTOR

    def __post_init__(self) -> None:
        require_between("position_limit", self.position_limit, 0.01, MAX_MOTOR, "rad")
        require_between("slew_limit", self.slew_limit, 0.01, MAX_SLEW, "rad/s")
        require_between("lead_limit", self.lead_limit, 0.01, 2.0 * MAX_MOTOR, "rad")
        require_taut(self.least_position, self.least_cocontraction, self.position_limit)

    def ports(self) -> tuple[Port, ...]:
        """Return them as parameters of a block."""
        return limit_ports(
            (self.position_limit, self.slew_limit, self.lead_limit, self.least_position, self.least_cocontraction)
        )

    def lines(self, sample_time: float) -> list[str]:
        """Return some lines for people."""
        return [
            f"  limits: |P| <= {self.position_limit:g} rad, slew {self.slew_limit:g} rad/s "
            f"({self.slew_limit * sample_time:g} rad per sample), lead {self.lead_limit:g} rad before the motors",
            *taut_lines(self.least_position, self.least_cocontraction),
        ]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class VaryingController:
    """A designed controller of pitch and roll whose gains follow the inclination or what it learns.

    Attributes:
        kind: "scheduled" or "adaptive".
        runtime: dotted name of the runtime module, which says what `arrays` are.
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
    limits: Limits
    order: str
    parameters: tuple[Port, ...] = ()
    lines: tuple[str, ...] = ()
    design: Mapping[str, Any] = field(default_factory=dict)

    def block(self) -> Block:
        """Return the controller as a block of role "controller"."""
        return Block(
            kind=self.kind,
            role="controller",
            runtime=self.runtime,
            sample_time=self.sample_time,
            arrays=tuple(self.arrays.values()),
            inputs=controller_inputs(),
            outputs=controller_outputs(),
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
            "limits": asdict(self.limits),
            "order": self.order,
            "names": list(self.arrays),
            "parameters": [asdict(port) for port in self.parameters],
            "lines": list(self.lines),
            "design": dict(self.design),
            "inputs": [port.name for port in block.inputs],
            "outputs": [port.name for port in block.outputs],
            "units": {port.name: port.unit for port in (*block.inputs, *block.outputs)},
        }
        write_archive(path, header, self.arrays, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> VaryingController:
        """Return the controller that `save` wrote; `softneck.core.load` calls this."""
        kind = str(header["kind"])
        read = {str(name): np.ascontiguousarray(arrays[name], dtype=np.float64) for name in header["names"]}
        if not all(np.isfinite(array).all() for array in read.values()) or not _fits(kind, read):
            raise FileFormatError("the controller's arrays have wrong shapes or are not finite; design it again.")
        return cls(
            kind=kind,
            runtime=RUNTIMES[kind],
            sample_time=float(header["sample_time"]),
            arrays=read,
            limits=Limits(**header["limits"]),
            order=str(header["order"]),
            parameters=tuple(Port(**port) for port in header["parameters"]),
            lines=tuple(str(line) for line in header["lines"]),
            design=dict(header["design"]),
        )


RUNTIMES = {
    "scheduled": "softneck.design._scheduled_runtime",
    "adaptive": "softneck.design._adaptive_runtime",
}


def _fits(kind: str, arrays: Mapping[str, np.ndarray]) -> bool:
    """Return whether the arrays fit each other as the runtime of `kind` reads them."""
    expected = _scheduled_shapes(arrays) if kind == "scheduled" else _adaptive_shapes(arrays)
    return {name: array.shape for name, array in arrays.items()} == expected


def _filter_shapes(f: int) -> dict[str, tuple[int, ...]]:
    return {"Af": (f, f), "Bf": (f, 3), "Cf": (3, f), "Df": (3, 3)}


def _scheduled_shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    f, n, m = arrays["Af"].shape[0], arrays["A"].shape[1], arrays["knots"].size
    return _filter_shapes(f) | {
        "A": (m * n, n), "Br": (m * n, 2), "By": (m * n, 2), "C": (m * 2, n), "Dr": (m * 2, 2), "Dy": (m * 2, 2),
        "L": (m * n, 2), "align": (m * n, 4), "rest": (f, 3), "T": (3, 3), "T_inverse": (3, 3), "constants": (1,),
        "knots": (m,), "memory": (1,),
    }  # fmt: skip


def _adaptive_shapes(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[int, ...]]:
    f = arrays["Af"].shape[0]
    return _filter_shapes(f) | {
        "rest": (f, 3), "T": (3, 3), "T_inverse": (3, 3), "constants": (1,), "nominal": (2, 2), "box": (2, 4),
        "delays": (2,), "loop": (2,), "guards": arrays["guards"].shape,
    }  # fmt: skip
