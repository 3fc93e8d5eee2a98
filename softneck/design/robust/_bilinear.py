"""Discrete systems as continuous ones and back, exactly, by `s = 2/Ts (z - 1)/(z + 1)`.

The map keeps stability, H-infinity norms and frequency responses (with `w` drawn out to `2/Ts tan(w Ts/2)`), so a
synthesis in s is one of the discrete plant with its delay as poles at zero (Chen and Francis 1995, sec. 3.4).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import SettingsError, Vector

if TYPE_CHECKING:
    import control


def to_continuous(system: Any) -> control.StateSpace:
    """Return the continuous image of a discrete system; a continuous one as it is."""
    import control

    discrete: Any = control.ss(system)
    if discrete.dt == 0:
        return discrete
    T = float(discrete.dt)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (discrete.A, discrete.B, discrete.C, discrete.D))
    n = A.shape[0]
    if n == 0:
        return control.StateSpace(A, B, C, D, 0)
    whole = A + np.eye(n)
    if np.linalg.cond(whole) > 1e12:
        raise SettingsError("the plant has a pole at z = -1, which no plant with a held input has; identify it again.")
    E = np.linalg.inv(whole)
    r = 2.0 / math.sqrt(T)
    return control.StateSpace(2.0 / T * (A - np.eye(n)) @ E, r * E @ B, r * C @ E, D - C @ E @ B, 0)


def to_discrete(system: Any, sample_time: float) -> control.StateSpace:
    """Return the discrete system of which `system` is the image."""
    import control

    continuous: Any = control.ss(system)
    T = sample_time
    A, B, C, D = (np.asarray(p, dtype=np.float64) for p in (continuous.A, continuous.B, continuous.C, continuous.D))
    n = A.shape[0]
    if n == 0:
        return control.StateSpace(A, B, C, D, T)
    E = np.linalg.inv(np.eye(n) - 0.5 * T * A)
    r = math.sqrt(T)
    return control.StateSpace((np.eye(n) + 0.5 * T * A) @ E, r * E @ B, r * C @ E, D + 0.5 * T * C @ E @ B, T)


def drawn_out(frequency: Vector, sample_time: float) -> Vector:
    """Return `2/Ts tan(w Ts/2)`, where the image has the response that the discrete system has at w [rad/s]."""
    return 2.0 / sample_time * np.tan(0.5 * sample_time * np.asarray(frequency))
