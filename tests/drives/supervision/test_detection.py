"""Change detection: residuals are white after whitening, sums rise as theory says, thresholds keep their budget."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import DataError, SettingsError
from softneck.drives.supervision._charts_runtime import CHART_CLIP, chart_push, chart_shift, chart_spread
from softneck.drives.supervision._detection import (
    Budget,
    Charts,
    Filter,
    Whitening,
    shift_score,
    thresholds,
    window_maxima,
)


def coloured(rng: np.random.Generator, a: float, n: int) -> np.ndarray:
    x = np.zeros(n)
    e = rng.standard_normal(n)
    for k in range(1, n):
        x[k] = a * x[k - 1] + e[k]
    return x


def lag_one(x: np.ndarray) -> float:
    return float(np.corrcoef(x[1:], x[:-1])[0, 1])


def shifts(e: np.ndarray, mean: float) -> np.ndarray:
    """Scores (time, 1) of a shift by `mean` of innovations of unit variance."""
    return shift_score(e[:, None], np.full((len(e), 1), mean), np.ones(1))[:, None]


# -- whitening --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("a", [0.0, 0.5, 0.9])
def test_what_is_left_is_white_and_the_coefficient_that_of_the_process(a: float) -> None:
    rng = np.random.default_rng(1)
    parts = [coloured(rng, a, 4000), coloured(rng, a, 4000)]
    found = Whitening.fit(parts)
    # Four standard errors of a lag-one correlation over 8000 rows: 4 / sqrt(8000).
    assert abs(lag_one(found.apply(parts[0]))) < 0.045
    assert sum(found.coefficients) == pytest.approx(a, abs=0.07)


def test_no_row_looks_back_across_a_border() -> None:
    """Two stretches at different levels: joined, their border would look like a jump."""
    rng = np.random.default_rng(2)
    parts = [rng.standard_normal(300), 1e6 + np.zeros(300)]
    assert np.isfinite(Whitening.fit(parts).coefficients).all()
    apart = Whitening((0.5,)).apply(np.array([1.0, 2.0, 4.0]))
    np.testing.assert_allclose(apart, [1.5, 3.0])


@settings(max_examples=20, deadline=None)
@given(a=st.lists(st.floats(-0.4, 0.4), min_size=0, max_size=4), seed=st.integers(0, 99))
def test_the_filter_that_runs_along_gives_what_the_whole_gives(a: list[float], seed: int) -> None:
    x = np.random.default_rng(seed).standard_normal(50)
    whitening = Whitening(tuple(a))
    walk = Filter([whitening, Whitening((0.3,))], 2)
    rows = np.array([walk.step(np.array([[v, 0.0], [2.0 * v, v]])) for v in x])
    # Rounding of sums in another order.
    np.testing.assert_allclose(rows[len(a) :, 0, 0], whitening.apply(x), atol=1e-12)
    np.testing.assert_allclose(rows[:, 1, 0], 2.0 * rows[:, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rows[1:, 1, 1], Whitening((0.3,)).apply(x), atol=1e-12)
    assert walk.settled
    walk.reset()
    assert np.all(walk.step(np.ones((2, 2))) == 1.0)


def test_too_little_or_bad_residuals_are_refused() -> None:
    with pytest.raises(DataError, match="finite"):
        Whitening.fit([np.array([1.0, np.nan] * 50)])
    with pytest.raises(DataError, match="needs 20 rows"):
        Whitening.fit([np.ones(10)])


# -- cumulative sums --------------------------------------------------------------------------------------------------


def test_a_sum_rises_by_its_information_with_the_fault_and_falls_by_it_without() -> None:
    """Kullback's number f^2 / (2 v), Basseville and Nikiforov (1993), sec. 2.2."""
    e = np.random.default_rng(3).standard_normal(20_000)
    for f in (0.5, 1.0, -2.0):
        # Three standard errors of the mean: 3 |f| / sqrt(20000).
        assert shifts(e, f).mean() == pytest.approx(-0.5 * f * f, abs=0.022 * abs(f))
        assert shifts(e + f, f).mean() == pytest.approx(0.5 * f * f, abs=0.022 * abs(f))


def test_a_fault_without_effect_says_nothing_and_one_sample_never_decides() -> None:
    one = np.ones(1)
    assert shift_score(np.array([3.0]), np.zeros((1, 1)), one)[0] == 0.0
    # However large: no more than clip and sight allow, 5 * 10 - 12.5.
    assert shift_score(np.array([1e9]), np.array([[1e9]]), one)[0] <= 40.0
    assert shift_score(np.array([-1e9]), np.array([[1.0]]), one)[0] >= -6.0
    # Scores have no unit.
    a = shift_score(np.array([0.7]), np.array([[1.1]]), np.array([2.0]))
    b = shift_score(np.array([7.0]), np.array([[11.0]]), np.array([200.0]))
    np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("ratio", [1.0 / 25.0, 25.0])
def test_a_variance_is_told_from_another(ratio: float) -> None:
    rng = np.random.default_rng(4)
    calm = np.mean([chart_spread(e, 1.0, ratio) for e in rng.standard_normal(2000)])
    other = np.mean([chart_spread(e, 1.0, ratio) for e in np.sqrt(ratio) * rng.standard_normal(2000)])
    assert calm < -0.5
    assert other > 0.5


def test_the_largest_sum_beyond_its_threshold_is_named() -> None:
    charts = Charts(np.array([2.0, 1.0, 5.0]))
    assert charts.step(np.array([1.0, 0.5, 4.0])) == -1
    assert charts.step(np.array([1.5, 1.5, -9.0])) == 0
    assert charts.sums.tolist() == [2.5, 2.0, 0.0]


# -- thresholds -------------------------------------------------------------------------------------------------------


def alarms(scores: np.ndarray, h: float) -> int:
    """Number of alarms, each of which begins anew."""
    total, count = 0.0, 0
    for s in scores:
        total = max(0.0, total + s)
        if total > h:
            total, count = 0.0, count + 1
    return count


def test_thresholds_from_two_minutes_keep_their_budget() -> None:
    """Siegmund's run length of a CUSUM of white noise (Basseville and Nikiforov, eq. 5.2.44) against the budget."""
    run_lengths = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        budget = Budget(rate=1.0 / 36_000.0, charts=1, windows=300)
        h = thresholds([shifts(rng.standard_normal(6000), 1.0)], budget, rng)[0]
        b = h + 1.166
        run_lengths.append(0.02 * (np.exp(b) - 1.0 - b) / 0.5)
        # The fault itself is found after about 2 h samples.
        assert alarms(shifts(1.0 + rng.standard_normal(200), 1.0)[:, 0], h) >= 200 // (3 * h)
    # Carried from two minutes to ten hours: right to a factor of four, as the tail's scale is to a tenth.
    assert 9_000.0 < np.exp(np.mean(np.log(run_lengths))) < 144_000.0


def test_without_whitening_the_textbook_threshold_cries_wolf() -> None:
    """Johnson and Bagshaw (1974): at a correlation of 0.5 alarms come many times as often."""
    rng = np.random.default_rng(6)
    x = coloured(rng, 0.5, 60_000) * np.sqrt(0.75)
    white = Whitening.fit([x]).apply(x)
    often = alarms(shifts(x, 1.0)[:, 0], 5.0)
    seldom = alarms(shifts(white / white.std(), 1.0)[:, 0], 5.0)
    assert often > 3 * max(seldom, 1)
    # Their budget: what block bootstrap finds for it is higher.
    budget = Budget(charts=1, windows=200)
    raw = thresholds([shifts(x[:6000], 1.0)], budget, rng)[0]
    assert raw > 1.3 * thresholds([shifts(white[:6000], 1.0)], budget, rng)[0]


def test_more_charts_share_the_budget() -> None:
    rng = np.random.default_rng(7)
    scores = [shifts(rng.standard_normal(6000), 1.0)]
    one, many = (thresholds(scores, Budget(charts=n, windows=200), np.random.default_rng(0))[0] for n in (1, 40))
    # By the exponential tail: at least ln 40, for a scale of at least one.
    assert many - one >= np.log(40.0) - 1e-9


def test_blocks_never_run_into_the_next_stretch() -> None:
    """A stretch of calm and one of steady rise: a block that began late in one would mix them."""
    calm, rise = np.full((1200, 1), -1.0), np.full((1200, 1), 1.0)
    budget = Budget(block=2.0, window=4.0, windows=200, step=0.02)
    found = window_maxima([calm, rise], budget, np.random.default_rng(8))
    # Blocks of 100, after up to three of them; or one less, where the first step of the window goes down.
    assert set(np.unique(found)) <= {0.0, 99.0, 100.0, 200.0, 300.0}


def test_a_window_of_one_block_follows_one_before_it() -> None:
    budget = Budget(block=2.0, window=2.0, windows=100, step=0.02)
    assert (window_maxima([np.ones((1200, 1))], budget, np.random.default_rng(0)) == 200.0).all()


def test_too_little_motion_is_refused_and_so_are_bad_settings() -> None:
    with pytest.raises(DataError, match=r"need 22 s of undisturbed motion .* there are 3"):
        thresholds([np.zeros((250, 1))], Budget(), np.random.default_rng(0))
    with pytest.raises(DataError, match="finite"):
        thresholds([np.full((3000, 1), np.nan)], Budget(), np.random.default_rng(0))
    with pytest.raises(SettingsError, match="rate"):
        Budget(rate=0.0)


@given(e=st.floats(-50, 50), f=st.floats(-50, 50), v=st.floats(1e-3, 1e3), sight=st.floats(1.0, 9.0))
def test_one_channel_after_the_other_scores_what_all_at_once_do(e: float, f: float, v: float, sight: float) -> None:
    """The scalar code that charts run and the arrays of `shift_score`, of which it is the third of three channels."""
    all_at_once = shift_score(np.array([0.0, 0.0, e]), np.array([[0.0, 0.0, f]]), np.full(3, v), sight=sight)
    # Rounding of a dozen operations on numbers up to (CLIP + sight)^2.
    assert chart_shift(e, f, v, sight) == pytest.approx(float(all_at_once[0]), abs=1e-11)


def test_the_score_of_a_shift_is_bounded_and_no_shift_has_none() -> None:
    assert chart_shift(3.0, 0.0, 1.0, CHART_CLIP) == 0.0
    # Beyond the clip around the fault's mean an innovation tells no more: f (f + 5) - f^2 / 2.
    assert chart_shift(1e9, 2.0, 1.0, CHART_CLIP) == pytest.approx(2.0 * 7.0 - 2.0)


def test_what_is_pushed_comes_first_and_the_last_row_goes() -> None:
    past = np.arange(6.0).reshape(3, 2)
    chart_push(past, np.array([8.0, 9.0]))
    np.testing.assert_array_equal(past, [[8.0, 9.0], [0.0, 1.0], [2.0, 3.0]])
