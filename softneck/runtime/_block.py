"""Blocks: discrete-time systems with ports and a state, shared by loops, FMUs and simulations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Matrix, ReprMixin, SettingsError, Vector

from ._compile import Runtime, load_runtime


@dataclass(frozen=True, slots=True, kw_only=True)
class Port:
    """One named scalar of a block.

    Attributes:
        name: FMI variable name.
        unit: SI unit ("rad", "N", ...), "1" for none.
        description: one line.
        start: value before anything is set.
        minimum, maximum, nominal: as in FMI; None where there is none.
        boolean: a Boolean, carried as 0.0 or 1.0.
        integer: a whole number; Int32 in FMI 3.0, Integer in FMI 2.0.
        missing: NaN is allowed and means "not measured".
        tunable: a parameter that may change during a run.
        display_unit: unit in tools; "": the usual one for `unit`.
    """

    name: str
    unit: str = "1"
    description: str = ""
    start: float = 0.0
    minimum: float | None = None
    maximum: float | None = None
    nominal: float | None = None
    boolean: bool = False
    integer: bool = False
    missing: bool = False
    tunable: bool = False
    display_unit: str = ""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class State(ReprMixin):
    """The state of a block at one instant.

    Attributes:
        values: (n_state,) the state vector: delays, filters, random generator.
        parameters: (n_parameter,) in the order of the block's parameters.
        outputs: (n_out,) the outputs at the instant of this state.
    """

    values: Vector
    parameters: Vector
    outputs: Vector


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Block(ReprMixin):
    """A discrete-time system with named ports, described by a runtime module and its arrays.

    A plant's `step` holds the inputs over [t_k, t_k+1) and returns the outputs at t_k+1; that of an
    observer, controller or reference returns the outputs at t_k (docs, "Timing").

    Attributes:
        kind: name in the table of kinds, or "virtual_neck".
        role: "plant", "observer", "controller" or "reference".
        runtime: dotted name of the runtime module.
        sample_time: [s].
        arrays: data of the runtime, float64.
        inputs, outputs, parameters: the ports, in the runtime's order.
    """

    kind: str
    role: str
    runtime: str
    sample_time: float
    arrays: tuple[Matrix, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    parameters: tuple[Port, ...] = ()

    def __post_init__(self) -> None:
        arrays = tuple(np.ascontiguousarray(array, dtype=np.float64) for array in self.arrays)
        object.__setattr__(self, "arrays", arrays)

    def in_header(self) -> dict[str, Any]:
        """Return what the header of its file says of it."""
        return {
            "kind": self.kind,
            "sample_time": self.sample_time,
            "inputs": [port.name for port in self.inputs],
            "outputs": [port.name for port in self.outputs],
            "units": {port.name: port.unit for port in (*self.inputs, *self.outputs)},
        }

    def initial_state(self, **parameters: float) -> State:
        """Return the state at t_0, with its outputs; `parameters` override start values by name.

        Raises:
            SettingsError: a parameter that the block does not have, or one outside its range.
        """
        q = np.array([port.start for port in self.parameters])
        names = [port.name for port in self.parameters]
        for name, value in parameters.items():
            if name not in names:
                raise SettingsError(f"`{name}` is not a parameter of {self.kind}; it has {', '.join(names) or 'none'}.")
            q[names.index(name)] = _in_range(self.parameters[names.index(name)], value)
        runtime = self._runtime
        x, y = np.zeros(runtime.state_size(self.arrays)), np.zeros(len(self.outputs))
        runtime.initialise(self.arrays, q, x, y)
        return State(x, q, y)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the state one sample later and the outputs (n_out,); `inputs` is (n_in,) in port order.

        Raises:
            DataError: wrong number of inputs, or a NaN where none is allowed.
        """
        u = np.ascontiguousarray(inputs, dtype=np.float64)
        # Ports are looked at one by one only where a number is not finite.
        if u.shape != (len(self.inputs),) or not all(map(math.isfinite, u.tolist())):
            u = self.checked_inputs(u[None])[0]
        x, y = state.values.copy(), np.zeros(len(self.outputs))
        self._runtime.step(self.arrays, state.parameters, x, u, y)
        return State(x, state.parameters, y), y

    def run(self, state: State, inputs: Matrix) -> tuple[State, Matrix]:
        """Step once for each row of `inputs` (time, n_in); return the last state and the outputs (time, n_out)."""
        U = self.checked_inputs(inputs)
        x, Y = state.values.copy(), np.zeros((U.shape[0], len(self.outputs)))
        self._runtime.run_steps(self.arrays, state.parameters, x, U, Y)
        return State(x, state.parameters, Y[-1].copy() if len(Y) else state.outputs), Y

    def run_horizon(self, state: State, measured: Matrix, free: Matrix, horizon: int) -> Matrix:
        """Predict `horizon` steps ahead from every row; row k of the result is for t_k+1.

        `measured` and `free` are (time, n_in): the inputs with and without the measured outputs.
        """
        M, F = self.checked_inputs(measured), self.checked_inputs(free)
        Y = np.zeros((M.shape[0], len(self.outputs)))
        self._runtime.run_horizon(self.arrays, state.parameters, state.values.copy(), M, F, horizon, Y)
        return Y

    def checked_inputs(self, inputs: Matrix) -> Matrix:
        """Return `inputs` (time, n_in) as a contiguous float array; raise DataError naming the wrong input."""
        U = np.ascontiguousarray(inputs, dtype=np.float64)
        if U.ndim != 2 or U.shape[1] != len(self.inputs):
            names = ", ".join(port.name for port in self.inputs)
            raise DataError(f"{self.kind} takes {len(self.inputs)} inputs ({names}); got shape {U.shape}.")
        if np.isfinite(U).all():
            return U
        for port, column in zip(self.inputs, U.T, strict=True):
            bad = np.isinf(column) if port.missing else ~np.isfinite(column)
            if bad.any():
                row = int(np.argmax(bad))
                raise DataError(f"input `{port.name}` of {self.kind} is {column[row]} at row {row}; it must be finite.")
        return U

    @property
    def _runtime(self) -> Runtime:
        return load_runtime(self.runtime)


class SteppedMixin:
    """Mixin of what has a `block()`: it steps as its block does."""

    __slots__ = ()

    def block(self) -> Block:
        """Return the block that is stepped."""
        raise NotImplementedError

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; parameters by their names in `block()`."""
        return self.block().initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the outputs valid now; inputs and outputs as in `block()`.

        Raises DataError: wrong number of inputs, or one that is not finite.
        """
        return self.block().step(state, inputs)


def _in_range(port: Port, value: Any) -> float:
    number = float(value)
    low = -np.inf if port.minimum is None else port.minimum
    high = np.inf if port.maximum is None else port.maximum
    if not low <= number <= high:
        raise SettingsError(f"`{port.name}` must be between {low:g} and {high:g} [{port.unit}]; got {number:g}.")
    return number
