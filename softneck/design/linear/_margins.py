"""Margins of a loop with its exact delay."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import SettingsError, Vector

if TYPE_CHECKING:
    import control


# Lowest frequency on which a neck's loop is judged [rad/s]; loops of slower robots are from where their times are.
LOWEST = 0.05


@dataclass(frozen=True, slots=True)
class Margins:
    """How far a loop is from instability.

    Attributes:
        gain: factor on the loop gain until instability; inf where there is none.
        phase: [rad]; inf where the gain never reaches 1.
        sensitivity: Ms, the largest `|1/(1 + L)|`.
        crossover: gain crossover [rad/s]; NaN where there is none.
        delay: [s] that the loop stands beyond its own.
    """

    gain: float
    phase: float
    sensitivity: float
    crossover: float
    delay: float


def frequencies(sample_time: float, *, lowest: float = LOWEST) -> Vector:
    """Return the frequencies [rad/s] on which loops are judged, up to the Nyquist frequency."""
    # 1 % apart: the peak of |S| of a well-damped loop changes by less than 1e-4 between two of them.
    highest = math.pi / sample_time
    return np.geomspace(lowest, highest, math.ceil(math.log(highest / lowest) / 0.01))


def loop_margins(loop: control.TransferFunction, *, lowest: float = LOWEST) -> Margins:
    """Return the margins of the discrete open loop `loop`, verified to be stable when closed.

    Gain and phase margin are python-control's, from the exact z^-d; Ms is from the frequency response.

    Raises:
        SettingsError: the closed loop is not stable.
    """
    import control

    dt: Any = loop.dt
    closed: Any = control.feedback(loop, 1)
    poles = np.asarray(closed.poles())
    radius = float(np.abs(poles).max(initial=0.0))
    if radius >= 1.0:
        raise SettingsError(f"the closed loop is not stable (spectral radius {radius:.4f}); ask for less.")
    with warnings.catch_warnings():
        # It looks at the integrator's own frequency, zero, as well.
        warnings.filterwarnings("ignore", "(divide by zero|invalid value)", RuntimeWarning)
        # It says that polynomials of this order are inaccurate and that it takes the frequency response instead.
        warnings.filterwarnings("ignore", "stability_margins: Falling back", UserWarning)
        gain, phase, _, _, crossover, _ = control.stability_margins(loop)
    response = np.asarray(loop(np.exp(1j * frequencies(dt, lowest=lowest) * dt)))
    sensitivity = float(np.abs(1.0 / (1.0 + response)).max())
    angle = math.radians(float(phase))
    delay = angle / crossover if math.isfinite(angle) and crossover > 0 else math.inf
    return Margins(nearer_gain(float(gain), response[-1]), angle, sensitivity, float(crossover), delay)


def nearer_gain(gain: float, last: complex) -> float:
    """Return the nearer of a gain margin and of that at the Nyquist frequency, which python-control leaves out.

    Args:
        gain: a factor.
        last: the open loop at the Nyquist frequency, where it is real.
    """
    there = -1.0 / last.real if last.real < 0.0 else math.inf
    return min(gain, there, key=lambda factor: abs(math.log(max(factor, 1e-300))))
