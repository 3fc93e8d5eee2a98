"""What a loop steps: anything with ports, `start`, `advance` and `close`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from softneck.core import Vector
from softneck.runtime import Block, Port, load_runtime


class Part(Protocol):
    """One participant of a loop; `softneck.cosim.FmuPart` is one, and so is `BlockPart`.

    Attributes:
        inputs, outputs: the ports, in the order of the vectors.
        sample_time: [s].
        role: "plant", "observer", "controller" or "reference".
    """

    @property
    def inputs(self) -> tuple[Port, ...]: ...
    @property
    def outputs(self) -> tuple[Port, ...]: ...
    @property
    def sample_time(self) -> float: ...
    @property
    def role(self) -> str: ...

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Begin a run at `time` [s] and return the outputs (n_out,) there; may be called again after `close`."""
        ...

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step one sample from `time` [s] with `inputs` (n_in,) and return the outputs (n_out,).

        Those of a plant are valid one sample later, those of all others at `time`.
        """
        ...

    def close(self) -> None:
        """Release what `start` took."""
        ...


class BlockPart:
    """A `Block` as a part: its runtime stepped in place, without a copy of the state for each sample."""

    def __init__(self, block: Block) -> None:
        """Adapt `block`; the state comes with `start`."""
        self.block = block
        self.inputs = block.inputs
        self.outputs = block.outputs
        self.sample_time = block.sample_time
        self.role = block.role
        self._step = load_runtime(block.runtime).step
        self._parameters = self._state = self._outputs = np.zeros(0)

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:  # noqa: ARG002 - blocks know no absolute time
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        state = self.block.initial_state(**parameters)
        self._parameters, self._state = state.parameters, state.values.copy()
        self._outputs = state.outputs.copy()
        return self._outputs.copy()

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the outputs."""
        return self.step(time, inputs).copy()

    def step(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002
        """Step once and return the outputs where the next step changes them."""
        self._step(self.block.arrays, self._parameters, self._state, inputs, self._outputs)
        return self._outputs

    def close(self) -> None:
        """Do nothing: a block holds nothing but memory."""

    @property
    def memory(self) -> tuple[Vector, Vector, Vector]:
        """Parameters, state and outputs, as the runtime changes them in place."""
        return self._parameters, self._state, self._outputs
