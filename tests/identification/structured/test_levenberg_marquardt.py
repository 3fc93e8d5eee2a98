"""The search of the grey box within bounds, against scipy's on errors without kinks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from softneck.identification.structured._levenberg_marquardt import Bounds, minimise


def decay(x: np.ndarray) -> np.ndarray:
    t = np.linspace(0.0, 3.0, 60)
    return x[0] * np.exp(-x[1] * t) + x[2] - (2.0 * np.exp(-1.3 * t) + 0.5 + 0.01 * np.sin(40.0 * t))


@pytest.mark.parametrize("high", [3.0, 1.0], ids=["inside", "at a bound"])
def test_it_finds_what_the_trust_region_of_scipy_finds(high: float) -> None:
    low = np.array([0.0, 0.01, -1.0])
    top = np.array([5.0, high, 2.0])
    found = minimise(decay, np.array([1.0, 0.5, 0.0]), Bounds(low, top, np.ones(3)), 60)
    expected = least_squares(decay, [1.0, 0.5, 0.0], bounds=(low, top), xtol=1e-12).x
    # A step that gains less than 1e-4 of the squared error is the last one; the errors are 0.007 of the signal.
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert (found <= top).all()


def test_it_crosses_a_kink() -> None:
    # Minus abs: the slope of the first variable jumps at 1, behind which the error still falls to that of (3, 2).
    def errors(x: np.ndarray) -> np.ndarray:
        return np.array([x[0] + 2.0 * max(x[0] - 1.0, 0.0) - 7.0, 10.0 * (x[1] - abs(x[0] - 1.0))])

    found = minimise(errors, np.array([-2.0, 0.0]), Bounds(np.full(2, -9.0), np.full(2, 9.0), np.ones(2)), 60)
    np.testing.assert_allclose(found, [3.0, 2.0], atol=1e-3)  # as above
