"""The linear predictive controller as a part of a loop: watched, and solved by daqp where asked."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from softneck.core import Vector, require_one_of
from softneck.loop import BlockPart
from softneck.runtime import Block, load_functions

from . import _mpc_state_runtime as rt
from ._program import MpcInfo, MpcProgram, explain


class MpcPart(BlockPart):
    """A predictive controller that a loop steps; a `softneck.loop.Part` with `info` of its last sample."""

    def __init__(self, controller: Block, *, solver: str = "own") -> None:
        """Adapt a controller's block; `solver` is "own" (the block's) or "daqp"."""
        require_one_of("solver", solver, ("own", "daqp"))
        super().__init__(controller)
        self._program = MpcProgram(controller.arrays) if solver == "daqp" else None
        self._functions = load_functions(controller.runtime)
        self._at = rt.MpcState.parts(rt.MpcArrays(controller.arrays))
        outputs = rt.MpcArrays(controller.arrays).T.shape[0] - 1
        self._names = tuple(port.name.removesuffix("_reference") for port in controller.inputs[:outputs])
        self._took = math.nan

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        outputs = super().advance(time, inputs) if self._program is None else self._with_daqp(self._program, inputs)
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

    def _with_daqp(self, program: MpcProgram, inputs: Vector) -> Vector:
        """Do what the runtime's `step` does, with another solver in its middle."""
        f, arrays, state, parameters = self._functions, self.block.arrays, self._state, self._parameters
        u = f.mpc_inputs(arrays, inputs)
        if f.mpc_begin(arrays, state, u):
            m, count = program.E.shape
            theta, lower, upper = np.empty(count), np.empty(m), np.empty(m)
            f.mpc_parameter(arrays, state, theta)
            limits, first = f.mpc_limits(arrays, state, parameters), 2 * len(self._names) + 1
            f.mpc_bounds(arrays, limits, u[first : first + self._outputs.size], theta, lower, upper)
            z, flag, lam = program.solve(theta, lower, upper)
            f.mpc_take(arrays, state, theta, z, lam, lower, upper, flag > 0)
            state[self._at["iterations"]] = program.iterations
            f.mpc_move(arrays, state, lower, upper, limits[0])
        f.mpc_predict(arrays, state)
        f.mpc_give(arrays, state, self._outputs)
        return self._outputs.copy()

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        self._took = math.nan
        return super().start(time, parameters)
