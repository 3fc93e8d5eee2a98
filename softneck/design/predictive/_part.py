"""The linear predictive controller as a part of a loop that is watched."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import replace

from softneck.core import Vector
from softneck.loop import BlockPart
from softneck.runtime import Block

from . import _mpc_state_runtime as rt
from ._program import MpcInfo, explain


class MpcPart(BlockPart):
    """A predictive controller that a loop steps; a `softneck.loop.Part` with `info` of its last sample."""

    def __init__(self, controller: Block) -> None:
        """Adapt a controller's block."""
        super().__init__(controller)
        self._at = rt.MpcState.parts(rt.MpcArrays(controller.arrays))
        outputs = rt.MpcArrays(controller.arrays).T.shape[0] - 1
        self._names = tuple(port.name.removesuffix("_reference") for port in controller.inputs[:outputs])
        self._took = math.nan

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        outputs = super().advance(time, inputs)
        self._took = clock.perf_counter() - begin
        return outputs

    @property
    def info(self) -> MpcInfo:
        """What the last sample decided, and how long it took."""
        return replace(explain(self.block.arrays, self._state, self._names), time=self._took)

    @property
    def counts(self) -> dict[str, int]:
        """Samples since the start on which the previous plan went on, and on which a soft limit was not kept."""
        return {
            "previous_plan": int(self._state[self._at["shifted"]].item()),
            "softened": int(self._state[self._at["softened"]].item()),
        }

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        self._took = math.nan
        return super().start(time, parameters)
