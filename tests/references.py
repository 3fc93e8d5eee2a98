"""References of the paper's neck by the names of their values, as tests give them."""

from __future__ import annotations

from softneck.loop import RobotReference
from softneck.loop._references import reference


def StepReference(**values: float) -> RobotReference:
    """Return a step: `pitch`, `roll`, `cocontraction` [rad], `at` [s]."""
    return reference("step", values)


def RampReference(**values: float) -> RobotReference:
    """Return a ramp: `pitch`, `roll`, `cocontraction` [rad], `at`, `rise` [s]."""
    return reference("ramp", values)


def SineReference(**values: float) -> RobotReference:
    """Return a sine: `pitch`, `roll`, `cocontraction` [rad], `frequency` [Hz], `at` [s]."""
    return reference("sine", values)


def RotationReference(**values: float) -> RobotReference:
    """Return a rotation: `inclination`, `cocontraction` [rad], `frequency` [Hz], `at`, `rise` [s]."""
    return reference("rotation", values)
