"""The unscented filter as a part of a loop."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import DataError, SettingsError, Vector
from softneck.runtime import Port

from ._kalman import observer_ports
from ._ukf import UkfObserver


class UkfPart:
    """An unscented filter that `softneck.loop.Loop` steps as its observer; a `softneck.loop.Part`."""

    role = "observer"

    def __init__(self, observer: UkfObserver) -> None:
        """Adapt `observer`; the state comes with `start`."""
        self.observer = observer
        self.inputs: tuple[Port, ...]
        self.outputs: tuple[Port, ...]
        self.inputs, self.outputs = observer_ports("model", observer.robot)
        self.sample_time = observer.sample_time
        self._state = observer.initial_state()

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:  # noqa: ARG002 - it knows no absolute time
        """Return the outputs at the start.

        Raises:
            SettingsError: any parameter: the noise levels are those of its settings.
        """
        if parameters:
            raise SettingsError(f"`{next(iter(parameters))}` is not a parameter of an unscented filter; it has none.")
        self._state = self.observer.initial_state()
        return self._state.outputs.copy()

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002
        """Step once and return the outputs."""
        self._state, outputs = self.observer.step(self._state, inputs)
        return outputs.copy()

    def close(self) -> None:
        """Do nothing: it holds nothing but memory."""

    def get_state(self) -> bytes:
        """Return the numbers of the state, to the bit."""
        return self._state.values.astype("<f8").tobytes()

    def set_state(self, state: bytes) -> None:
        """Go on from what `get_state` returned; raise DataError if it is of another filter."""
        values = np.frombuffer(state, dtype="<f8")
        if values.size != self._state.values.size:
            raise DataError(f"the state has {values.size} values, this filter's {self._state.values.size}.")
        self._state = type(self._state)(values.copy(), self._state.parameters, self._state.outputs)
