"""The nonlinear predictive controller as a part of a loop."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping

import numpy as np

from softneck.core import DataError, Vector

from ._nmpc_prepared import NonlinearController
from ._nonlinear_solver import SampleSolution


class NmpcPart:
    """A nonlinear predictive controller that a loop steps; a `softneck.loop.Part`."""

    role = "controller"

    def __init__(self, controller: NonlinearController) -> None:
        """Adapt `controller`; the state comes with `start`."""
        self.controller = controller
        self.inputs, self.outputs = controller.inputs, controller.outputs
        self.sample_time = controller.sample_time
        self.took = math.nan
        self._values = self._parameters = np.zeros(0)

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:  # noqa: ARG002 - it knows no absolute time
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        state = self.controller.initial_state(**parameters)
        self._values, self._parameters = state.values, state.parameters
        return np.zeros(3)

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        self._values, outputs = self.controller.solver.step(self._values, self._parameters, inputs)
        self.took = clock.perf_counter() - begin
        return outputs

    @property
    def info(self) -> SampleSolution:
        """What the last sample decided; `took` is how long it took [s]."""
        return self.controller.solver.row(self._values)

    def close(self) -> None:
        """Do nothing: it holds nothing but memory."""

    def get_state(self) -> bytes:
        """Return the numbers of the state, to the bit."""
        return self._values.astype("<f8").tobytes()

    def set_state(self, state: bytes) -> None:
        """Go on from what `get_state` returned; raise DataError if it is of another controller."""
        values = np.frombuffer(state, dtype="<f8")
        if values.size != self._values.size:
            raise DataError(f"the state has {values.size} values, this controller's {self._values.size}.")
        self._values = values.copy()
