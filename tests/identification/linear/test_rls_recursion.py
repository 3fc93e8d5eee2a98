"""The recursion in Bierman's form: equal to batch least squares, safe without excitation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, Matrix, SettingsError, Vector
from softneck.identification import Recursion
from softneck.runtime import load_functions

UD = "softneck.identification.linear._ud_runtime"
STANDARD = "tests.oracles.recursion_runtime"


def rows(n: int, count: int, seed: int = 0) -> tuple[Matrix, Vector]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((count, n)), rng.standard_normal(count)


@given(n=st.integers(1, 8), extra=st.integers(0, 300), size=st.sampled_from([0.02, 1.0, 50.0]))
def test_without_forgetting_it_ends_where_least_squares_does(n: int, extra: int, size: float) -> None:
    Phi, y = rows(n, 3 * n + extra, seed=n)
    Phi *= size
    state, _ = Recursion(parameters=n).run(Recursion(parameters=n).initial_state(), Phi, y)
    # What issue 6 asks: 1e-8 of the parameters' size, which is 1/size; the start weighs 1e-12 against size^2 n rows.
    np.testing.assert_allclose(state.theta, np.linalg.lstsq(Phi, y)[0], rtol=0, atol=1e-8 * max(1.0, 1.0 / size))


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
def test_both_forms_are_one_recursion(forgetting: float) -> None:
    Phi, y = rows(4, 200)
    settings = Recursion(parameters=4, forgetting=forgetting, start_covariance=100.0)
    state, _ = settings.run(settings.initial_state(), Phi, y)
    theta, F = np.zeros(4), 100.0 * np.eye(4)
    load_functions(STANDARD).rls_recursion(Phi, y, theta, F, forgetting)
    # The standard form loses eps * cond(F) = 2e-16 * 1e4 at the start, which forgetting lets grow by 0.99^-200 = 7.
    np.testing.assert_allclose(state.theta, theta, rtol=0, atol=1e-10)
    np.testing.assert_allclose(state.covariance, F, rtol=0, atol=1e-10)


def test_forgetting_does_not_wear_the_factors_out() -> None:
    """Rounding makes Eq. 29's F unsymmetric, and forgetting lets that grow by lambda^-t; U D U' cannot be."""
    Phi, y = rows(4, 200)
    w = np.sqrt(0.9 ** np.arange(199, -1, -1))
    wanted = np.linalg.lstsq(Phi * w[:, None], y * w)[0]
    settings = Recursion(parameters=4, forgetting=0.9)
    state, _ = settings.run(settings.initial_state(), Phi, y)
    theta, F = np.zeros(4), 1e8 * np.eye(4)
    load_functions(STANDARD).rls_recursion(Phi, y, theta, F, 0.9)
    # The start is forgotten to 0.9^200 * 1e-12; rounding is left.
    np.testing.assert_allclose(state.theta, wanted, rtol=0, atol=1e-12)
    assert np.abs(theta - wanted).max() > 1e-7


def test_the_recursion_runs_uncompiled_too() -> None:
    Phi, y = rows(5, 300)
    settings = Recursion(parameters=5)
    state, _ = settings.run(settings.initial_state(), Phi, y)
    plain, guards = settings.initial_state(), np.array([1.0, 0.0, 0.0, 0.0, 1.0])
    run = load_functions(UD, compiled=False).ud_guarded
    run(Phi, y, plain.theta, plain.factor, plain.scale, guards, plain.tally, np.zeros((0, 11)))
    # Plain Python sums in the same order, but the compiler may contract a product and a sum.
    np.testing.assert_allclose(plain.theta, state.theta, rtol=0, atol=1e-13)


def test_a_step_for_each_sample_is_the_run() -> None:
    Phi, y = rows(3, 80)
    settings = Recursion(parameters=3, forgetting=0.98, covariance_bound=1e4, dead_zone=0.05, poles=1)
    whole, course = settings.run(settings.initial_state(), Phi, y, keep=True)
    state = settings.initial_state()
    for k in range(80):
        state = settings.step(state, Phi[k], y[k])
        np.testing.assert_array_equal(state.theta, course.theta[k])
        np.testing.assert_allclose(np.diag(state.covariance), course.covariance[k], rtol=1e-9)
    assert state.theta.tobytes() == whole.theta.tobytes()
    assert state.tally.tobytes() == whole.tally.tobytes()
    assert f"{state.theta[0]:.6g}" in state.summary()


def test_the_bound_holds_where_nothing_excites() -> None:
    """Issue 6: forgetting 0.99 on a constant input drove the trace to 1e30; a bound of 1e4 held."""
    rng = np.random.default_rng(1)
    y = np.full(8000, 0.1) + 1e-4 * rng.standard_normal(8000)
    Phi = np.column_stack([-np.roll(y, 1), np.full(8000, 0.5)])
    # The exponential growth ends only where rounding feeds the empty direction.
    free = Recursion(parameters=2, forgetting=0.99, start_covariance=1e3)
    wound, _ = free.run(free.initial_state(), np.tile([[0.1, 0.5]], (9000, 1)), np.full(9000, 0.1))
    assert np.trace(wound.covariance) > 1e25
    bound = Recursion(parameters=2, forgetting=0.99, covariance_bound=1e4)
    held, course = bound.run(bound.initial_state(), Phi, y, keep=True)
    assert course.covariance.sum(axis=1).max() <= 1e4 * (1 + 1e-12)  # rounding of the sum
    assert np.linalg.eigvalsh(held.covariance).min() > 0.0
    # And it still learns when the input moves again.
    u = rng.standard_normal(1500)
    v = np.zeros(1501)
    for k in range(1500):
        v[k + 1] = 0.9 * v[k] + 0.2 * u[k]
    again, _ = bound.run(held, np.column_stack([-v[:-1], u]), v[1:])
    # 1,500 samples forget the past by 0.99^1500 = 3e-7 of an error of order one.
    np.testing.assert_allclose(again.theta, [-0.9, 0.2], atol=1e-5)


def test_in_the_dead_zone_nothing_changes() -> None:
    Phi, y = rows(2, 50)
    settings = Recursion(parameters=2, dead_zone=100.0)
    state, _ = settings.run(settings.initial_state(), Phi, y)
    assert state.theta.tolist() == [0.0, 0.0]
    assert state.tally.tolist() == [0.0, 0.0, 50.0, 0.0]


def test_the_projection_keeps_the_poles_stable() -> None:
    rng = np.random.default_rng(3)
    y = np.cumsum(rng.standard_normal(400)) * np.linspace(1.0, 4.0, 400)  # grows: its best model is unstable
    Phi = np.column_stack([-y[1:-1], -y[:-2], rng.standard_normal(398)])
    free = Recursion(parameters=3, forgetting=0.95)
    _, wild = free.run(free.initial_state(), Phi, y[2:], keep=True)
    kept = Recursion(parameters=3, forgetting=0.95, poles=2)
    state, tame = kept.run(kept.initial_state(), Phi, y[2:], keep=True)

    def radius(theta: Vector) -> float:
        return float(np.abs(np.roots([1.0, *theta[:2]])).max())

    assert max(radius(theta) for theta in wild.theta) > 1.0
    assert max(radius(theta) for theta in tame.theta) < 1.0 + 1e-9  # rounding of the roots
    assert state.tally[3] > 0


@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=5), st.sampled_from([0.9, 1.0]))
def test_the_stability_test_agrees_with_the_roots(a: list[float], radius: float) -> None:
    largest = float(np.abs(np.roots([1.0, *a])).max(initial=0.0))
    if abs(largest - radius) < 1e-3:  # on the border both are rounding
        return
    said = load_functions(UD).is_stable(np.array(a), radius, np.zeros(2 * len(a)))
    assert said == (largest < radius)


def test_standard_deviations_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(5)
    Phi = rng.standard_normal((500, 2))
    y = Phi @ [1.0, -2.0] + 0.3 * rng.standard_normal(500)
    settings = Recursion(parameters=2)
    state, _ = settings.run(settings.initial_state(), Phi, y)
    theta, residues = np.linalg.lstsq(Phi, y)[:2]
    sigma = np.sqrt(residues[0] / 498)
    assert state.noise_std == pytest.approx(sigma, rel=1e-9)
    np.testing.assert_allclose(state.parameter_std, sigma * np.sqrt(np.diag(np.linalg.inv(Phi.T @ Phi))), rtol=1e-8)
    assert np.abs(state.theta - theta).max() < 1e-10


def test_rows_that_were_missed_change_nothing() -> None:
    Phi, y = rows(2, 60)
    settings = Recursion(parameters=2)
    state = settings.initial_state()
    assert settings.step(state, [np.nan, 1.0], 1.0).theta.tolist() == [0.0, 0.0]
    holes = y.copy()
    holes[::7] = np.nan
    np.testing.assert_array_equal(
        settings.run(state, Phi, holes)[0].theta,
        settings.run(state, Phi[np.isfinite(holes)], y[np.isfinite(holes)])[0].theta,
    )


def test_what_is_wrong_is_named() -> None:
    for value in (0.0, -0.5, 1.01):
        with pytest.raises(SettingsError, match="`forgetting` must be"):
            Recursion(parameters=2, forgetting=value)
    settings = Recursion(parameters=2)
    with pytest.raises(DataError, match=r"`regressors` must be \(rows, 2\)"):
        settings.run(settings.initial_state(), np.zeros((5, 3)), np.zeros(5))
    with pytest.raises(DataError, match="`theta` must have 2 entries"):
        Recursion(parameters=2).initial_state([1.0])


def test_it_is_the_course_of_statsmodels() -> None:
    """Their filter starts diffuse; ours from 1e12, which the first rows of unit size leave behind."""
    module = pytest.importorskip("statsmodels.regression.recursive_ls")
    Phi, y = rows(3, 60)
    settings = Recursion(parameters=3)
    _, course = settings.run(settings.initial_state(), Phi, y, keep=True)
    theirs = module.RecursiveLS(y, Phi).fit().recursive_coefficients.filtered.T
    # Its diffuse start is 1e6, so it is off by parts of 1e-6 until many rows are in.
    np.testing.assert_allclose(course.theta[10:], theirs[10:], rtol=0, atol=1e-5)


def test_a_course_ends_in_the_state() -> None:
    Phi, y = rows(2, 60)
    settings = Recursion(parameters=2, forgetting=0.99)
    state, course = settings.run(settings.initial_state(), Phi, y, keep=True)
    std = state.noise_std * np.sqrt(course.covariance)
    # The last row's band is what the state itself says.
    np.testing.assert_allclose(std[-1], state.parameter_std, rtol=1e-12)
