"""Inclination and orientation of the tilt vector, or a quaternion, as pitch and roll."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError, Matrix, Vector


def pitch_roll(inclination: Vector, orientation: Vector) -> tuple[Vector, Vector]:
    """Return pitch and roll [rad] of a tilt by `inclination` [rad] towards `orientation` [rad].

    Motor 1 sits at orientation 90 deg (README of the recordings):
    `pitch = atan2(sin i sin o, cos i)`, `roll = -atan2(sin i cos o, cos i)`.
    """
    i, o = np.asarray(inclination), np.asarray(orientation)
    pitch = np.arctan2(np.sin(i) * np.sin(o), np.cos(i))
    roll = -np.arctan2(np.sin(i) * np.cos(o), np.cos(i))
    return pitch, roll


def turns(quaternion: Matrix) -> dict[str, Vector]:
    """Return the turns [rad] about the axes `x` and `y` of a sensor, and `-x`, `-y`, of (time, 4) w, x, y, z.

    They are the first two of yaw, pitch and roll in this order (z, y', x''), which ROS and aviation use:
    `x = atan2(2 (w x + y z), 1 - 2 (x^2 + y^2))`, `y = asin(2 (w y - z x))` (Diebel 2006, sec. 8.11). A row without
    numbers is a missed sample, and so is one of zeros.

    Raises:
        DataError: most rows are no quaternions: their length is not about 1.
    """
    length = np.sqrt((quaternion * quaternion).sum(axis=1))
    sound = np.abs(length - 1.0) < 0.1
    if (~sound & np.isfinite(length) & (length > 0.0)).mean() > 0.5:
        middle = float(np.median(length[np.isfinite(length)]))
        raise DataError(f"the columns of [quaternion] have length {middle:.3g} and not 1: they are something else.")
    w, x, y, z = (quaternion / np.where(sound, length, np.nan)[:, None]).T
    about_x = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    about_y = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return {"x": about_x, "-x": -about_x, "y": about_y, "-y": -about_y}
