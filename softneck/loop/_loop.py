"""The closed loop: its parts, reference, faults and order; and systems of parts that are no closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np

from softneck.core import ReprMixin, SettingsError, SoftneckError, Vector, require_one_of, require_positive
from softneck.robot import Robot
from softneck.runtime import Block, Port, State, load_runtime

from ._faults import Fault
from ._references import Reference


class EndedError(SoftneckError):
    """A part ended the simulation itself; a loop keeps its rows up to there."""


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
        """Start a run at `time` [s] and return the outputs (n_out,) there; may be called again after `close`."""
        ...

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step one sample from `time` [s] with `inputs` (n_in,) and return the outputs (n_out,).

        Those of a plant are valid one sample later, those of all others at `time`.
        """
        ...

    def close(self) -> None:
        """Release the resources of `start`."""
        ...


def _initial_state(block: Block, parameters: tuple[tuple[str, float], ...]) -> State:
    return block.initial_state(**dict(parameters))


# Of a search and its certificate hundreds of loops start with the same plants and controllers, which settle first.
_kept_state = lru_cache(maxsize=64)(_initial_state)


class BlockPart:
    """A `Block` as a part; its state is stepped in place, without a copy for each sample."""

    def __init__(self, block: Block) -> None:
        """Adapt `block`; `start` makes the state."""
        self.block = block
        self.inputs = block.inputs
        self.outputs = block.outputs
        self.sample_time = block.sample_time
        self.role = block.role
        self._step = load_runtime(block.runtime).step
        self._parameters = self._state = self._outputs = np.zeros(0)

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:  # noqa: ARG002 - blocks know no absolute time
        """Return the outputs at the start; raise SettingsError for unknown parameters."""
        find = _kept_state if load_runtime(self.block.runtime).compiled else _initial_state
        state = find(self.block, tuple(parameters.items()))
        self._parameters, self._state = state.parameters.copy(), state.values.copy()
        self._outputs = state.outputs.copy()
        return self._outputs.copy()

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the outputs."""
        return self.step(time, inputs).copy()

    def step(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002
        """Step once and return the outputs without a copy: the next step changes them."""
        self._step(self.block.arrays, self._parameters, self._state, inputs, self._outputs)
        return self._outputs

    def close(self) -> None:
        """Leave the block as it is: it has only memory."""

    @property
    def memory(self) -> tuple[Vector, Vector, Vector]:
        """Parameters, state and outputs, which the runtime changes in place."""
        return self._parameters, self._state, self._outputs


@dataclass(frozen=True, slots=True)
class Link:
    """A connection factor * value + offset, in place of any conversion of units.

    `origin`: "part.output". `factor`, `offset`: applied to the output's value.
    """

    origin: str
    factor: float = 1.0
    offset: float = 0.0


ORDERS = ("sequential", "jacobi")
PART_NAMES = ("plant", "observer", "controller", "reference")
# Parameter of a controller's FMU: use measured motor positions instead of a model of the drives inside it.
USE_MOTOR_POSITIONS = "use_motor_positions"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Loop(ReprMixin):
    """A closed loop.

    Attributes:
        plant, controller, observer: the parts; without an observer the controller reads the measured outputs.
        reference: a function of time [s] that returns all outputs and co-contraction in SI; or a part of role
            "reference" with these outputs.
        duration: [s].
        order: "sequential" (as on the hardware: plant outputs at t_k, observer, controller, plant) or "jacobi"
            (all inputs first, then all steps: one more sample of delay in observer and controller each).
        plant_parameters, observer_parameters, controller_parameters: values that differ from the defaults, by name.
        plant_inputs: constants for plant inputs such as `payload`.
        faults: applied in this order.
        others: further parts by name, such as a filter; `other_parameters` are their parameters.
        other_inputs: part -> constants for inputs of the observer, the controller or one of the others.
        connections: "part.input" -> "part.output", or a `Link` with factor and offset, for ports with different names.
        robot: that is controlled.
    """

    plant: Part
    controller: Part
    reference: Reference | Part
    duration: float
    observer: Part | None = None
    order: str = "sequential"
    plant_parameters: Mapping[str, float] = field(default_factory=dict)
    observer_parameters: Mapping[str, float] = field(default_factory=dict)
    controller_parameters: Mapping[str, float] = field(default_factory=dict)
    plant_inputs: Mapping[str, float] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    others: Mapping[str, Part] = field(default_factory=dict)
    other_parameters: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    other_inputs: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    connections: Mapping[str, str | Link] = field(default_factory=dict)
    robot: Robot = field(default_factory=Robot.preset)

    def __post_init__(self) -> None:
        require_positive("duration", self.duration, "s")
        require_one_of("order", self.order, ORDERS)
        for name in self.others:
            if name in PART_NAMES or not name.isidentifier():
                raise SettingsError(f"`{name}` cannot be the name of a further part; use letters, digits and _.")

    @property
    def parts(self) -> dict[str, Part]:
        """Return name -> part: plant, observer (if any), controller, the others, and a reference that is a part."""
        parts: dict[str, Part | None] = {"plant": self.plant, "observer": self.observer, "controller": self.controller}
        parts |= dict(self.others)
        if hasattr(self.reference, "advance"):
            parts["reference"] = self.reference  # pyright: ignore[reportArgumentType]
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def parameters(self) -> dict[str, Mapping[str, float]]:
        """Return part -> its parameters; an FMU's `use_motor_positions` is true by default."""
        named = {
            "plant": self.plant_parameters,
            "observer": self.observer_parameters,
            "controller": self.controller_parameters,
        }
        named |= dict(self.other_parameters)
        for name, part in self.parts.items():
            # A loop connects the positions; blocks always use them, FMUs only with this parameter.
            if USE_MOTOR_POSITIONS in {port.name for port in getattr(part, "parameters", ())}:
                named[name] = {USE_MOTOR_POSITIONS: 1.0, **named.get(name, {})}
        return named

    @property
    def constants(self) -> dict[str, Mapping[str, float]]:
        """Return part -> constants for its inputs."""
        return {**self.other_inputs, "plant": self.plant_inputs}

    def close(self) -> None:
        """Release the resources of the parts, such as loaded FMUs."""
        for part in self.parts.values():
            part.close()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class System(ReprMixin):
    """Parts with explicit connections; none of them needs to be a plant or a controller.

    `parts`: by name. `connections`: "part.input" -> "part.output", or a `Link` with factor and offset. `constants`:
    part -> values of inputs that are not connected. `parameters`: part -> values that differ from the defaults.
    `duration`: [s]. `order`: "jacobi" or "sequential", as of a `Loop`.
    """

    parts: Mapping[str, Part]
    connections: Mapping[str, str | Link]
    constants: Mapping[str, Mapping[str, float]]
    duration: float
    parameters: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    order: str = "jacobi"
    robot: Robot = field(default_factory=Robot.preset)

    def __post_init__(self) -> None:
        require_positive("duration", self.duration, "s")
        require_one_of("order", self.order, ORDERS)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Return no faults: they act on sensor and motors of a plant."""
        return ()

    def close(self) -> None:
        """Release the resources of the parts, such as loaded FMUs."""
        for part in self.parts.values():
            part.close()
