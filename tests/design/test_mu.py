"""Upper bounds of the structured singular value: closed forms, slycot as an oracle, and what a bound promises."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import mu_upper

COMPLEX, REAL = (1, 0), (-1, 0)
# The descent ends where a smoothed maximum is off by log(n)/3000 of the bound: 0.1 %, doubled for its own tolerance.
CLOSE = 2e-3


def _random(n: int, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((count, n, n)) + 1j * rng.standard_normal((count, n, n))


def test_one_full_block_is_the_largest_singular_value() -> None:
    M = _random(3, 20)
    found = mu_upper(M, [(3, 3)])
    expected = np.linalg.norm(M, 2, axis=(1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_of_a_triangular_matrix_only_the_diagonal_counts() -> None:
    M = np.triu(_random(3, 20))
    expected = np.abs(np.einsum("kii->ki", M)).max(axis=1)
    found = mu_upper(M, [COMPLEX] * 3)
    # Scalings of e^-8 leave e^-8 of what stands beside the diagonal.
    np.testing.assert_allclose(found, expected, rtol=5e-3)


def test_of_a_matrix_of_rank_one_it_is_the_sum_of_the_products() -> None:
    rng = np.random.default_rng(1)
    u, v = rng.standard_normal((2, 30, 4)) + 1j * rng.standard_normal((2, 30, 4))
    M = u[:, :, None] * np.conj(v)[:, None, :]
    expected = np.abs(u * np.conj(v)).sum(axis=1)
    found = mu_upper(M, [COMPLEX] * 4)
    np.testing.assert_allclose(found, expected, rtol=CLOSE)


def test_real_scalars_cannot_turn_an_imaginary_loop() -> None:
    """1 - delta j m is never zero for a real delta: mu is 0, where a complex one would give |m|."""
    found = mu_upper(np.array([[2.0j]]), [REAL])
    assert found[0] < 0.05  # of 2; the multiplier g that gives 0 is infinite
    assert mu_upper(np.array([[2.0j]]), [COMPLEX])[0] == pytest.approx(2.0, rel=1e-9)
    assert mu_upper(np.array([[2.0]]), [REAL])[0] == pytest.approx(2.0, rel=CLOSE)


@pytest.mark.slow
@pytest.mark.parametrize(
    "blocks",
    [[COMPLEX] * 3, [COMPLEX] * 5, [(2, 2), COMPLEX], [REAL, COMPLEX, COMPLEX, (2, 2)], [REAL, REAL, COMPLEX]],
    ids=["3 complex", "5 complex", "full", "one real", "two real"],
)
def test_the_bound_is_that_of_slycot(blocks: list[tuple[int, int]]) -> None:
    slycot = pytest.importorskip("slycot")
    sizes = np.array([max(1, abs(rows)) for rows, _ in blocks])
    kinds = np.array([1 if rows < 0 else 2 for rows, _ in blocks])
    M = _random(int(sizes.sum()), 25, seed=2)
    ratio = mu_upper(M, blocks) / np.array([slycot.ab13md(item, sizes, kinds)[0] for item in M])
    assert np.median(ratio) < 1.0 + CLOSE
    # Any scaling gives a valid bound; on single matrices with several reals the descent may stop a little early.
    assert ratio.max() < 1.05
    assert ratio.min() > 1.0 - CLOSE


def test_no_complex_perturbation_smaller_than_the_bound_makes_it_singular() -> None:
    M = _random(3, 8, seed=3)
    found = mu_upper(M, [COMPLEX] * 3)
    rng = np.random.default_rng(4)
    for _ in range(300):
        Delta = np.diag(np.exp(2j * np.pi * rng.random(3)))
        # A common turn makes any eigenvalue real and positive: 1 / its size makes it singular.
        size = np.abs(np.linalg.eigvals(Delta @ M)).max(axis=1)
        assert np.all(size <= found * (1.0 + 1e-9))


def test_real_perturbations_that_make_it_singular_are_no_smaller_than_the_bound_says() -> None:
    """A real M of two real scalars: det(I - k Delta M) is a polynomial in k, solved on a grid of directions."""
    M = np.random.default_rng(5).standard_normal((2, 2))
    found = mu_upper(M, [REAL, REAL])
    best = 0.0
    for angle in np.linspace(0.0, 2.0 * np.pi, 721):
        Delta = np.diag([np.cos(angle), np.sin(angle)])
        Delta /= np.abs(Delta).max()
        eigenvalues = np.linalg.eigvals(Delta @ M)
        real = eigenvalues.real[np.abs(eigenvalues.imag) < 1e-9]
        best = max(best, float(real.max(initial=0.0)))
    assert best <= found[0] * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("M", "blocks", "match"),
    [
        (np.eye(2), [], "empty"),
        (np.eye(2), [(1, 0)], "must be 1 x 1"),
        (np.eye(2), [(-2, 0)], "Repeated scalars are not supported"),
        (np.full((1, 1), np.nan), [(1, 0)], "not finite"),
    ],
)
def test_what_does_not_fit_is_refused(M: np.ndarray, blocks: list[tuple[int, int]], match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        mu_upper(M, blocks)
