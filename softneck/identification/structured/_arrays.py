"""The numbers of the structured kinds: what those of the grey box start from, and what a file's must be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import FileFormatError, Matrix

from ..models._arrays import check_payloads, within


@dataclass(frozen=True, slots=True)
class Number:
    """One number of the neck's equations.

    Attributes:
        name: as in `_neck_equations_runtime`.
        unit: SI; lengths of tendon and tensions are in radians of motor.
        guess: where the search starts: the order of magnitude of a neck of 0.1 m with winches of 7.5 mm.
        low, high: its range.
        spread: of the weak prior around the guess: of its logarithm where `positive`, else of itself.
        positive: searched by its logarithm.
        about: one line.
    """

    name: str
    unit: str
    guess: float
    low: float
    high: float
    spread: float
    positive: bool
    about: str

    @property
    def is_rate(self) -> bool:
        """Whether it is by the second."""
        return self.unit in ("1/s", "1/(rad s)", "1/(rad^2 s)", "1/(s kg)")

    def encode(self, value: float) -> float:
        """Return what the search moves."""
        return float(np.log(value)) if self.positive else value

    def decode(self, value: float) -> float:
        """Return the number of what the search moved."""
        return float(np.exp(value)) if self.positive else value


NUMBERS = (
    Number("drive_rate", "1/s", 10.0, 1.0, 80.0, 1.0, True, "position loop of the drives"),
    Number("pretension", "rad", 0.3, 0.01, 5.0, 1.0, True, "stretch of each tendon at rest"),
    Number("pull_limit", "rad", 0.6, 0.05, 50.0, 1.0, True, "stretch at which a drive stalls"),
    Number("lever", "rad/rad", 7.0, 0.5, 40.0, 0.5, True, "radius of the tendons over radius of the winch"),
    Number("gain", "1/(rad s)", 10.0, 0.05, 500.0, 1.0, True, "tension to rate of bending"),
    Number("stiffness", "1/s", 10.0, 0.05, 500.0, 1.0, True, "of the link against bending"),
    Number("stiffening", "1/(rad^2 s)", 3.0, 0.0, 300.0, 10.0, False, "cubic term of the stiffness"),
    Number("asymmetry", "1", 0.0, -0.5, 0.5, 0.1, False, "stiffness is (1 + this) in pitch, (1 - this) in roll"),
    Number("rest_pitch", "rad", 0.0, -0.3, 0.3, 0.1, False, "bend of the link without tendons"),
    Number("rest_roll", "rad", 0.0, -0.3, 0.3, 0.1, False, "bend of the link without tendons"),
    Number("compliance", "1", 3.0, 0.001, 50.0, 1.0, True, "compression per sum of the tensions"),
    Number("axial_rate", "1/s", 20.0, 0.5, 300.0, 1.0, True, "rate of compression"),
    Number("friction", "1/s", 0.3, 0.0, 300.0, 30.0, False, "hysteresis against bending"),
    Number("friction_angle", "rad", 0.05, 0.003, 1.0, 1.0, True, "bend over which the hysteresis builds up"),
    Number("twist", "rad", 0.0, -0.5, 0.5, 0.1, False, "turn of the tendons against the inclinometer"),
    Number("sensor_rate", "1/s", 40.0, 2.0, 300.0, 1.0, True, "lag of the inclinometer"),
)


# What a payload changes, where the recordings have several; of a kilogram as much as the numbers themselves are.
LOADS = (
    Number("payload_stiffness", "1/(s kg)", -3.0, -60.0, 60.0, 10.0, False, "what a payload adds to the stiffness"),
    Number("payload_pretension", "rad/kg", -0.2, -5.0, 5.0, 1.0, False, "what a payload adds to the pretension"),
)

# Those that have no meaning where the link bends in one plane.
ACROSS = ("asymmetry", "rest_roll", "twist")


def check_play(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["chain"][1:], 1, 1000, "the order of the filters")
    signals = sizes["c"] * (1 + sizes["w"]) * sizes["order"]
    within(arrays["table"], -1, signals - 1, "a term's signal")
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")


def check_greybox(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
    within(arrays["drive"][:, 1], 1, sizes["H"], "a drive's delay")
    within(arrays["sensor"][:1], 0, 1000, "the sensor's dead time")
    if "payload" in arrays:
        _check_payload(arrays["payload"])
    numbers, tendons = np.split(arrays["neck"], [len(NUMBERS)])
    neck = (sizes["motors"], sizes["outputs"]) == (3, 2) and not tendons.size
    if not neck and tendons.size != 1 + 2 * sizes["motors"]:
        raise FileFormatError(f"its array `neck` has {arrays['neck'].size} numbers, which do not fit its tendons.")
    if np.abs(tendons).max(initial=0.0) > 1.0 or not (tendons[:1] > 0.0).all():
        raise FileFormatError("the directions of its tendons in its array `neck` are not of length 1.")
    for number, value in zip(NUMBERS, numbers, strict=True):
        # A thousandth for the rounding of logarithms.
        margin = 1e-3 * max(abs(number.low), abs(number.high))
        if not number.low - min(margin, 0.1 * abs(number.low)) <= value <= number.high + margin:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")


def _check_payload(load: Matrix) -> None:
    check_payloads(*load[:2])
    for number, value in zip(LOADS, load[2:], strict=True):
        if not number.low <= value <= number.high:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")
