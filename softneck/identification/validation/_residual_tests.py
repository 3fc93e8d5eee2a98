"""Residual tests as MATLAB's `resid`: whiteness, and correlation with the inputs, with 99 % bounds (Ljung 1999, 16.6).

All sums are taken inside each stretch of rows: no product joins two runs. A missed sample adds no product, and those
around it keep their true distance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector

# As in MATLAB's `resid`.
LEVEL, LAGS = 0.99, 25


@dataclass(frozen=True, slots=True, eq=False)
class ResidualTests:
    """What the one-step errors say about what the model has missed.

    Attributes:
        lags: (26,) 0 to 25 samples.
        autocorrelation: (2, 26) of pitch and roll errors.
        bound: (2,) a white error stays within +- this at each lag with 99 %.
        p_value: (2,) of the portmanteau test of lags 1 to 25 (Ljung and Box 1978); NaN where rows are too few.
        cross_lags: (51,) -25 to 25; positive: the error follows the input.
        cross_correlation: (2, 3, 51) of each error with each set-point.
        cross_bound: (2, 3) the same for an error of its own colour that does not depend on the input.
    """

    lags: np.ndarray
    autocorrelation: Matrix
    bound: Vector
    p_value: Vector
    cross_lags: np.ndarray
    cross_correlation: Matrix
    cross_bound: Matrix

    @property
    def white(self) -> bool:
        """Whether both axes pass the portmanteau test at the 99 % level."""
        return bool((self.p_value >= 1.0 - LEVEL).all())

    @property
    def uncorrelated(self) -> bool:
        """Whether no error follows an input at lags 0 to 25: 99 % for all of these tests together (Bonferroni)."""
        if not np.isfinite(self.p_value).all():
            return False
        causal = np.abs(self.cross_correlation[:, :, LAGS:])
        return bool((causal.max(axis=2) <= self.cross_bound * _sigmas(causal.size) / _sigmas(1)).all())

    def as_dict(self, names: Sequence[str] = ("pitch", "roll")) -> dict[str, Any]:
        """Return the arrays as lists, for JSON; `names` are those of the outputs."""
        return {
            "lags": self.lags.tolist(),
            "autocorrelation": self.autocorrelation.tolist(),
            "bound": self.bound.tolist(),
            "p_value": dict(zip(names, self.p_value.tolist(), strict=True)),
            "cross_lags": self.cross_lags.tolist(),
            "cross_correlation": self.cross_correlation.tolist(),
            "cross_bound": self.cross_bound.tolist(),
        }


def residual_tests(errors: Matrix, inputs: Matrix, stretch: np.ndarray) -> ResidualTests:
    """Test errors (time, 2), NaN where there is none, against themselves and inputs (time, 3).

    Args:
        errors: one-step errors.
        inputs: the set-points.
        stretch: (time,) number of the stretch of rows; sorted.
    """
    from scipy.stats import chi2

    edges = np.flatnonzero(np.diff(stretch)) + 1
    axes = errors.shape[1]
    autocorrelation, bound, p_value = np.zeros((axes, LAGS + 1)), np.full(axes, np.nan), np.full(axes, np.nan)
    cross, cross_bound = np.zeros((axes, inputs.shape[1], 2 * LAGS + 1)), np.full((axes, inputs.shape[1]), np.nan)
    for axis, column in enumerate(errors.T):
        there = np.isfinite(column)
        n = int(there.sum())
        if n <= 2 * LAGS:  # too few for a correlation at lag 25
            continue
        e = np.where(there, column - column[there].mean(), 0.0)
        # What the test calls the input is the input at the rows that have an error.
        U = np.where(there[:, None], inputs - inputs[there].mean(axis=0), 0.0)
        parts = list(zip(np.split(e, edges), np.split(U, edges), np.split(there, edges), strict=True))
        pairs = _total(_products(seen.astype(float), seen.astype(float)) for _, _, seen in parts)
        r = _normalised(_total(_products(e_part, e_part) for e_part, _, _ in parts), e, e)
        autocorrelation[axis] = r
        bound[axis] = _sigmas(1) / np.sqrt(n)
        p_value[axis] = chi2.sf(n * (n + 2) * float(np.sum(r[1:] ** 2 / np.maximum(pairs[1:], 1))), LAGS)
        for j, u in enumerate(U.T):
            later = _total(_products(e_part, U_part[:, j]) for e_part, U_part, _ in parts)
            earlier = _total(_products(U_part[:, j], e_part) for e_part, U_part, _ in parts)
            cross[axis, j] = _normalised(np.concatenate([earlier[:0:-1], later]), e, u)
            r_u = _normalised(_total(_products(U_part[:, j], U_part[:, j]) for _, U_part, _ in parts), u, u)
            # Variance of a coloured error's correlation; truncation may leave it below a white one's: it never is.
            variance = max(1.0, 1.0 + 2.0 * float(r[1:] @ r_u[1:]))
            cross_bound[axis, j] = _sigmas(1) * np.sqrt(variance / n)
    lags = np.arange(LAGS + 1)
    return ResidualTests(lags, autocorrelation, bound, p_value, np.arange(-LAGS, LAGS + 1), cross, cross_bound)


def _products(late: Vector, early: Vector) -> Vector:
    """Return `sum_t late(t + k) early(t)` for k = 0..25."""
    n = late.size
    return np.array([float(late[k:] @ early[: n - k]) if k < n else 0.0 for k in range(LAGS + 1)])


def _total(sums: Iterable[Vector]) -> Vector:
    return np.sum(list(sums), axis=0)


def _normalised(sums: Vector, a: Vector, b: Vector) -> Vector:
    return sums / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)


def _sigmas(tests: int) -> float:
    """Return the two-sided 99 % bound of a standard normal, shared by so many tests."""
    from scipy.stats import chi2

    return float(np.sqrt(chi2.ppf(1.0 - (1.0 - LEVEL) / tests, 1)))
