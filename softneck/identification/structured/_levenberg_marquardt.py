"""Least squares within bounds by Levenberg-Marquardt on the normal equations (Nocedal and Wright 2006, sec. 10.3).

A tendon that gets slack and a drive that stalls bend the error's surface. There the trust region of
`scipy.optimize.least_squares` shrinks to nothing: on the second half of the lab's open-loop record it ended at 2.7
times the squared error that this search finds. Where a step gains little the damping changes its metric; where it gains
little in either, the search ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from softneck.core import Matrix, Vector, side_by_side

# Of finite differences, in scales: far above rounding, far below the curvature.
_DIFFERENCE = 1e-4
# A step that lowers the squared error by less gains little.
_LITTLE = 1e-4
# Of the damping: its first value, that of a new metric, the least; the most trials of one step.
_FIRST, _NEXT, _LEAST, _TRIALS = 1.0, 1e-2, 1e-9, 15
# The least curvature over the largest that the damping takes for a number's own.
_LEAST_CURVATURE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Where each variable is searched: `low`, `high`, and its usual change `scale`, each (n,)."""

    low: Vector
    high: Vector
    scale: Vector


@dataclass(slots=True)
class _Point:
    x: Vector
    e: Vector

    @property
    def cost(self) -> float:
        return 0.5 * float(self.e @ self.e)


def minimise(errors: Callable[[Vector], Vector], start: Vector, bounds: Bounds, steps: int) -> Vector:
    """Return the variables (n,) of the least squared error that are found in at most `steps` steps.

    `errors` is called from several threads.
    """
    at = _Point(x := np.clip(start, bounds.low, bounds.high), errors(x))
    curved, damping, stalled = False, _FIRST, 0
    for _ in range(steps):
        J = _jacobian(errors, at, bounds)
        g, H = J @ at.e, J @ J.T
        found = _step(errors, at, g, H, bounds, curved, damping)
        if found is None and not stalled:
            curved, stalled = not curved, 1
            found = _step(errors, at, g, H, bounds, curved, _NEXT)
        if found is None:
            break
        nearer, damping = found
        gain, at = 1.0 - nearer.cost / max(at.cost, 1e-300), nearer
        stalled = stalled + 1 if gain < _LITTLE else 0
        if stalled > 2:
            break
        if stalled:
            curved, damping = not curved, _NEXT
    return at.x


def _jacobian(errors: Callable[[Vector], Vector], at: _Point, bounds: Bounds) -> Matrix:
    """Return the slopes (n, errors) by differences that stay within the bounds."""
    J = np.empty((at.x.size, at.e.size))
    steps = _DIFFERENCE * bounds.scale
    steps = np.where(at.x + steps <= bounds.high, steps, -steps)

    def slope(i: int) -> None:
        moved = at.x.copy()
        moved[i] += steps[i]
        np.subtract(errors(moved), at.e, out=J[i])
        J[i] /= steps[i]

    side_by_side([partial(slope, i) for i in range(at.x.size)])
    return J


def _step(
    errors: Callable[[Vector], Vector],
    at: _Point,
    g: Vector,
    H: Matrix,
    bounds: Bounds,
    curved: bool,
    damping: float,
) -> tuple[_Point, float] | None:
    """Return a point of smaller error and the damping to begin the next step with; None where there is none.

    `curved`: damped by each number's own curvature (Marquardt 1963), else by its scale.
    """
    own = np.diag(H) * bounds.scale**2
    metric = np.maximum(own, _LEAST_CURVATURE * own.max()) if curved else np.full(own.size, np.median(own))
    metric = np.maximum(metric, 1e-300) / bounds.scale**2
    for _ in range(_TRIALS):
        x = np.clip(at.x + _direction(at.x, g, H + np.diag(damping * metric), bounds), bounds.low, bounds.high)
        s = x - at.x
        foreseen = -float(g @ s + 0.5 * s @ H @ s)
        nearer = _Point(x, errors(x))
        share = (at.cost - nearer.cost) / foreseen if foreseen > 0.0 else -1.0
        if share > 1e-3:
            factor = 0.125 if share > 0.5 else 2.0 if share < 0.1 else 1.0
            return nearer, max(factor * damping, _LEAST)
        damping *= 4.0
    return None


def _direction(x: Vector, g: Vector, A: Matrix, bounds: Bounds) -> Vector:
    """Return the step of the variables that are not held by a bound which it would cross."""
    free = ~(((x <= bounds.low) & (g > 0.0)) | ((x >= bounds.high) & (g < 0.0)))
    while True:
        d, i = np.zeros(x.size), np.flatnonzero(free)
        d[i] = np.linalg.solve(A[i[:, None], i], -g[i])
        held = ((x <= bounds.low) & (d < 0.0)) | ((x >= bounds.high) & (d > 0.0))
        if not held.any():
            return d
        free &= ~held
