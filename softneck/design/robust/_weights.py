"""Weights by the numbers that engineers have, and discrete systems as continuous ones and back.

The map `s = 2/Ts (z - 1)/(z + 1)` keeps stability, H-infinity norms and frequency responses (with `w` drawn out to
`2/Ts tan(w Ts/2)`), so a synthesis in s is one of the discrete plant with its delay as poles at zero (Chen and Francis
1995, sec. 3.4).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import SettingsError, Vector, require_positive
from softneck.identification import to_state_space

if TYPE_CHECKING:
    import control


# An exact integrator in a weight leaves the synthesis without a solution; this far below the corner nobody sees it.
_LEAST_POLE = 1e-9


def makeweight(
    low: float, corner: tuple[float, float] | float, high: float, *, dt: float | None = None
) -> control.TransferFunction:
    """Return W with `|W| = low` at rest, `high` far up, and a given size between them.

    `W = (high s + low p)/(s + p)`; p follows from the corner (MATLAB's makeweight).

    Args:
        low: gain at frequency zero; finite: an integrator in a weight has no stabilising solution.
        corner: frequency [rad/s] and the size there; a frequency alone means size 1.
        high: gain far up.
        dt: sample time [s]; None for a continuous weight. The size at the corner is exact in both.

    Raises:
        SettingsError: the corner's size is not between `low` and `high`, or a number is not positive and finite.
    """
    import control

    frequency, size = corner if isinstance(corner, tuple) else (float(corner), 1.0)
    for name, value in (("low", low), ("high", high), ("corner", frequency), ("size at the corner", size)):
        require_positive(name, value)
    if not min(low, high) < size < max(low, high):
        raise SettingsError(
            f"the size {size:g} at the corner must lie between `low` {low:g} and `high` {high:g}; "
            "otherwise no weight of one slope passes through all three."
        )
    w = float(warp_frequency(np.array([frequency]), dt)[0]) if dt else frequency
    if not 0.0 < w < math.inf or (dt and frequency >= math.pi / dt):
        raise SettingsError(f"the corner {frequency:g} rad/s must be below the Nyquist frequency of dt = {dt} s.")
    p = w * math.sqrt((high**2 - size**2) / (size**2 - low**2))
    above, below = np.array([high, low * p]), np.array([1.0, p])
    return control.TransferFunction(above, below) if not dt else _discretize(above, below, dt)


def weight_image(weight: Any, dt: float, name: str, size: int = 1) -> control.StateSpace | None:
    """Return a weight as a continuous system for synthesis at `dt`, after the checks that spare a hang or a lie.

    `weight`: None, a number, or a system: continuous, or of the plant's sample time. A scalar one weighs each of the
    signals alike. `dt`: of the plant; 0 if continuous. `name`: for messages. `size`: signals that it weighs. Raises
    SettingsError: another number of inputs, another sample time, an integrator, an unstable or improper weight.
    """
    import control

    if weight is None:
        return None
    if isinstance(weight, int | float):
        require_positive(name, float(weight))
        return control.StateSpace([], [], [], float(weight) * np.eye(size), 0)
    scalar = weight.ninputs == 1 and weight.noutputs == 1
    if not scalar and (size == 1 or weight.ninputs != size):
        inputs = "one input and one output" if size == 1 else f"{size} inputs, or one input and one output"
        raise SettingsError(f"{name} must have {inputs}; got {weight.ninputs} and {weight.noutputs}.")
    wdt = float(weight.dt or 0.0)
    if wdt != 0.0 and not math.isclose(wdt, dt, rel_tol=1e-9):
        raise SettingsError(f"{name} has dt = {wdt:g} s, the plant dt = {dt:g} s; make it with `makeweight(..., dt=)`.")
    if isinstance(weight, control.TransferFunction):
        pairs = [(np.asarray(n), np.asarray(d)) for n, d in _entries(weight)]
        if any(np.trim_zeros(n, "f").size > np.trim_zeros(d, "f").size for n, d in pairs):
            raise SettingsError(f"{name} has more zeros than poles; add a fast pole, as `makeweight` does.")
    image = to_continuous(weight)
    poles = np.linalg.eigvals(np.asarray(image.A)) if image.nstates else np.zeros(0)
    if poles.size and float(np.min(np.abs(poles))) < _LEAST_POLE:
        raise SettingsError(
            f"{name} has an integrator, with which no stabilising solution exists; move its pole to 1e-4 rad/s "
            "(`makeweight(1e4, ...)`). The design still gives the controller a true integrator."
        )
    if poles.size and float(np.max(poles.real)) >= 0.0:
        raise SettingsError(f"{name} is not stable (a pole at {np.max(poles.real):.3g} rad/s); weights must be.")
    return repeat_diagonal(image, size) if scalar else image


def repeat_diagonal(system: control.StateSpace, size: int) -> control.StateSpace:
    """Return a scalar system beside itself, once for each of `size` signals."""
    import control

    each: Any = system
    one = np.eye(size)
    return control.StateSpace(*(np.kron(one, np.asarray(part)) for part in (each.A, each.B, each.C, each.D)), each.dt)


def _entries(weight: Any) -> list[tuple[Any, Any]]:
    """Return numerator and denominator of each entry of a transfer function."""
    places = [(i, j) for i in range(weight.noutputs) for j in range(weight.ninputs)]
    return [(weight.num[i][j], weight.den[i][j]) for i, j in places]


def _discretize(above: np.ndarray, below: np.ndarray, dt: float) -> control.TransferFunction:
    import control
    from scipy.signal import ss2tf

    made: Any = to_discrete(control.TransferFunction(above, below), dt)
    num, den = ss2tf(made.A, made.B, made.C, made.D)
    return control.TransferFunction(num[0], den, dt)


def to_continuous(system: Any) -> control.StateSpace:
    """Return the continuous image of a discrete system; a continuous one as it is."""
    import control

    discrete = to_state_space(system)
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

    continuous = to_state_space(system)
    T = sample_time
    A, B, C, D = (np.asarray(p, dtype=np.float64) for p in (continuous.A, continuous.B, continuous.C, continuous.D))
    n = A.shape[0]
    if n == 0:
        return control.StateSpace(A, B, C, D, T)
    E = np.linalg.inv(np.eye(n) - 0.5 * T * A)
    r = math.sqrt(T)
    return control.StateSpace((np.eye(n) + 0.5 * T * A) @ E, r * E @ B, r * C @ E, D + 0.5 * T * C @ E @ B, T)


def warp_frequency(frequency: Vector, sample_time: float) -> Vector:
    """Return `2/Ts tan(w Ts/2)`, where the image has the response that the discrete system has at w [rad/s]."""
    return 2.0 / sample_time * np.tan(0.5 * sample_time * np.asarray(frequency))
