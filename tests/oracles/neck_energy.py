"""The neck's energy, written from the potentials themselves and not from the forces of the runtime.

The tests hold the forces against it: at rest the potential is least, and without actuation the
sum never rises.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import Vector
from softneck.plant._mechanics_runtime import NeckBody
from softneck.plant._neck_runtime import VirtualNeckArrays
from softneck.plant._parameters import NeckParameters
from softneck.runtime import State

_GRAVITY = 9.80665
# As in the link's runtime: the compressed link rests on itself.
_WALL_RATIO = 50.0


@dataclass(frozen=True, slots=True)
class NeckEnergy:
    """The parts of the neck's energy [J].

    Attributes:
        kinetic: of platform, payload and link.
        elastic: of the link's bending and compression.
        hysteresis: stored in the hysteresis element.
        tendons: stored in the tendons.
        gravity: of platform, payload and link, zero at the base plate.
    """

    kinetic: float
    elastic: float
    hysteresis: float
    tendons: float
    gravity: float

    @property
    def total(self) -> float:
        """Sum of all parts [J]."""
        return self.kinetic + self.elastic + self.hysteresis + self.tendons + self.gravity


def neck_energy(state: State, *, payload: float = 0.0) -> NeckEnergy:
    """Return the energy of the virtual neck in `state` (of its block), base upright, no push.

    Args:
        state: of the block of `VirtualNeck`.
        payload: mass on the platform [kg].
    """
    p = dict(zip(_names(state), state.parameters.tolist(), strict=False))
    x = body(state)
    length, radius = p["link_length"], p["platform_radius"]
    carried = ((p["platform_mass"], p["platform_height"]), (payload, p["payload_height"]), (0.25 * p["link_mass"], 0.0))
    inertia = sum(m * (0.5 * length + c) ** 2 for m, c in carried) + 0.25 * p["platform_mass"] * radius**2
    mass = sum(m for m, _ in carried)
    parts = _potentials(p, np.append(x["b"], x["s"]), x["position"], x["free"], payload)
    (w1, w2), (v,), (z1, z2) = x["w"], x["v"], x["z"]
    return NeckEnergy(
        kinetic=float(0.5 * inertia * (w1**2 + w2**2) + 0.5 * mass * v**2),
        elastic=parts[0],
        hysteresis=float(0.5 * p["hysteresis_torque"] / p["hysteresis_angle"] * (z1**2 + z2**2)),
        tendons=parts[1],
        gravity=parts[2],
    )


def potential_energy(
    parameters: NeckParameters,
    coordinates: ArrayLike,
    positions: ArrayLike,
    free_lengths: ArrayLike,
    *,
    payload: float = 0.0,
) -> float:
    """Return the potential energy [J] of link, tendons and gravity; the hysteresis element is left out.

    Args:
        parameters: the neck.
        coordinates: (3,) bending vector [rad] and compression [m].
        positions: (3,) of the winches [rad].
        free_lengths: (3,) of the unstretched tendons at winch position zero [m]; `free_lengths(state)`.
        payload: mass on the platform [kg].
    """
    p = {name: float(getattr(parameters, name)) for name in NeckParameters.names()}
    q, P, free = (np.asarray(v, dtype=np.float64) for v in (coordinates, positions, free_lengths))
    return sum(_potentials(p, q, P, free, payload))


def free_lengths(state: State) -> Vector:
    """Return the tendons' unstretched lengths [m] at winch position zero, (3,)."""
    return body(state)["free"].copy()


def body(state: State) -> dict[str, Vector]:
    """Return the parts of `NeckBody`, by name."""
    setup = np.array([[0.0, 0.0, 0.0, 0.0, _tendons(state), 0.0]])  # the first parts' lengths depend on no others
    return {name: state.values[place] for name, place in NeckBody.parts(VirtualNeckArrays((setup,))).items()}


def _tendons(state: State) -> int:
    """Return how many tendons there are: each has an angle among the parameters, behind which the seed stands."""
    return state.parameters.size - 1 - (len(NeckParameters.names()) - 3)


def _names(state: State) -> list[str]:
    """Return the names of the parameters."""
    others = [name for name in NeckParameters.names() if not name.startswith("tendon_angle_")]
    return [*others[:3], *(f"tendon_angle_{j + 1}" for j in range(_tendons(state))), *others[3:]]


def _potentials(p: dict[str, float], q: Vector, P: Vector, free: Vector, payload: float) -> tuple[float, float, float]:
    """Return (link, tendons, gravity) [J]."""
    b, s = q[:2], q[2]
    beta = float(np.hypot(b[0], b[1]))
    skew = np.array([1.0 + p["stiffness_asymmetry"], 1.0 - p["stiffness_asymmetry"]])
    bend = b - np.array([p["rest_pitch"], p["rest_roll"]])
    cosine, sine = math.cos(p["stiffness_angle"]), math.sin(p["stiffness_angle"])
    planes = np.array([cosine * bend[0] + sine * bend[1], cosine * bend[1] - sine * bend[0]])
    bending = 0.5 * p["bending_stiffness"] * float(skew @ planes**2) + 0.25 * p["bending_stiffening"] * beta**4
    wall = 0.5 * _WALL_RATIO * p["axial_stiffness"] * max(0.0, s - p["compression_limit"]) ** 2
    axial = 0.5 * p["axial_stiffness"] * s**2 + 0.25 * p["axial_stiffening"] * s**4
    length = p["link_length"] - s
    tendons = 0.0
    for j in range(P.size):
        angle = p[f"tendon_angle_{j + 1}"]
        lean = b[0] * math.cos(angle) + b[1] * math.sin(angle)
        chord = float(np.sinc(beta / (2.0 * np.pi))) * (length - p["attachment_radius"] * lean)
        stretch = chord - free[j] + p["winch_radius"] * P[j]
        tendons += 0.5 * p["tendon_stiffness"] * max(0.0, stretch) ** 2
    masses = ((p["platform_mass"], p["platform_height"]), (payload, p["payload_height"]), (0.25 * p["link_mass"], 0.0))
    top = length * float(np.sinc(beta / np.pi))
    gravity = _GRAVITY * sum(m * (top + c * math.cos(beta)) for m, c in masses)
    return bending + float(wall + axial), float(tendons), float(gravity)
