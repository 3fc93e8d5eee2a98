"""A reference that is known ahead: what a controller with preview reads."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import DataError, SettingsError, Vector, require_positive
from softneck.runtime import Port

from ._references import Reference
from ._wiring import REFERENCE_PORTS

_AHEAD_PORTS = tuple(
    Port(name=f"{axis}_reference_ahead", unit="rad", description=f"wanted {axis}, `ahead` from now")
    for axis in ("pitch", "roll")
)


class AheadReference:
    """A reference as a part that also tells what it will be `ahead` later; a `softneck.loop.Part`."""

    role = "reference"

    def __init__(self, reference: Reference, ahead: float, *, sample_time: float = 0.02) -> None:
        """Adapt `reference`, a function of time; `ahead` [s] is the controller's `preview`."""
        require_positive("ahead", ahead, "s")
        require_positive("sample_time", sample_time, "s")
        self.reference, self.ahead, self.sample_time = reference, ahead, sample_time
        self.inputs: tuple[Port, ...] = ()
        self.outputs: tuple[Port, ...] = (*REFERENCE_PORTS, *_AHEAD_PORTS)

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return what holds at `time` [s]; it has no parameters."""
        if parameters:
            raise SettingsError(f"`{next(iter(parameters))}` is not a parameter of a reference ahead; it has none.")
        return self._at(time)

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002 - it has none
        """Return what holds one sample after `time` [s]."""
        return self._at(time + self.sample_time)

    def close(self) -> None:
        """Do nothing: it holds nothing."""

    def get_state(self) -> bytes:
        """Return nothing: a function of time remembers nothing."""
        return b""

    def set_state(self, state: bytes) -> None:
        """Take nothing; raise DataError for the state of something else."""
        if state:
            raise DataError("a reference ahead has no state; this one is of another part.")

    def _at(self, time: float) -> Vector:
        return np.array([*self.reference(time), 1.0, *self.reference(time + self.ahead)[:2]])
