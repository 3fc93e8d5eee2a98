"""Set membership against a literal transcription of the paper's Algorithm 1."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, SettingsError, load_functions
from softneck.identification import PAPER_EQ21, SetMembership, noise_level
from softneck.identification._regressors import regression

from ..data import neck_recording, recording_from, short_neck

BOUNDS = load_functions("softneck.identification._nlsm_runtime")
CONES = load_functions("softneck.identification._cones_runtime")


def algorithm_1(x: np.ndarray, omega: np.ndarray, y: np.ndarray, gamma: float, epsilon: float) -> tuple[float, float]:
    """Algorithm 1 line by line; omega is (N, n)."""
    f_u, f_l = np.inf, -np.inf
    for k in range(len(y)):
        distance = sum((x[i] - omega[k][i]) ** 2 for i in range(len(x))) ** 0.5
        P_u = y[k] + epsilon + gamma * distance
        P_l = y[k] - epsilon - gamma * distance
        if P_u <= f_u:
            f_u = P_u
        if P_l >= f_l:
            f_l = P_l
    return f_l, f_u


@st.composite
def data_sets(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Small integers half of the time, so that ties and equal points are common."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    shape = (draw(st.integers(1, 30)), draw(st.integers(1, 4)))
    if draw(st.booleans()):
        return rng.integers(-2, 3, shape).astype(float), rng.integers(-2, 3, shape[0]).astype(float)
    return rng.standard_normal(shape), rng.standard_normal(shape[0])


@given(data=data_sets(), gamma=st.sampled_from([0.0, 0.1, 1.0, 7.0]), epsilon=st.sampled_from([0.0, 0.05, 1.0]))
def test_the_bounds_are_those_of_algorithm_1(data: tuple[np.ndarray, np.ndarray], gamma: float, epsilon: float) -> None:
    omega, y = data
    points = np.ascontiguousarray(omega.T)
    for x in (omega[0], omega.mean(axis=0), omega[-1] + 0.3):
        expected = algorithm_1(x, omega, y, gamma, epsilon)
        # Sums of four squares in one order or another: a few ulp of numbers of order ten.
        np.testing.assert_allclose(BOUNDS.nlsm_bounds(points, y, gamma, epsilon, x), expected, rtol=0, atol=1e-12)


@given(data=data_sets(), slack=st.sampled_from([0.0, 0.1, 1.0]))
def test_gamma_is_the_least_over_all_pairs(data: tuple[np.ndarray, np.ndarray], slack: float) -> None:
    omega, y = data
    least = 0.0
    for i in range(len(y)):
        for k in range(len(y)):
            rise, distance = y[i] - y[k] - slack, np.linalg.norm(omega[i] - omega[k])
            if rise > 0:
                least = max(least, rise / distance if distance > 0 else np.inf)
    got = CONES.least_gammas(np.ascontiguousarray(omega.T), y, np.array([slack]), np.zeros((1, 2)))[0]
    if np.isinf(least):
        assert got > 1e200
    else:
        assert got == pytest.approx(least, rel=1e-12)


def test_the_fitted_set_contains_every_point_and_gamma_is_no_larger_than_it_must_be(models: dict) -> None:
    arrays = models["nlsm"].arrays
    for axis in range(2):
        W, y = arrays["points"][axis], arrays["values"][axis]
        gamma, epsilon = arrays["bounds"][axis]
        gap = np.inf
        for i in range(y.size):
            low, high = BOUNDS.nlsm_bounds(W, y, gamma, epsilon, np.ascontiguousarray(W[:, i]))
            # f_l <= y <= f_u at every point, to rounding of y itself.
            assert low - 1e-12 <= y[i] <= high + 1e-12
            gap = min(gap, high - y[i], y[i] - low)
        # The deciding pair touches its bound; 1e-12 as above.
        assert gap == pytest.approx(0.0, abs=1e-12)


def test_the_estimate_lies_in_the_middle_of_its_bounds(models: dict) -> None:
    Y = models["nlsm"].simulate(short_neck())[25:]
    for axis in range(2):
        low, high = Y[:, 5 + 2 * axis], Y[:, 6 + 2 * axis]
        np.testing.assert_allclose(Y[:, axis], (low + high) / 2, rtol=0, atol=1e-14)
        assert (low <= high).all()


def test_the_regressor_is_eq21() -> None:
    r = neck_recording(60)
    X, target = regression(r, PAPER_EQ21, axis=1)
    y, u, M = r.outputs[:, 1], r.set_points, r.motor_positions
    for k in (3, 17, 59):
        row = [y[k - 1], u[k - 2, 0], u[k - 3, 0], u[k - 2, 1], u[k - 3, 1], u[k - 2, 2], u[k - 3, 2], *M[k - 3]]
        np.testing.assert_array_equal(X[k - 3], row)
        assert target[k - 3] == y[k]
    assert len(X) == 57


def test_no_regressor_crosses_a_run() -> None:
    from softneck.signals import concatenate

    parts = [neck_recording(60), neck_recording(50, seed=5), neck_recording(3, seed=6)]
    X, y = regression(concatenate(parts), PAPER_EQ21, 0)
    single = [regression(part, PAPER_EQ21, 0) for part in parts[:2]]
    np.testing.assert_array_equal(X, np.vstack([x for x, _ in single]))
    np.testing.assert_array_equal(y, np.concatenate([t for _, t in single]))


def test_the_noise_level_is_that_of_the_noise() -> None:
    for sigma in (1e-4, 1e-3):
        r = recording_from(np.zeros((4000, 3)), noise=sigma)
        # The median's standard error over 4,000 correlated differences is near 3 %; three of those.
        assert noise_level(r, 0) == pytest.approx(sigma, rel=0.1)


def test_an_epsilon_below_the_noise_is_refused() -> None:
    """At rest regressors repeat to the bit while the noisy output does not: no function passes both."""
    r = neck_recording(400)
    quiet = np.round(r.channels["pitch"], 2)
    quiet[1:] += np.where(np.arange(399) % 2, 0.0, 0.005)
    rest = {f"motor_{what}_{j}": np.where(np.arange(400) < 300, 0.0, r.channels[f"motor_{what}_{j}"])
            for what in ("setpoint", "position") for j in (1, 2, 3)}  # fmt: skip
    pitch = np.where(np.arange(400) < 300, np.where(np.arange(400) % 3 == 0, 0.01, 0.0), quiet)
    with pytest.raises(DataError, match=r"epsilon \[.*\] deg is below the noise: equal regressors"):
        SetMembership(epsilon=1e-4, output_weight=1.0).fit(r.with_channels(pitch=pitch, **rest))


def test_epsilon_and_weight_are_chosen_on_the_data_and_told() -> None:
    model = SetMembership().fit(neck_recording(700))
    assert model.findings["output_weight"] in (3.0, 10.0, 30.0, 57.29577951308232)
    ratio = np.array(model.findings["epsilon_deg"]) / np.array(model.findings["noise_deg"])
    assert ratio[0] == pytest.approx(ratio[1])
    assert round(ratio[0], 9) in (3, 5, 8, 12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"epsilon": 0.0}, "`epsilon` must be positive"), ({"output_weight": -1.0}, "`output_weight` must be positive"),
     ({"form": "residual"}, "`form` must be one of paper_eq21; got 'residual'")],
)  # fmt: skip
def test_wrong_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SetMembership(**settings)
