"""From bandwidth and robustness to weights, moves, observer and reference filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_positive
from softneck.estimation import AxisPlant

from ..linear._axis_loop import bisect, frequencies, rise_time
from ..plants._coupled import AnyAxes, AnyAxis, CoupledAxis, close_loop, radius, sensitivity
from ._arrays import system, with_filter, with_gains

# One plant for each output.
Pair = AnyAxes

# Decades of the move weight that are searched, relative to errors of the input.
_WEIGHT_DECADES = (-6.0, 6.0)
# Trust of the observers that are tried.
_MIN_TRUST, FULL_TRUST = 1e-4, 1e3
_BISECTION_STEPS = 18
_FREQUENCY_DECIMATION = 5
# A step response is judged over this long.
_STEP_WINDOW_S = 4.0
# With 180 a sample of 20 ms was over before half of the answers came, with 90 none of them took a tenth of it.
_MAX_UNKNOWNS = 120
# Samples of the last hold: ten moves over thirty samples, dense where they matter.
_MOVE_SPACING = (0, 1, 2, 3, 4, 6, 8, 11, 15, 20)


def judged_frequencies(nominal: Pair) -> Vector:
    """Return the frequencies [rad/s] of Ms: 5 % apart, so that a peak is missed by less than 1 %."""
    return frequencies(nominal[0].sample_time)[::_FREQUENCY_DECIMATION]


def require_positive_settings(settings: Any, units: Mapping[str, str]) -> None:
    """Raise SettingsError for a given setting that is not positive; `units` are for the message."""
    for name, unit in units.items():
        if getattr(settings, name) is not None:
            require_positive(name, getattr(settings, name), unit)


def move_weight(plant: AnyAxis, bandwidth: float) -> float:
    """Return the weight on moves of an axis' input with which the slowest pole of its LQR is as fast as `bandwidth`.

    The error is weighted by one over the squared static gain, so that both count in rad of the input. Of poles that the
    output hardly shows nothing is asked: no weight moves them.
    """
    plant = plant.lag() if isinstance(plant, CoupledAxis) else plant.remove_hidden_poles()
    slowest = math.exp(-bandwidth * plant.sample_time)
    return float(10.0 ** bisect(lambda x: _slowest(plant, 10.0**x) <= slowest, *_WEIGHT_DECADES, _BISECTION_STEPS)[0])


def _slowest(plant: AxisPlant, weight: float) -> float:
    """Return the spectral radius of the loop of (states, held input) under the LQR."""
    from scipy.linalg import solve_discrete_are

    A0, B0, C0 = plant.observable_form()
    n = plant.order
    A, B = np.eye(n + 1), np.zeros((n + 1, 1))
    A[:n, :n], A[:n, n], B[:n, 0], B[n, 0] = A0, B0, B0, 1.0
    Q = np.zeros((n + 1, n + 1))
    Q[:n, :n] = np.outer(C0, C0) / plant.static_gain**2
    R = np.array([[weight]])
    P = solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return float(np.abs(np.linalg.eigvals(A - B @ K)).max())


def keeps_bounds(
    arrays: tuple[Matrix, ...], families: list[tuple[Pair, float]], extra_delay: int, frequency: Vector
) -> bool:
    """Return whether the loop with every plant is stable and keeps the plant's bound on Ms."""
    parts = system(arrays)
    return all(
        sensitivity(parts, pair, extra_delay, frequency) <= bound and radius(parts, pair, extra_delay) < 1.0
        for pair, bound in families
    )


def observer_trust(
    arrays: tuple[Matrix, ...], families: list[tuple[Pair, float]], extra_delay: int, frequency: Vector
) -> float:
    """Return the trust of the fastest observer whose loop keeps every plant's bound on Ms.

    `arrays`: of the controller. `families`: plants, each with its bound. `extra_delay`: samples added to their delay.
    `frequency`: at which Ms is looked at [rad/s]. Raises SettingsError: not even the slowest does.
    """

    def keeps(trust: float) -> bool:
        return keeps_bounds(with_gains(arrays, trust), families, extra_delay, frequency)

    if keeps(FULL_TRUST):
        return FULL_TRUST
    if not keeps(_MIN_TRUST):
        raise SettingsError(
            "no observer keeps the requested robustness; ask for less `bandwidth` or more `max_sensitivity`."
        )
    low, high = math.log(_MIN_TRUST), math.log(FULL_TRUST)
    return math.exp(bisect(lambda x: keeps(math.exp(x)), low, high, _BISECTION_STEPS // 2 + 2)[0])


def rise(arrays: tuple[Matrix, ...], pair: Pair, extra_delay: int) -> float:
    """Return the rise time [s], 10 to 90 %, of a step of each reference alone without limits; of the slowest
    axis, infinite where one does not rise."""
    parts, m, Ts = system(arrays), len(pair), pair[0].sample_time
    A, B, C = close_loop(parts, pair, extra_delay)
    rows = math.ceil(_STEP_WINDOW_S / Ts)
    x, y = np.zeros((A.shape[0], m)), np.zeros((rows, m))
    for k in range(rows):
        x = A @ x + B
        y[k] = np.diag(C @ x)
    return max(rise_time(path, Ts) for path in y.T)


def filter_for_rise(arrays: tuple[Matrix, ...], pair: Pair, extra_delay: int, asked: float) -> float:
    """Return the time constant [s] of the reference filter for the required rise time [s]; 0 where it does
    not even without."""

    def is_quick(time: float) -> bool:
        return rise(with_filter(arrays, time), pair, extra_delay) < asked

    return bisect(is_quick, 0.0, asked, _BISECTION_STEPS)[0] if is_quick(0.0) else 0.0


def guard_samples(bandwidth: float, sample_time: float) -> int:
    """Return after how many samples soft limits are looked at: the time constant of the loop."""
    return max(1, round(1.0 / (bandwidth * sample_time)))


def require_solvable(moves: int, motors: int) -> None:
    """Raise SettingsError where a plan has more unknowns than the solver answers within a sample."""
    if moves * motors > _MAX_UNKNOWNS:
        raise SettingsError(
            f"`moves` {moves} of {motors} motors are {moves * motors} unknowns, and the solver takes at most "
            f"{_MAX_UNKNOWNS} within a sample; ask for at most {_MAX_UNKNOWNS // motors} moves, `horizon` may stay."
        )


def spaced_starts(horizon: int, moves: int) -> tuple[int, ...]:
    """Return samples at which the motors move: dense at first, sparse later."""
    places = np.interp(np.linspace(0.0, 9.0, moves), np.arange(10), np.array(_MOVE_SPACING) * horizon / 30.0)
    starts = [0]
    for place in places[1:]:
        starts.append(max(starts[-1] + 1, round(float(place))))
    # Squeezed together at the end where there are as many moves as samples.
    for i in range(moves):
        starts[-1 - i] = min(starts[-1 - i], horizon - 1 - i)
    return tuple(starts)
