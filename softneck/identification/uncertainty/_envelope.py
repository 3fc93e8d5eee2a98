"""A stable minimum-phase weight that covers an envelope, by linear programs on |W|^2."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_whole

# An envelope of 100 points is smooth; the cover is checked and mended on a grid this much finer.
_FINER = 8
_HALVINGS = 28
# What lies below this part of the largest error is covered no more closely: it costs orders and buys nothing.
_FLOOR = 0.02


def envelope_weight(frequency: Vector, envelope: Vector, order: int) -> tuple[Vector, Vector]:
    """Return numerator and denominator of W(s) with `|W(j w)| >= envelope`, as close as its order allows.

    `|W|^2 = N(w^2)/D(w^2)`: for a given closeness gamma, `e^2 D <= N <= gamma^2 e^2 D` is linear in the coefficients;
    the least gamma is found by bisection, W by spectral factorisation (Balas et al. 2007, `ucover`).

    Args:
        frequency: (m,) rising [rad/s].
        envelope: (m,) the largest relative error at each.
        order: of W, 1 to 3.

    Raises:
        SettingsError: an order beyond those, or an envelope that is not positive and finite.
    """
    require_whole("order", order, 1, 3)
    e = np.asarray(envelope, dtype=np.float64)
    if not np.isfinite(e).all() or e.max() <= 0.0:
        raise SettingsError("the envelope must be finite and not zero; the family's samples are all alike.")
    e = np.maximum(e, _FLOOR * e.max())
    middle = float(np.sqrt(frequency[0] * frequency[-1]))
    x = (frequency / middle) ** 2
    low, high, found = 0.0, np.log(e.max() / e.min()) + 1e-3, None
    for _ in range(_HALVINGS):
        tried = 0.5 * (low + high)
        coefficients = _feasible(x, e, order, np.exp(tried))
        if coefficients is None:
            low = tried
        else:
            high, found = tried, coefficients
    if found is None:
        # The constant max(e) is always a cover.
        return np.array([e.max()]), np.array([1.0])
    above, below = (_factor(part, middle) for part in np.split(found, 2))
    size = np.sqrt(found[order] / found[2 * order + 1])
    fine = np.geomspace(frequency[0], frequency[-1], _FINER * frequency.size)
    wanted = np.exp(np.interp(np.log(fine), np.log(frequency), np.log(e)))
    covered = size * np.abs(np.polyval(above, 1j * fine) / np.polyval(below, 1j * fine))
    return size * max(1.0, float(np.max(wanted / covered))) * above, below


def _feasible(x: Vector, e: Vector, order: int, closeness: float) -> Vector | None:
    """Return the coefficients of N and D in rising powers of x, or None where none are that close."""
    from scipy.optimize import linprog

    powers = x[:, None] ** np.arange(order + 1) / (1.0 + x[:, None] ** order)
    e2 = e[:, None] ** 2
    # Rows by their own size: e spans decades.
    zeros = np.zeros_like(powers)
    rows = np.block([[-powers / e2, powers], [powers / e2, -(closeness**2) * powers], [zeros, -powers]])
    # Positive coefficients at both ends keep N and D positive beyond the grid; their scale is free, so D sums to one.
    ends = [(1e-7 if i in (0, order) else None, None) for i in range(order + 1)]
    total: Matrix = np.concatenate([np.zeros(order + 1), np.ones(order + 1)])[None, :]
    bound = np.concatenate([np.zeros(2 * x.size), np.full(x.size, -1e-9)])
    result = linprog(
        np.zeros(2 * order + 2),
        A_ub=rows,
        b_ub=bound,
        A_eq=total,
        b_eq=[1.0],
        bounds=[*ends, *ends],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10},
    )
    if result.status != 0 or not _positive(result.x, order):
        return None
    return np.asarray(result.x)


def _positive(coefficients: Vector, order: int) -> bool:
    """Return whether N and D are positive on a grid far beyond the data's: no root lies on the imaginary axis."""
    x = np.geomspace(1e-8, 1e8, 2001)
    powers = x[:, None] ** np.arange(order + 1)
    return bool((powers @ coefficients[: order + 1] > 0).all() and (powers @ coefficients[order + 1 :] > 0).all())


def _factor(coefficients: Vector, middle: float) -> Vector:
    """Return the monic polynomial in s with roots in the left half plane whose |.|^2 is that in (w/middle)^2."""
    roots = np.roots(coefficients[::-1])
    left = -np.sqrt(-roots.astype(complex))
    return np.real(np.poly(middle * np.where(np.real(left) > 0, -left, left)))
