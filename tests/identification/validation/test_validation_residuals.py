"""Residual tests: as statsmodels on one run, never across runs or gaps, right as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.tsa.stattools import acf, ccf

from softneck.identification import Rls, validate
from softneck.identification.validation._error_statistics import ResidualTests, residual_tests
from softneck.signals import concatenate

from ...data import neck_recording

LAGS = 25


def noise(rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((rows, 2)), rng.standard_normal((rows, 3))


def resid(errors: np.ndarray, inputs: np.ndarray) -> ResidualTests:
    return residual_tests(errors, inputs, np.zeros(len(errors), dtype=int))


@pytest.mark.parametrize("pole", [0.0, 0.6, -0.9])
def test_one_run_without_gaps_is_as_in_statsmodels(pole: float) -> None:
    white, inputs = noise(700, 1)
    errors = np.asarray(lfilter([1.0], [1.0, -pole], white, axis=0)) + 0.3
    ours = resid(errors, inputs)
    for axis, e in enumerate(errors.T):
        # Sums of 700 products in another order (statsmodels' ccf by FFT): 1e-12 is 700 roundings.
        np.testing.assert_allclose(ours.autocorrelation[axis], np.asarray(acf(e, nlags=LAGS, fft=False)), atol=1e-12)
        box = acorr_ljungbox(e, lags=[LAGS])
        assert ours.p_value[axis] == pytest.approx(float(box["lb_pvalue"].iloc[0]), rel=1e-9, abs=1e-300)
        for j, u in enumerate(inputs.T):
            late = np.asarray(ccf(e, u, adjusted=False))[: LAGS + 1]
            early = np.asarray(ccf(u, e, adjusted=False))[: LAGS + 1]
            np.testing.assert_allclose(ours.cross_correlation[axis, j, LAGS:], late, atol=1e-12)
            np.testing.assert_allclose(ours.cross_correlation[axis, j, LAGS::-1], early, atol=1e-12)


def test_no_product_joins_two_runs() -> None:
    """Sums over two runs are the sums of each: against the plain double loop."""
    errors, inputs = noise(130, 2)
    segment = np.repeat([0, 1], [57, 73])
    ours = residual_tests(errors, inputs, segment)
    e, U = errors - errors.mean(axis=0), inputs - inputs.mean(axis=0)
    auto, cross = np.zeros(LAGS + 1), np.zeros(2 * LAGS + 1)
    for s in range(130):
        for t in range(130):
            if segment[s] == segment[t] and 0 <= t - s <= LAGS:
                auto[t - s] += e[t, 0] * e[s, 0]
            if segment[s] == segment[t] and abs(t - s) <= LAGS:
                cross[LAGS + t - s] += e[t, 1] * U[s, 2]
    np.testing.assert_allclose(ours.autocorrelation[0], auto / auto[0], atol=1e-13)
    scale = np.linalg.norm(e[:, 1]) * np.linalg.norm(U[:, 2])
    np.testing.assert_allclose(ours.cross_correlation[1, 2], cross / scale, atol=1e-13)


def test_the_order_of_runs_does_not_matter_and_joining_them_would() -> None:
    first, second = noise(90, 3), noise(160, 4)
    forth = (np.vstack([first[0], second[0]]), np.vstack([first[1], second[1]]))
    there = residual_tests(*forth, np.repeat([0, 1], [90, 160]))
    swapped = (np.vstack([second[0], first[0]]), np.vstack([second[1], first[1]]))
    back = residual_tests(*swapped, np.repeat([0, 1], [160, 90]))
    np.testing.assert_allclose(there.cross_correlation, back.cross_correlation, atol=1e-14)
    np.testing.assert_allclose(there.p_value, back.p_value, rtol=1e-12)
    joined = resid(*forth)
    assert np.abs(joined.cross_correlation - there.cross_correlation).max() > 1e-3


def test_a_gap_keeps_the_distance_of_what_is_around_it() -> None:
    """An echo after 10 samples shows at lag 10 wherever samples are missed; left out, they would shift it."""
    white, inputs = noise(3000, 5)
    errors = white.copy()
    errors[10:] += 0.5 * white[:-10]
    errors[np.random.default_rng(6).random(3000) < 0.2] = np.nan
    peak = resid(errors, inputs).autocorrelation[:, 1:]
    assert (np.argmax(np.abs(peak), axis=1) == 9).all()


@pytest.mark.slow
def test_false_alarms_come_as_often_as_said() -> None:
    tests = [resid(*noise(600, seed)) for seed in range(150)]
    p_values = np.concatenate([t.p_value for t in tests])
    alarms = int((p_values < 0.01).sum())
    # 1 % of 300 axes, 3 expected: a wrong level would have to be lucky beyond 1 in 10,000.
    assert alarms <= binom.ppf(1 - 1e-4, 300, 0.01)
    # The p-value itself is uniform: its mean is 0.5 +- 0.017; four of these.
    assert p_values.mean() == pytest.approx(0.5, abs=0.067)
    # All correlations with inputs together at 99 %: 1.5 of 150 expected.
    assert sum(not t.uncorrelated for t in tests) <= binom.ppf(1 - 1e-4, 150, 0.01)
    # Each single lag leaves its bound with 1 %: 150 * 2 * 25 of them, 75 +- 8.6.
    outside = sum(int((np.abs(t.autocorrelation[:, 1:]) > t.bound[:, None]).sum()) for t in tests)
    assert 40 <= outside <= 110


def test_coloured_errors_are_not_white_and_echoes_of_an_input_are_found() -> None:
    for seed in range(20):
        white, inputs = noise(1500, seed)
        assert not resid(np.asarray(lfilter([1.0], [1.0, -0.3], white, axis=0)), inputs).white
        late = white.copy()
        late[7:, 1] += 0.3 * inputs[:-7, 2]
        said = resid(late, inputs)
        assert not said.uncorrelated
        assert np.argmax(np.abs(said.cross_correlation[1, 2])) == LAGS + 7


def test_an_input_that_follows_the_error_is_feedback_and_no_fault_of_the_model() -> None:
    white, inputs = noise(1500, 9)
    inputs[7:, 2] += 0.5 * white[:-7, 1]
    said = resid(white, inputs)
    assert said.uncorrelated
    assert np.argmax(np.abs(said.cross_correlation[1, 2])) == LAGS - 7


def test_too_few_rows_are_no_proof() -> None:
    said = resid(*noise(2 * LAGS, 1))
    assert not said.white
    assert not said.uncorrelated
    assert np.isnan(said.p_value).all()


def test_validation_tests_each_run_by_itself() -> None:
    runs = [neck_recording(200, seed=s, noise=2e-3) for s in (5, 6)]
    model = Rls(delay=0.06).fit(neck_recording(600, seed=7))
    result = validate(model, concatenate(runs))
    errors, segment = result.measured - result.one_step, result.run
    inputs = np.vstack([run.set_points for run in runs])
    again = residual_tests(errors, inputs, segment)
    np.testing.assert_array_equal(result.residual_tests.cross_correlation, again.cross_correlation)
    assert result.as_dict()["residuals"]["p_value"]["roll"] == again.p_value[1]
