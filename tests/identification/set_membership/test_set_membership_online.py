"""Adding and forgetting against the set that is made of the same points at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, SettingsError, write_archive
from softneck.identification import Cones, OnlineCones, gamma_curve

from .hard_sets import algorithm_1


@st.composite
def streams(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, list[int], int | None]:
    """Regressors, two outputs, how many rows come at a time, and the capacity."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    pieces = draw(st.lists(st.sampled_from([1, 1, 2, 3, 16, 40, 90]), min_size=1, max_size=12))
    rows, n = sum(pieces), draw(st.integers(1, 4))
    X = rng.standard_normal((rows, n))
    if draw(st.booleans()):
        # Equal regressors, whose outputs epsilon = 1 allows.
        X = np.round(X)
    return X, rng.uniform(0, 1, (rows, 2)), pieces, draw(st.sampled_from([None, 2, 7, 33, 100]))


def fed(X: np.ndarray, Y: np.ndarray, pieces: list[int], online: OnlineCones) -> OnlineCones:
    done = 0
    for rows in pieces:
        online.add(X[done : done + rows], Y[done : done + rows])
        done += rows
    return online


@pytest.mark.slow
@settings(max_examples=25)
@given(stream=streams(), floor=st.sampled_from([None, 0.5]))
def test_after_any_adding_and_forgetting_it_is_the_set_of_the_points_left(
    stream: tuple[np.ndarray, np.ndarray, list[int], int | None], floor: float | None
) -> None:
    X, Y, pieces, capacity = stream
    online = fed(X, Y, pieces, OnlineCones(epsilon=(1.0, 1.1), gamma=floor, capacity=capacity))
    left = slice(max(0, len(X) - capacity) if capacity else 0, None)
    np.testing.assert_array_equal(online.remembered()[0], X[left])
    np.testing.assert_array_equal(online.remembered()[1], Y[left])
    assert len(online) == len(X[left])
    Q = np.vstack([X[-1:], X[:3] + 0.3, 4 * X[:1]])
    low, high = online.bounds(Q)
    for k, x in enumerate(Q):
        for output, epsilon in enumerate((1.0, 1.1)):
            expected = algorithm_1(x, X[left], Y[left, output], float(online.gamma[output]), epsilon)
            # Sums in one order or another: some ulp of cones up to 100 wide.
            np.testing.assert_allclose((low[k, output], high[k, output]), expected, rtol=0, atol=1e-12)
    if len(X[left]) > 1:
        batch = online.freeze()
        np.testing.assert_array_equal(batch.bounds(Q), (low, high))
        # gamma denies no point left, and without forgetting is the least to the bit.
        least = Cones(epsilon=(1.0, 1.1)).fit(X[left], Y[left]).gamma
        assert (online.gamma >= least).all()
        if capacity is None or len(X) <= capacity:
            np.testing.assert_array_equal(online.gamma, np.maximum(least, floor or 0.0))


@settings(max_examples=25)
@given(stream=streams())
def test_many_at_once_are_as_one_by_one(stream: tuple[np.ndarray, np.ndarray, list[int], int | None]) -> None:
    X, Y, pieces, capacity = stream
    kept = {"epsilon": 0.3, "capacity": capacity, "scale": tuple(np.linspace(1, 2, X.shape[1]))}
    X = X + 1e-3 * np.arange(len(X))[:, None]  # no equal regressors
    together = fed(X, Y, pieces, OnlineCones(**kept))
    singly = fed(X, Y, [1] * len(X), OnlineCones(**kept))
    np.testing.assert_array_equal(together.gamma, singly.gamma)
    np.testing.assert_array_equal(together.bounds(X[:5] + 0.1), singly.bounds(X[:5] + 0.1))


@pytest.mark.slow
def test_trees_are_few_and_a_point_is_rebuilt_a_logarithmic_number_of_times(monkeypatch: pytest.MonkeyPatch) -> None:
    import softneck.identification.set_membership._online as module

    planted: list[int] = []
    original = module.plant

    def counted(points: np.ndarray, values: np.ndarray, ages: np.ndarray) -> object:
        planted.append(ages.size)
        return original(points, values, ages)

    monkeypatch.setattr(module, "plant", counted)
    rng = np.random.default_rng(0)
    online, rows = OnlineCones(epsilon=0.5, capacity=1000), 2500
    for _ in range(rows):
        online.add(rng.standard_normal((1, 3)), rng.uniform(0, 1, 1))
        assert len(online._trees) <= np.log2(len(online) + 1) + 1
    # Up to 16 points are one leaf, renewed with each of them (8.5 on average); then a point moves up one of
    # log2(2000 / 16) = 7 sizes a time, and forgetting renews the oldest tree once it is half empty (1 more a point).
    assert sum(planted) < rows * (1 + 8.5 + 7 + 2)


@pytest.mark.slow
def test_a_drifting_plant_is_tracked_by_the_online_set_and_lost_by_the_frozen_one() -> None:
    """y' = 0.6 y + g u with g from 1 down to 0.5: a neck whose tendons slacken."""
    rng = np.random.default_rng(2)
    rows = 3000
    u = np.repeat(rng.uniform(-1, 1, rows // 10), 10)
    gain = np.interp(np.arange(rows), [500, 2500], [1.0, 0.5])
    y = np.zeros(rows + 1)
    for k in range(rows):
        y[k + 1] = 0.6 * y[k] + gain[k] * u[k] + 1e-3 * rng.uniform(-1, 1)
    X, target = np.column_stack([y[:-1], u]), y[1:]
    online = OnlineCones(epsilon=0.01, capacity=400)
    online.add(X[:500], target[:500])
    frozen = Cones(epsilon=0.01).fit(X[:500], target[:500])
    followed = online.track(X[500:], target[500:])
    late = slice(-500, None)
    error = np.abs(followed.estimate - target[500:])[late]
    lost = np.abs(frozen.predict(X[500:]) - target[500:])[late]
    # The frozen set is off by half of the mean input, 0.25. 20 rows between a regressor and its nearest neighbour in
    # the memory of 400 cost a few hundredths.
    assert np.sqrt(np.mean(lost**2)) > 0.2
    assert np.sqrt(np.mean(error**2)) < 0.25 * np.sqrt(np.mean(lost**2))
    # And it holds its bounds, row by row before it learns the row.
    inside = (followed.lower <= target[500:]) & (target[500:] <= followed.upper)
    assert inside[late].mean() > 0.9
    assert inside[late].mean() > np.mean(np.abs(lost) < 0.01)


def test_gamma_falls_again_once_what_asked_for_it_is_forgotten() -> None:
    X = np.linspace(0, 1, 400)[:, None]
    y = X[:, 0].copy()
    y[50] += 1.0  # an outlier among 0.0025 apart: gamma about 400
    online = OnlineCones(epsilon=0.001, capacity=100)
    online.add(X[:100], y[:100])
    assert online.gamma[0] > 300
    online.add(X[100:], y[100:])
    # |rise| - epsilon over at most a quarter: a little below the slope of 1.
    assert 0.9 < online.gamma[0] < 1.0
    points, values = online.remembered()
    expected = gamma_curve(np.ascontiguousarray(points.T), values[:, 0], np.array([0.001])).gamma[0]
    assert online.gamma[0] == expected


def test_saved_and_opened_it_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    X, Y = rng.standard_normal((500, 3)), rng.standard_normal((500, 2))
    kept = {"epsilon": (0.1, 0.2), "capacity": 90, "scale": (1.0, 2.0, 3.0), "rule": "milanese_novara"}
    through, first = OnlineCones(**kept), OnlineCones(**kept)
    through.add(X, Y)
    first.add(X[:233], Y[:233])
    first.save(tmp_path / "stream.npz")
    opened = OnlineCones.open(tmp_path / "stream.npz")
    np.testing.assert_array_equal(opened.bounds(X[:9]), first.bounds(X[:9]))
    opened.add(X[233:], Y[233:])
    np.testing.assert_array_equal(opened.gamma, through.gamma)
    np.testing.assert_array_equal(opened.bounds(X[:9]), through.bounds(X[:9]))
    assert opened.settings == through.settings
    write_archive(tmp_path / "other.npz", {"kind": "cones"}, {})
    with pytest.raises(FileFormatError, match="kind cones; expected online_cones"):
        OnlineCones.open(tmp_path / "other.npz")
    write_archive(tmp_path / "half.npz", {"kind": "online_cones"}, {})
    with pytest.raises(FileFormatError, match=r"epsilon, gamma, .* missing or damaged"):
        OnlineCones.open(tmp_path / "half.npz")


def test_a_point_that_no_gamma_allows_is_refused_and_leaves_the_set_as_it_was() -> None:
    online = OnlineCones(epsilon=0.1)
    online.add([[0.0], [1.0], [2.0]], [0.0, 1.0, 2.0])
    before = online.bounds([[0.4]]), online.gamma
    with pytest.raises(
        DataError, match=r"points added as number 1 and 4 have equal regressors and output 0 is 0.5 apart"
    ):
        online.add([[3.0], [1.0]], [3.0, 1.5])
    assert len(online) == 3
    np.testing.assert_array_equal(online.bounds([[0.4]]), before[0])
    np.testing.assert_array_equal(online.gamma, before[1])


def test_bad_input_is_refused() -> None:
    online = OnlineCones(epsilon=0.1)
    with pytest.raises(DataError, match="the set is empty; `add` points first"):
        online.predict([[0.0]])
    online.add([[0.0, 1.0]], [[1.0, 2.0]])
    with pytest.raises(DataError, match="`X` must have 2 regressors"):
        online.add([[0.0]], [[1.0, 2.0]])
    with pytest.raises(DataError, match="`Y` must have 2 outputs, as before; got 1"):
        online.add([[0.0, 1.0]], [1.0])
    with pytest.raises(DataError, match="`Y` must be finite"):
        online.add([[0.0, 1.0]], [[np.nan, 1.0]])
    with pytest.raises(DataError, match="at least 2 points; 1 are remembered"):
        online.freeze()
    with pytest.raises(SettingsError, match="`epsilon` must be finite and at least 0"):
        OnlineCones(epsilon=-1.0)
    with pytest.raises(SettingsError, match="`capacity` must be a whole number between 2"):
        OnlineCones(epsilon=0.1, capacity=1)
    with pytest.raises(SettingsError, match="`gamma` must be finite and positive"):
        OnlineCones(epsilon=0.1, gamma=0.0)


def test_without_the_compiler_it_is_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    X, Y = rng.standard_normal((150, 2)), rng.standard_normal((150, 1))

    def run() -> tuple[np.ndarray, np.ndarray]:
        online = OnlineCones(epsilon=0.1, capacity=60)
        online.add(X, Y)
        return np.array(online.bounds(X + 0.1)), online.gamma

    fast = run()
    for module in ("_gamma", "_forest"):
        monkeypatch.setattr(f"softneck.identification.set_membership.{module}.have_numba", lambda: False)
    slow = run()
    np.testing.assert_array_equal(fast[0], slow[0])
    np.testing.assert_array_equal(fast[1], slow[1])
