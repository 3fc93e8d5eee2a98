"""What the master asks of observer and controller: a measurement goes in, set-points come out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ._gate import Reading

# One number for each motor.
Motors = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Measurement:
    """What the pilot gets at a sample.

    Attributes:
        index: of the sample, from 0 where the phase `running` begins.
        tilt: last believed sample.
        fresh: whether it is of now.
        positions: of the motors [rad].
    """

    index: int
    tilt: Reading
    fresh: bool
    positions: Motors


class Pilot(Protocol):
    """Observer and controller: what turns measurements into set-points."""

    def start(self) -> None:
        """Begin anew."""
        ...

    def step(self, measured: Measurement) -> Motors | None:
        """Return the set-points [rad], one for each motor; None if there are none in time."""
        ...

    def finished(self, index: int) -> bool:
        """Return whether the run ends before sample `index`."""
        ...


def reference_of(pilot: Pilot) -> tuple[float, ...]:
    """Return what a pilot that closes a loop wanted its outputs to be at its last step [rad]; () of any other."""
    return tuple(getattr(pilot, "reference", ()))
