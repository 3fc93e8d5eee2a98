"""The nonlinear predictive controller as a part of a loop, and what each of its samples decided."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import dataclass

from softneck.core import Matrix, Vector
from softneck.loop import BlockPart
from softneck.runtime import Block

from ._nmpc_state_runtime import NMPC_NUMBERS, NmpcArrays, NmpcState

_STATUS_NAMES = ("not started", "optimal", "softened", "previous plan", "holding")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SampleSolution:
    """What a sample decided.

    Attributes:
        status: "optimal", "softened", "previous plan", "holding" or "not started".
        iterations: of the QP solver, all Gauss-Newton steps together.
        residual: of the QP's KKT conditions.
        previous_plan, softened: samples so far on which those happened.
        moves: (moves, motors) that are planned next [rad], of another robot in SI.
    """

    status: str
    iterations: int
    residual: float
    previous_plan: int
    softened: int
    moves: Matrix


def explain(block: Block, values: Vector) -> SampleSolution:
    """Return what the sample decided that led a controller's `block` to the state `values`."""
    a = NmpcArrays(block.arrays)
    parts = NmpcState.parts(a)
    # Of another robot the motors' unit, before those of the outputs.
    unit = a.setup[-a.T.shape[0]] if a.setup.size > NMPC_NUMBERS else 1.0
    number = {name: float(values[place.start]) for name, place in parts.items()}
    return SampleSolution(
        status=_STATUS_NAMES[int(number["status"])],
        iterations=int(number["iterations"]),
        residual=number["residual"],
        previous_plan=int(number["shifted"]),
        softened=int(number["softened"]),
        moves=unit * values[parts["plan"]].reshape(-1, a.T.shape[1]),
    )


class NmpcPart(BlockPart):
    """A nonlinear predictive controller that a loop steps; a `softneck.loop.Part` with `info` of its last sample.

    Attributes:
        took: how long the last sample took [s].
    """

    def __init__(self, controller: Block) -> None:
        """Adapt a controller's block; the state comes with `start`."""
        super().__init__(controller)
        self.took = math.nan

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        self.took = math.nan
        return super().start(time, parameters)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        outputs = super().advance(time, inputs)
        self.took = clock.perf_counter() - begin
        return outputs

    @property
    def info(self) -> SampleSolution:
        """What the last sample decided."""
        return explain(self.block, self._state)
