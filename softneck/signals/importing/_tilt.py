"""Inclination and orientation of the tilt vector as pitch and roll."""

from __future__ import annotations

import numpy as np

from softneck.core import Vector


def pitch_roll(inclination: Vector, orientation: Vector) -> tuple[Vector, Vector]:
    """Return pitch and roll [rad] of a tilt by `inclination` [rad] towards `orientation` [rad].

    Motor 1 sits at orientation 90 deg (README of the recordings):
    `pitch = atan2(sin i sin o, cos i)`, `roll = -atan2(sin i cos o, cos i)`.
    """
    i, o = np.asarray(inclination), np.asarray(orientation)
    pitch = np.arctan2(np.sin(i) * np.sin(o), np.cos(i))
    roll = -np.arctan2(np.sin(i) * np.cos(o), np.cos(i))
    return pitch, roll
