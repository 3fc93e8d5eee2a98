"""Parts that step together, whatever they are: a system that need not be a closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from softneck.core import require_one_of, require_positive
from softneck.core._shown import Shown
from softneck.robot import Robot

from ._faults import Fault
from ._loop import ORDERS
from ._part import Part
from ._wiring import Link


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class System(Shown):
    """Parts and their connections; nothing is connected by name, and no part must be a plant or a controller.

    Attributes:
        parts: by name.
        connections: "part.input" -> "part.output", or a `Link` with factor and offset.
        constants: part -> values of inputs that nobody writes.
        parameters: part -> other values of its parameters.
        duration: [s].
        order: "jacobi" or "sequential", as of a `Loop`.
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
        """Return nothing: faults act on the sensor and the motors of a plant."""
        return ()

    def close(self) -> None:
        """Release what the parts hold, such as loaded FMUs."""
        for part in self.parts.values():
            part.close()
