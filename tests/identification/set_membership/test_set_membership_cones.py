"""The estimator on plain arrays against Algorithm 1 line by line, on any number of threads and without a compiler."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, SettingsError, write_archive
from softneck.identification import Cones, ConeSet, gamma_curve, offending_pair

from .hard_sets import algorithm_1, hard_sets

RULES = ("paper", "milanese_novara")


def unlike_twins(X: np.ndarray, y: np.ndarray) -> float:
    """How far apart the outputs of equal regressors lie: the least epsilon for which there is a gamma."""
    equal = (X[:, None, :] == X).all(axis=2)
    return float(np.where(equal, np.abs(y[:, None] - y), 0.0).max())


def wave(rows: int, noise: float = 0.01, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two outputs of three regressors, slopes at most 3.2 and 1.5."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (rows, 3))
    Y = np.column_stack([np.sin(3 * X[:, 0]) + X[:, 1], X[:, 2] * np.abs(X[:, 0])])
    return X, Y + noise * rng.uniform(-1, 1, Y.shape)


@given(data=hard_sets(least=2), spread=st.sampled_from([0.0, 0.05, 1.0]), rule=st.sampled_from(RULES))
def test_the_bounds_are_those_of_algorithm_1(data: tuple[np.ndarray, np.ndarray], spread: float, rule: str) -> None:
    X, y = data
    epsilon = spread + unlike_twins(X, y)
    fitted = Cones(epsilon=epsilon, rule=rule).fit(X, y)
    size = max(float(np.abs(X).max()), 1e-300)
    queries = np.array([X[0], X.mean(axis=0), X[-1] + 0.3 * size, -5.0 * X[len(y) // 2]])
    low, high = fitted.bounds(queries)
    reach = float(fitted.gamma[0]) * 20.0 * size + float(np.abs(y).max()) + epsilon
    for x, f_l, f_u in zip(queries, low, high, strict=True):
        # 1e-12 relative to the scale: roots by ** or sqrt differ by some ulp of the cones' reach.
        expected = algorithm_1(x, X, y, float(fitted.gamma[0]), epsilon)
        np.testing.assert_allclose((f_l, f_u), expected, rtol=1e-12, atol=1e-12 * reach)
    np.testing.assert_array_equal(fitted.predict(queries), 0.5 * (low + high))


@given(data=hard_sets(least=2), regions=st.sampled_from([2, 4, 16]))
def test_local_gamma_is_the_slope_of_each_region_and_leaves_something_everywhere(
    data: tuple[np.ndarray, np.ndarray], regions: int
) -> None:
    X, y = data
    epsilon = 0.1 * float(np.ptp(y)) + unlike_twins(X, y)
    fitted = Cones(epsilon=epsilon, regions=regions).fit(X, y)
    plain = Cones(epsilon=epsilon).fit(X, y)
    P, v = fitted.points.points, fitted.points.values[0]
    gammas, count = fitted.gammas[0], fitted.gammas.shape[1]
    slopes = np.repeat(gammas, np.diff(np.arange(count + 1) * y.size // count))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = np.sqrt(((P[:, :, None] - P[:, None, :]) ** 2).sum(axis=0))
        needed = np.where(distance > 0, (np.abs(v[:, None] - v) - epsilon) / distance, 0.0).max(axis=1)
    for region in range(count):
        mine = slice(region * y.size // count, (region + 1) * y.size // count)
        # Distances summed in another order: some ulp, and what rise - epsilon cancels.
        assert gammas[region] == pytest.approx(max(needed[mine].max(), 0.0), rel=1e-9, abs=1e-9 * plain.gamma[0])
    assert gammas.max() == plain.gamma[0]
    size = max(float(np.abs(X).max()), 1e-300)
    queries = np.array([X[0], X.mean(axis=0), X[-1] + 0.3 * size])
    low, high = fitted.bounds(queries)
    cones = slopes * np.sqrt(((queries[:, :, None] - P) ** 2).sum(axis=1))
    reach = 20.0 * plain.gamma[0] * size + float(np.abs(y).max()) + epsilon
    np.testing.assert_allclose(low, (v - cones).max(axis=1) - epsilon, rtol=1e-12, atol=1e-12 * reach)
    np.testing.assert_allclose(high, (v + cones).min(axis=1) + epsilon, rtol=1e-12, atol=1e-12 * reach)
    # Never contradictory, never wider than with one gamma.
    assert (low <= high).all()
    wide_low, wide_high = plain.bounds(queries)
    assert (low >= wide_low).all()
    assert (high <= wide_high).all()


def test_a_function_within_the_local_slopes_lies_within_their_bounds() -> None:
    """Flat on the left and steep on the right: with the true slopes the bounds hold, far tighter on the left."""
    rng = np.random.default_rng(3)
    X = np.sort(rng.uniform(-1, 1, 400))[:, None]

    def f(x: np.ndarray) -> np.ndarray:
        return 0.1 * x + 4.0 * np.maximum(x, 0.0) ** 2

    y = f(X[:, 0]) + 0.01 * rng.uniform(-1, 1, 400)
    learned, plain = (Cones(epsilon=0.02, regions=regions).fit(X, y) for regions in (16, 1))
    Q = np.linspace(-1, 1, 501)[:, None]
    # What `gammas` promises: |f(x) - f(w)| <= gamma |x - w| for any x and each sample w of the region. f is convex
    # and increasing: the largest slope from any w is to the right end.
    w = learned.points.points[0]
    slopes = np.array([((f(np.ones(1)) - f(part)) / (1 - part)).max() for part in np.split(w, 16)])
    truth = replace(learned, gammas=slopes[None], epsilon=np.array([0.01]))
    low, high = truth.bounds(Q)
    # 0.01 is the noise's own bound; rounding of numbers of order 4.
    assert ((low - 1e-14 <= f(Q[:, 0])) & (f(Q[:, 0]) <= high + 1e-14)).all()
    assert learned.gammas[0].min() < 0.6 * learned.gamma[0] == 0.6 * plain.gamma[0]


def test_several_outputs_are_one_set_each_and_threads_change_nothing() -> None:
    X, Y = wave(2000)
    Q = np.random.default_rng(1).uniform(-1.5, 1.5, (1500, 3))
    both = Cones(epsilon=0.02, scale=(1.0, 2.0, 0.5)).fit(X, Y)
    low, high = both.bounds(Q, workers=1)
    for output in range(2):
        alone = Cones(epsilon=0.02, scale=(1.0, 2.0, 0.5)).fit(X, Y[:, output])
        np.testing.assert_array_equal(alone.bounds(Q)[0], low[:, output])
        np.testing.assert_array_equal(alone.bounds(Q)[1], high[:, output])
    for workers in (2, 3):
        np.testing.assert_array_equal(both.bounds(Q, workers=workers), (low, high))
    singly = [both.bounds(Q[k : k + 1]) for k in range(0, 1500, 50)]
    np.testing.assert_array_equal(np.concatenate([pair[0] for pair in singly]), low[::50])


@pytest.mark.parametrize("regions", [1, 8])
def test_without_the_compiler_it_is_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch, regions: int) -> None:
    X, Y = wave(300)
    Q = np.random.default_rng(1).uniform(-1.5, 1.5, (50, 3))

    def both() -> tuple[np.ndarray, ConeSet]:
        fitted = Cones(epsilon=0.02, regions=regions, correlated=3).fit(X, Y)
        return np.array(fitted.bounds(Q)), fitted

    fast, fast_set = both()
    for module in ("_gamma", "_forest"):
        monkeypatch.setattr(f"softneck.identification.set_membership.{module}.have_numba", lambda: False)
    slow, slow_set = both()
    np.testing.assert_array_equal(fast, slow)
    np.testing.assert_array_equal(fast_set.gammas, slow_set.gammas)
    np.testing.assert_array_equal(fast_set.usual_width, slow_set.usual_width)


@pytest.mark.parametrize("rule", ["paper", "milanese_novara"])
def test_what_is_not_given_is_the_least_that_the_data_allow(rule: str) -> None:
    X, Y = wave(500)
    by_epsilon = Cones(epsilon=0.02, rule=rule).fit(X, Y[:, 0])
    gamma = float(by_epsilon.gamma[0])
    points = np.ascontiguousarray(X.T)
    assert offending_pair(points, Y[:, 0], gamma, 0.02, rule=rule) is None
    assert offending_pair(points, Y[:, 0], gamma * (1 - 1e-9), 0.02, rule=rule) is not None
    by_gamma = Cones(gamma=gamma, rule=rule).fit(X, Y[:, 0])
    # The same pair decides both; its difference of outputs rounds at 1e-16.
    assert by_gamma.epsilon[0] == pytest.approx(0.02, rel=1e-12)
    assert (Cones(rule=rule).fit(X, Y[:, 0]).gamma[0], 0.0) < gamma_curve(points, Y[:, 0], rule=rule).recommended


def test_milanese_and_novaras_rule_asks_for_less_and_does_not_keep_samples_within_the_bounds() -> None:
    """The paper's f_u(i) >= y(i) implies theirs; not the other way round."""
    X, Y = wave(500)
    y = Y[:, 0]
    paper, theirs = (Cones(epsilon=0.008, rule=rule).fit(X, y) for rule in ("paper", "milanese_novara"))
    assert theirs.gamma[0] < paper.gamma[0]
    for fitted, within in ((paper, True), (theirs, False)):
        low, high = fitted.bounds(X)
        assert ((low <= y + 1e-12) & (y <= high + 1e-12)).all() == within
        # Both sets of feasible systems hold a function: there is room between the bounds everywhere.
        assert (low <= high + 1e-12).all()


def test_the_two_rules_on_two_samples() -> None:
    """Two samples 1 apart in the regressor and in the output, epsilon 0.25: slope 0.75 for one, 0.5 for the other."""
    X, y = np.array([[0.0], [1.0]]), np.array([0.0, 1.0])
    assert Cones(epsilon=0.25).fit(X, y).gamma[0] == 0.75
    fitted = Cones(epsilon=0.25, rule="milanese_novara").fit(X, y)
    assert fitted.gamma[0] == 0.5
    # One function passes both bands, 0.25 + 0.5 x; the sample itself lies above f_u(1) = 0 + 0.25 + 0.5.
    assert fitted.bounds(X)[1][1] == 0.75


def test_what_lies_far_from_the_data_is_told() -> None:
    X, Y = wave(2000)
    fitted = Cones(epsilon=0.02).fit(X, Y)
    fresh = wave(2000, seed=1)[0]
    # 1 % of the data's own widths are beyond their 0.99 quantile, in either output; a fresh sample meets a set with
    # one point more. Three standard deviations of 2,000 draws of 2 % are 1 %.
    assert fitted.outside(fresh).mean() < 0.03
    assert fitted.outside(fresh + 2.0).all()
    # Bounds widen by gamma times the distance from the nearest sample at most.
    assert not fitted.outside(X).any()


def test_neighbours_in_time_do_not_make_the_data_look_dense() -> None:
    t = np.arange(2000) * 0.02
    X = np.column_stack([np.sin(0.7 * t), np.sin(1.1 * t)])
    y = X[:, 0] * X[:, 1]
    separate, motion = (Cones(epsilon=1e-3, correlated=rows).fit(X, y) for rows in (0, 25))
    assert motion.usual_width[0] > 2 * separate.usual_width[0]
    with pytest.raises(DataError, match="`correlated` 1000 leaves nothing of 2000 rows"):
        Cones(epsilon=1e-3, correlated=1000).fit(X, y)


def test_a_set_saved_and_opened_is_the_same(tmp_path: Path) -> None:
    X, Y = wave(300)
    Q = X[::7] + 0.03
    for number, fitted in enumerate((Cones(epsilon=0.02, regions=4).fit(X, Y), Cones(epsilon=0.02).fit(X, Y[:, 0]))):
        path = tmp_path / f"{number}.npz"
        fitted.save(path)
        opened = ConeSet.open(path)
        np.testing.assert_array_equal(opened.bounds(Q), fitted.bounds(Q))
        np.testing.assert_array_equal(opened.outside(Q + 1), fitted.outside(Q + 1))
    write_archive(tmp_path / "other.npz", {"kind": "rls"}, {})
    with pytest.raises(FileFormatError, match="is a file of kind rls; expected cones"):
        ConeSet.open(tmp_path / "other.npz")
    write_archive(tmp_path / "half.npz", {"kind": "cones"}, {"points": np.zeros((1, 3))})
    with pytest.raises(FileFormatError, match="`values` is missing"):
        ConeSet.open(tmp_path / "half.npz")


@pytest.mark.parametrize(
    ("X", "Y", "message"),
    [
        (np.zeros((0, 2)), np.zeros(0), "at least 2 points"),
        (np.zeros((1, 2)), np.zeros(1), "at least 2 points of at least 1 regressor; got 1 x 2"),
        (np.zeros((3, 0)), np.zeros(3), "got 3 x 0"),
        (np.zeros(3), np.zeros(3), r"`X` must have shape \(rows, columns\); got \(3,\)"),
        (np.zeros((3, 2)), np.zeros(4), r"`Y` must have 3 rows, as `X` has, and an output; got \(4, 1\)"),
        (np.array([[0.0], [np.nan]]), np.zeros(2), "`X` must be finite; row 1 is not"),
        (np.array([[0.0], [1.0]]), np.array([np.inf, 0.0]), "`Y` must be finite; row 0 is not"),
        (np.array([["a"], ["b"]]), np.zeros(2), "`X` must be an array of numbers"),
        (np.array([[0.0], [1.0]]), np.ones(2), "the outputs are constant"),
    ],
)
def test_bad_data_is_refused(X: np.ndarray, Y: np.ndarray, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Cones().fit(X, Y)


def test_constant_outputs_with_an_epsilon_are_a_constant() -> None:
    fitted = Cones(epsilon=0.1).fit(np.arange(3.0)[:, None], np.ones(3))
    assert fitted.gamma[0] == 0.0
    np.testing.assert_array_equal(fitted.bounds([[7.0]]), [[0.9], [1.1]])


def test_what_the_data_deny_is_refused_by_naming_the_two_rows() -> None:
    X, y = np.array([[0.0], [1.0], [2.0], [3.0]]), np.array([0.0, 1.0, 4.0, 4.5])
    message = (
        r"gamma 2 with epsilon 0.5 is contradicted by the data .*: between rows 1 and 2 of `X` and `Y` the regressor "
        r"moves by 1 and output 0 is 3 apart. With this epsilon gamma must be at least 2.5;"
    )
    with pytest.raises(DataError, match=message):
        Cones(gamma=2.0, epsilon=0.5).fit(X, y)
    # Below the noise: no gamma at all.
    X[2] = X[1]
    with pytest.raises(
        DataError, match=r"0.5 is below the noise: rows 1 and 2 .* equal regressors and output 0 is 3 apart"
    ):
        Cones(epsilon=0.5).fit(X, y)
    with pytest.raises(DataError, match=r"rows 1 and 2 .* output 1 is 3 apart"):
        Cones(epsilon=0.5, regions=2).fit(X, np.column_stack([X[:, 0], y]))


def test_queries_that_do_not_fit_are_refused() -> None:
    fitted = Cones(epsilon=0.02).fit(*wave(50))
    with pytest.raises(DataError, match=r"`X` must have 3 regressors .* got 2"):
        fitted.predict(np.zeros((1, 2)))
    with pytest.raises(DataError, match="`X` must be finite; row 1 is not"):
        fitted.bounds([[0, 0, 0], [0, np.nan, 0]])
    with pytest.raises(DataError, match="`scale` has 2 weights; the regressor has 3"):
        Cones(scale=(1.0, 2.0)).fit(*wave(50))
    with pytest.raises(DataError, match="one number or one for each output; got 3"):
        Cones(epsilon=(0.1,) * 3, gamma=(9.0,) * 3).fit(wave(50)[0], np.tile(wave(50)[1], (1, 2)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gamma": 0.0}, "`gamma` must be finite and positive; got 0.0"),
        ({"epsilon": -1.0}, "`epsilon` must be finite and at least 0; got -1.0"),
        ({"epsilon": float("nan")}, "`epsilon` must be finite"),
        ({"scale": (1.0, 0.0)}, "`scale` must be finite and positive"),
        ({"rule": "ours"}, "`rule` must be one of paper, milanese_novara"),
        ({"regions": 3}, "`regions` must be a power of two; got 3"),
        ({"regions": 2, "gamma": 1.0}, "each region finds its own gamma"),
        ({"correlated": -1}, "`correlated` must be a whole number"),
        ({"usual": 1.5}, "`usual` must be between 0 and 1"),
    ],
)
def test_wrong_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Cones(**settings)


def test_more_points_than_memory_are_told_before_they_are_built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.identification.set_membership._cones.available_bytes", lambda: 24_000)
    # 3 x 8 bytes x (3 regressors + 2 outputs) a point.
    with pytest.raises(DataError, match=r"a set of 300 points of 3 regressors and 2 outputs .* at most 200 points fit"):
        Cones(epsilon=0.02).fit(*wave(300))
    Cones(epsilon=0.02).fit(*wave(200))
