"""The numbers of the grey box's equations: how each is searched, and which belong to an optional part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..models._arrays import RIGID


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of the neck's equations, searched between `low` and `high`, by its logarithm where `positive`.

    unit: SI, lengths of tendon and tensions in radians of motor; guess: start, for a neck of 0.1 m with winches of 7.5
    mm; spread: of the weak prior around it, of the logarithm where `positive`.
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
        return self.unit in ("1/s", "rad/s", "1/(rad s)", "1/(rad^2 s)", "1/(s kg)")

    def encode(self, value: float) -> float:
        """Return the search variable of a value."""
        return float(np.log(value)) if self.positive else value

    def decode(self, value: float) -> float:
        """Return the value of a search variable."""
        return float(np.exp(value)) if self.positive else value


PARAMETERS = (
    Parameter("drive_rate", "1/s", 10.0, 1.0, 80.0, 1.0, True, "position loop of the drives"),
    Parameter("pretension", "rad", 0.3, 0.01, 5.0, 1.0, True, "stretch of each tendon at rest"),
    Parameter("pull_limit", "rad", 0.6, 0.05, 50.0, 1.0, True, "stretch at which a drive stalls"),
    Parameter("lever", "rad/rad", 7.0, 0.5, 40.0, 0.5, True, "radius of the tendons over radius of the winch"),
    Parameter("gain", "1/(rad s)", 10.0, 0.05, 500.0, 1.0, True, "tension to rate of bending"),
    Parameter("stiffness", "1/s", 10.0, 0.05, 500.0, 1.0, True, "of the link against bending"),
    Parameter("stiffening", "1/(rad^2 s)", 3.0, 0.0, 300.0, 10.0, False, "cubic term of the stiffness"),
    Parameter("asymmetry", "1", 0.0, -0.5, 0.5, 0.1, False, "stiffness is (1 + this) in pitch, (1 - this) in roll"),
    Parameter("rest_pitch", "rad", 0.0, -0.3, 0.3, 0.1, False, "bend of the link without tendons"),
    Parameter("rest_roll", "rad", 0.0, -0.3, 0.3, 0.1, False, "bend of the link without tendons"),
    Parameter("compliance", "1", 3.0, 0.001, 50.0, 1.0, True, "compression per sum of the tensions"),
    Parameter("axial_rate", "1/s", 20.0, 0.5, 300.0, 1.0, True, "rate of compression"),
    Parameter("friction", "1/s", 0.3, 0.0, 300.0, 30.0, False, "hysteresis against bending"),
    Parameter("friction_angle", "rad", 0.05, 0.003, 1.0, 1.0, True, "bend over which the hysteresis builds up"),
    Parameter("twist", "rad", 0.0, -0.5, 0.5, 0.1, False, "turn of the tendons against the inclinometer"),
    Parameter("sensor_rate", "1/s", 40.0, 2.0, 300.0, 1.0, True, "lag of the inclinometer"),
)


# What a payload changes, where the recordings have several; of a kilogram as much as the numbers themselves are.
PAYLOAD_PARAMETERS = (
    Parameter("payload_stiffness", "1/(s kg)", -3.0, -60.0, 60.0, 10.0, False, "what a payload adds to the stiffness"),
    Parameter("payload_pretension", "rad/kg", -0.2, -5.0, 5.0, 1.0, False, "what a payload adds to the pretension"),
)
# From three payloads on: what the first kilograms change beyond the last ones.
PAYLOAD_CURVE = Parameter(
    "payload_curve", "1", 0.5, 0.0, 30.0, 5.0, False, "how soon the effect of a payload saturates"
)
_STRAIGHT_PAYLOADS = 2


def payload_parameters(payloads: int) -> tuple[Parameter, ...]:
    """Return the numbers for recordings of so many payloads: none, a line through two, a curve through more."""
    if payloads < _STRAIGHT_PAYLOADS:
        return ()
    return PAYLOAD_PARAMETERS if payloads == _STRAIGHT_PAYLOADS else (*PAYLOAD_PARAMETERS, PAYLOAD_CURVE)


# What a body of foam or coils does beside, each part on its own; zero is a body of constant stiffness without creep.
SOFTENING_PARAMETERS = (
    Parameter("softening", "1", 0.05, 0.0, 20.0, 3.0, False, "stiffness at rest over that at the reach, less one"),
    Parameter("lasting_softening", "1", 0.02, 0.0, 0.9, 0.3, False, "loss of stiffness after the largest bend of late"),
)
CREEP_PARAMETERS = (
    Parameter("creep", "1", 0.05, 0.0, 3.0, 0.5, False, "stiffness that creeps away over the stiffness that stays"),
    Parameter("creep_rate", "1/s", 1.0, 0.01, 10.0, 1.0, True, "rate of creep"),
    Parameter("slow_creep", "1", 0.05, 0.0, 3.0, 0.5, False, "stiffness that creeps away slowly over what stays"),
    Parameter("slow_creep_rate", "1/s", 0.2, 0.005, 10.0, 1.0, True, "rate of slow creep"),
)
# Where the tendons are: those of 2 and 3 against tendon 1, which `twist` and `lever` move.
TENDON_PARAMETERS = (
    Parameter("angle_2", "rad", 0.0, -0.5, 0.5, 0.1, False, "place of tendon 2 past its nominal angle"),
    Parameter("angle_3", "rad", 0.0, -0.5, 0.5, 0.1, False, "place of tendon 3 past its nominal angle"),
    Parameter("arm_2", "1", 1.0, 0.5, 2.0, 0.1, True, "arm of tendon 2 over that of tendon 1"),
    Parameter("arm_3", "1", 1.0, 0.5, 2.0, 0.1, True, "arm of tendon 3 over that of tendon 1"),
)
# Homed to one tension, tendons that are displaced bend the link.
HOME_PARAMETERS = (
    Parameter("home_pitch", "rad", 0.0, -0.3, 0.3, 0.05, False, "bend at which all tendons are stretched alike"),
    Parameter("home_roll", "rad", 0.0, -0.3, 0.3, 0.05, False, "bend at which all tendons are stretched alike"),
)
# Where it is stiffer: between the axes, as a spring's main directions may lie, and towards three lobes.
ANISOTROPY_PARAMETERS = (
    Parameter("coupling", "1", 0.0, -0.5, 0.5, 0.1, False, "stiffness between pitch and roll over their mean"),
    Parameter("lobe_pitch", "1", 0.0, -0.5, 0.5, 0.1, False, "stiffness at the reach of three lobes, one in pitch"),
    Parameter("lobe_roll", "1", 0.0, -0.5, 0.5, 0.1, False, "stiffness at the reach of three lobes, one in roll"),
)
# Coils that touch, or foam that is dense.
STOP_PARAMETERS = (
    Parameter("stop", "1/rad", 1.4, 0.0, 20.0, 5.0, False, "one over the compression at which the link gets stiff"),
)
# A bent link brings its plates nearer to each other: of an arc L / (24 r), of a straight line between plates L / (6 r).
ARC_PARAMETERS = (
    Parameter("arc", "rad/rad^2", 0.5, 0.0, 20.0, 1.0, False, "what the square of a bend takes off each tendon's way"),
)
SPEED_PARAMETERS = (
    Parameter("top_speed", "rad/s", 20.0, 0.5, float(RIGID[14]), 1.0, True, "largest speed of the drives"),
    Parameter("drag", "1", 0.05, 0.0, 0.9, 0.1, False, "friction of a moving drive over its pull limit"),
    Parameter("drag_rate", "1/s", 3.0, 0.01, 80.0, 1.0, True, "how soon it falls as a drive comes to rest"),
)
PARTS = {
    "anisotropy": ANISOTROPY_PARAMETERS,
    "stop": STOP_PARAMETERS,
    "softening": SOFTENING_PARAMETERS,
    "creep": CREEP_PARAMETERS,
    "tendons": TENDON_PARAMETERS,
    "homing": HOME_PARAMETERS,
    "arc": ARC_PARAMETERS,
    "speed": SPEED_PARAMETERS,
}
# In the order of BODY_*, behind the reach.
BODY_PARAMETERS = (
    *SOFTENING_PARAMETERS, *CREEP_PARAMETERS[:2], *ANISOTROPY_PARAMETERS, *STOP_PARAMETERS, *ARC_PARAMETERS,
    *HOME_PARAMETERS, *CREEP_PARAMETERS[2:], *SPEED_PARAMETERS,
)  # fmt: skip
# The values of optional numbers that change nothing.
NO_EFFECT = {number.name: number.guess for number in TENDON_PARAMETERS} | {
    number.name: float(value) for number, value in zip(BODY_PARAMETERS, RIGID[1:], strict=True)
}

# Those that have no meaning where the link bends in one plane.
OUT_OF_PLANE_PARAMETERS = ("asymmetry", "rest_roll", "twist")
