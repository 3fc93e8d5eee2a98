"""MRG32k3a: the published generator, the same bits compiled and not, and numbers that look as they should."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.runtime import load_functions

RUNTIME = "softneck.runtime._random_runtime"
PLAIN = load_functions(RUNTIME, compiled=False)
FAST = load_functions(RUNTIME)
N = 20_000


def stream(functions: object, seed: float, count: int, what: str = "random_uniform") -> np.ndarray:
    state = np.zeros(6)
    functions.random_seed(state, seed)  # type: ignore[attr-defined]
    return np.array([getattr(functions, what)(state) for _ in range(count)])


def test_the_first_number_is_the_published_one() -> None:
    # L'Ecuyer's own implementation starts from six times 12345 and prints 15 digits of its first number.
    assert PLAIN.random_uniform(np.full(6, 12345.0)) == pytest.approx(0.127011122046577, abs=5e-16)


def test_the_recursion_is_that_of_integers() -> None:
    """The float arithmetic against Python's integers, which are exact."""
    s = [12345, 23456, 34567, 45678, 56789, 67890]
    state = np.array(s, dtype=float)
    m1, m2 = 2**32 - 209, 2**32 - 22853
    for _ in range(2000):
        a = (1403580 * s[1] - 810728 * s[0]) % m1
        b = (527612 * s[5] - 1370589 * s[3]) % m2
        s = [s[1], s[2], a, s[4], s[5], b]
        assert PLAIN.random_uniform(state) == ((a - b) % m1 or m1) / (m1 + 1)
        assert state.tolist() == s


@given(seed=st.integers(0, 2**31))
def test_compiled_and_plain_give_the_same_bits(seed: int) -> None:
    for what in ("random_uniform", "random_normal"):
        assert stream(PLAIN, seed, 20, what).tobytes() == stream(FAST, seed, 20, what).tobytes()


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 3, 2**31 - 2, 2**31 - 1, 2**31])
def test_no_seed_stops_the_generator(seed: int) -> None:
    """A state of zeros would repeat one number for ever, and the polar method would never return."""
    assert np.unique(stream(PLAIN, seed, 50)).size == 50


def test_seeds_differ_and_repeat() -> None:
    assert stream(FAST, 1, 9).tobytes() == stream(FAST, 1, 9).tobytes()
    assert not np.intersect1d(stream(FAST, 1, 500), stream(FAST, 2, 500)).size


def test_uniform_numbers_are_uniform() -> None:
    u = stream(FAST, 5, N)
    assert 0.0 < u.min() < u.max() < 1.0
    # The mean's standard deviation is 1/sqrt(12 N), that of the variance 1/sqrt(180 N); five of each.
    assert u.mean() == pytest.approx(0.5, abs=5 / np.sqrt(12 * N))
    assert u.var() == pytest.approx(1 / 12, abs=5 / np.sqrt(180 * N))


def test_normal_numbers_are_normal_and_uncorrelated() -> None:
    z = stream(FAST, 7, N, "random_normal")
    # Standard deviations of the estimates: mean 1/sqrt(N), variance sqrt(2/N), kurtosis sqrt(96/N), lag 1/sqrt(N).
    assert z.mean() == pytest.approx(0.0, abs=5 / np.sqrt(N))
    assert z.var() == pytest.approx(1.0, abs=5 * np.sqrt(2 / N))
    assert np.mean(z**4) == pytest.approx(3.0, abs=5 * np.sqrt(96 / N))
    for lag in (1, 2, 3):
        assert np.mean(z[lag:] * z[:-lag]) == pytest.approx(0.0, abs=5 / np.sqrt(N))
