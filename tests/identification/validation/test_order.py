"""Scores keep the order of their errors, and nothing that was predicted wrongly vanishes from them."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from softneck.core import Matrix
from softneck.identification.models._scores import nrmse_fit, r_squared, rmse, worst_error
from softneck.identification.validation._error_statistics import (
    _left_out,
    _path,
    _pointwise,
    calibrated_bounds,
    judged_bounds,
    reliability,
    useful_parts,
)
from softneck.identification.validation._score_tables import (
    INFINITE,
    Rows,
    coverage_tables,
    divergence,
    fit_intervals,
    interval_tables,
    score_tables,
)
from softneck.robot import Robot

from ...order import is_worse

SCORES: dict[str, Callable[..., float]] = {
    "fits": nrmse_fit, "r2": r_squared, "rmse_deg": rmse, "worst_deg": lambda y, yhat: worst_error(y, yhat)[0],
}  # fmt: skip
TS = 0.02


def signals(rows: int = 400) -> tuple[Matrix, Matrix]:
    """Two outputs of unequal size, and predictions of unequal quality."""
    t = np.arange(rows) * TS
    y = np.column_stack([0.3 * np.sin(1.3 * t), 0.1 * np.sin(2.1 * t + 0.4) + 0.02 * t])
    noise = np.random.default_rng(0).standard_normal((rows, 2))
    return y, y + noise * [0.01, 0.02]


def rows_of(measured: Matrix, segments: int = 1) -> Rows:
    n = len(measured)
    segment = np.repeat(np.arange(segments), n // segments)
    return Rows(np.arange(n) * TS, segment, np.arange(n) % (n // segments), measured, np.zeros((n, 3)), Robot.preset())


@pytest.mark.parametrize("name", SCORES)
def test_a_larger_error_at_the_same_signal_never_improves_a_score(name: str) -> None:
    y, yhat = signals()
    score, measured, error = SCORES[name], y[:, 0], (yhat - y)[:, 0]
    values = [score(measured, measured + size * error) for size in (0.0, 0.5, 1.0, 2.0, 4.0)]
    for better, worse in pairwise(values):
        assert is_worse(name, worse, better)
    perfect = {"fits": 100.0, "r2": 1.0, "rmse_deg": 0.0, "worst_deg": 0.0}[name]
    assert values[0] == pytest.approx(perfect, abs=1e-12)
    # One row that is predicted worse than before: of the largest, so that peaks follow as well.
    row = int(np.argmax(np.abs(error)))
    one = measured + error
    one[row] += math.copysign(0.05, error[row])
    assert is_worse(name, score(measured, one), values[2])
    # The order of the rows is none of the score's.
    order = np.random.default_rng(1).permutation(measured.size)
    assert score(measured[order], (measured + error)[order]) == pytest.approx(values[2], rel=1e-9)


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("row", [0, 200, 399])
def test_no_row_that_was_measured_vanishes(name: str, row: int) -> None:
    y, yhat = signals()
    score = SCORES[name]
    whole = score(y[:, 0], yhat[:, 0])
    for lost in (math.nan, math.inf, -math.inf):
        bad = yhat[:, 0].copy()
        bad[row] = lost
        assert is_worse(name, score(y[:, 0], bad), whole)
    # What was not measured is not judged, whatever was predicted there.
    missing = y[:, 0].copy()
    missing[row] = math.nan
    bad = yhat[:, 0].copy()
    bad[row] = 1e9
    kept = np.arange(400) != row
    assert score(missing, bad) == pytest.approx(score(y[kept, 0], yhat[kept, 0]), rel=1e-12)
    nothing = np.full(400, math.nan)
    assert math.isnan(score(nothing, yhat[:, 0]))


def test_a_fit_is_relative_to_the_signal_and_of_its_own_mean() -> None:
    y, yhat = signals()
    for k in (0, 1):
        error, spread = yhat[:, k] - y[:, k], y[:, k] - y[:, k].mean()
        ratio = math.sqrt(float(error @ error) / float(spread @ spread))
        assert nrmse_fit(y[:, k], yhat[:, k]) == pytest.approx(100.0 * (1.0 - ratio), rel=1e-9)
        assert r_squared(y[:, k], yhat[:, k]) == pytest.approx(1.0 - ratio**2, rel=1e-9)
    assert math.isnan(nrmse_fit(np.full(9, 0.1), np.zeros(9)))
    assert math.isnan(r_squared(np.full(9, 0.1), np.zeros(9)))


def test_each_output_has_its_own_scores_with_the_row_of_its_worst_error() -> None:
    y, yhat = signals()
    yhat[17, 0] += 0.5
    yhat[231, 1] -= 0.7
    rows = rows_of(y)
    table = score_tables(rows, rows.time, {"1": y, INFINITE: y}, {"1": yhat, INFINITE: yhat}, lost=False)
    for h in ("1", INFINITE):
        for k, axis in enumerate(("pitch", "roll")):
            pair = y[:, k], yhat[:, k]
            assert table["fits"][h][axis] == nrmse_fit(*pair)
            assert table["r2"][h][axis] == r_squared(*pair)
            assert table["rmse_deg"][h][axis] == pytest.approx(math.degrees(rmse(*pair)))
            assert table["worst_deg"][h][axis] == pytest.approx(math.degrees(worst_error(*pair)[0]))
        assert table["worst_time"][h] == {"pitch": rows.time[17], "roll": rows.time[231]}
    lost = score_tables(rows, rows.time, {"1": y, INFINITE: y}, {"1": yhat, INFINITE: yhat}, lost=True)
    assert lost["fits"]["1"] == table["fits"]["1"]
    for scores in lost.values():
        assert scores[INFINITE] == {"pitch": None, "roll": None}
    bad = yhat.copy()
    bad[5, 1] = math.nan
    said = score_tables(rows, rows.time, {"1": y}, {"1": bad}, lost=False)
    assert said["fits"]["1"]["pitch"] == table["fits"]["1"]["pitch"]
    for name in ("fits", "r2", "rmse_deg", "worst_deg"):
        assert said[name]["1"]["roll"] is None


def test_a_prediction_that_is_no_number_has_no_interval() -> None:
    y, yhat = signals(1200)
    rows = rows_of(y)
    (whole,) = fit_intervals([y], [yhat], rows.segment, 5.0)
    assert whole[0] is not None
    assert whole[1] is not None
    for lost in (math.nan, math.inf):
        bad = yhat.copy()
        bad[700, 1] = lost
        (found,) = fit_intervals([y], [bad], rows.segment, 5.0)
        assert found[1] is None
        assert found[0] is not None
    lost_table = interval_tables(rows, {"1": y, INFINITE: y}, {"1": yhat, INFINITE: yhat}, TS, lost=True)
    assert lost_table[INFINITE] == {"pitch": None, "roll": None}
    assert lost_table["1"]["pitch"] is not None


# -- divergence -------------------------------------------------------------------------------------------------------


def test_a_simulation_has_left_where_any_output_has_and_each_segment_says_when() -> None:
    y, _ = signals(400)
    rows = rows_of(y, segments=4)
    assert divergence(rows, y) == [None] * 4
    gone = y.copy()
    gone[130:, 1] = 10.0
    assert divergence(rows, gone)[:1] == [None]
    assert divergence(rows, gone)[1] == rows.time[130]
    assert divergence(rows, gone)[2:] == [rows.time[200], rows.time[300]]
    for lost in (math.nan, math.inf, -math.inf):
        bad = y.copy()
        bad[250, 0] = lost
        assert divergence(rows, bad) == [None, None, rows.time[250], None]


def test_three_ranges_from_the_middle_are_gone_and_an_angle_at_half_a_turn_as_well() -> None:
    y = np.column_stack([np.linspace(-0.2, 0.6, 50), np.linspace(0.0, 0.1, 50)])
    rows = rows_of(y)
    for k, middle in enumerate((0.2, 0.05)):
        for sign in (-1.0, 1.0):
            for share, expected in ((2.999, None), (3.001, rows.time[20])):
                at = y.copy()
                at[20, k] = middle + sign * share * 0.8
                assert divergence(rows, at) == [expected]
    wide = np.column_stack([np.linspace(-3.0, 3.0, 50), np.zeros(50)])
    for value, expected in ((3.1, None), (3.15, 0.4)):
        at = wide.copy()
        at[20, 0] = value
        assert divergence(rows_of(wide), at) == [pytest.approx(expected) if expected else None]


# -- bounds -----------------------------------------------------------------------------------------------------------


def test_coverage_counts_both_sides_up_to_the_bound_itself() -> None:
    y = np.column_stack([np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0, math.nan])])
    lower = np.column_stack([np.array([0.0, 1.5, 2.0, 0.0]), np.full(4, -1.0)])
    upper = np.column_stack([np.array([0.5, 9.0, 2.0, 2.9]), np.full(4, 1.0)])
    coverage, width = coverage_tables(rows_of(y), y, lower, upper)
    assert coverage == {"pitch": 50.0, "roll": 100.0}
    assert width is not None
    assert width["pitch"] == pytest.approx(math.degrees((0.5 + 7.5 + 0.0 + 2.9) / 4))
    assert width["roll"] == pytest.approx(math.degrees(2.0))
    assert coverage_tables(rows_of(y), y, lower * math.nan, upper) == (None, None)
    # Narrower bounds never cover more.
    narrow, _ = coverage_tables(rows_of(y), y, lower + 1e-9, upper - 1e-9)
    assert narrow is not None
    assert narrow["pitch"] == 0.0


def test_bounds_wider_than_what_was_measured_are_none_and_half_as_wide_are_said() -> None:
    y, _ = signals()
    rows = rows_of(y)
    span = np.ptp(y, axis=0)
    for share, useful in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
        lower, upper = useful_parts(rows, np.zeros_like(y), np.tile(share * span, (400, 1)))
        assert np.isfinite(lower).all() == np.isfinite(upper).all() == useful
    degrees = dict(zip(("pitch", "roll"), np.degrees(span).tolist(), strict=True))
    held = {"pitch": 99.0, "roll": 98.9}
    for share, words in ((0.49, 0), (0.51, 1), (1.01, 1)):
        wide = {"pitch": share * degrees["pitch"], "roll": 0.1 * degrees["roll"]}
        shown, said = judged_bounds(rows, held, wide, promised=False)
        assert len(said) == words
        assert shown is not None
        assert (shown["pitch"] is None) == (share > 1.0)
        assert shown["roll"] == wide["roll"]
    _, said = judged_bounds(rows, held, {"pitch": 0.1, "roll": 0.1}, promised=True)
    assert len(said) == 1
    assert "roll promise" in said[0]
    assert judged_bounds(rows, None, None, promised=True) == (None, [])


@pytest.mark.parametrize("bound", [_path, _pointwise])
def test_a_bound_over_records_never_shrinks_with_an_error_that_grows(bound: Callable[..., float]) -> None:
    rng = np.random.default_rng(2)
    records = [np.abs(rng.standard_normal(40)) for _ in range(12)]
    base = bound(records)
    for number in range(12):
        worse = [2.0 * part if k == number else part for k, part in enumerate(records)]
        assert bound(worse) >= base
        assert bound([*records[number:], *records[:number]]) == base
    assert bound([2.0 * part for part in records]) == pytest.approx(2.0 * base)
    assert bound(records[:8]) == math.inf


def test_a_path_is_held_by_the_ninth_of_nine_and_a_tenth_of_ten_may_lie_beyond() -> None:
    records = [np.array([0.1, float(k)]) for k in range(1, 10)]
    assert _path(records) == 9.0
    assert _path([*records, np.array([10.0])]) == 10.0
    assert _path([*records, *(np.array([float(k)]) for k in range(10, 20))]) == 18.0
    # All samples beyond the first are alike: nine tenths of the weight are reached among the largest.
    assert _pointwise([np.array([1.0]), *(np.array([2.0]) for _ in range(9))]) == 2.0


def test_what_bounds_held_is_of_records_left_out_alone() -> None:
    records = [np.full(4, 1.0) for _ in range(12)]
    near = [np.ones(4, dtype=bool)] * 12
    assert _left_out(records, near, _path, "path") == 100.0
    records[3] = np.array([1.0, 1.0, 1.0, 5.0])
    assert _left_out(records, near, lambda _: 1.0, "path") == pytest.approx(100.0 * 11 / 12)
    assert _left_out(records, near, lambda _: 1.0, "pointwise") == pytest.approx(100.0 * (11 + 0.75) / 12)
    far = [*near[:3], np.array([True, True, True, False]), *near[4:]]
    assert _left_out(records, far, lambda _: 1.0, "path") == 100.0
    assert _left_out(records, far, lambda _: 1.0, "pointwise") == 100.0
    assert _left_out(records, [~part for part in near], lambda _: 1.0, "pointwise") is None
    assert _left_out(records[:9], near[:9], _path, "path") is None


def test_calibrated_bounds_need_nine_records_and_an_error_in_each() -> None:
    n = 20
    y = np.tile(np.linspace(-1.0, 1.0, n), 9)[:, None] * [1.0, 0.5]
    rows = rows_of(y, segments=9)
    errors = np.full((9 * n, 2), 0.01) * [1.0, 2.0]
    found = calibrated_bounds(rows, errors)
    assert (found["records"], found["reason"]) == (9, None)
    assert found["path"]["pitch"]["half_width"] == pytest.approx(math.degrees(0.01))
    assert found["path"]["roll"]["half_width"] == pytest.approx(math.degrees(0.02))
    gone = errors.copy()
    gone[:n, 1] = math.nan
    assert calibrated_bounds(rows, gone)["records"] == 8
    assert "need 9" in calibrated_bounds(rows, gone)["reason"]
    # Wider than half of what was measured: said, and no number.
    loud = errors * [1.0, 13.0]
    found = calibrated_bounds(rows, loud)
    assert "roll" not in found["path"]
    assert "pitch" in found["path"]
    assert "no useful path bound in roll" in found["reason"]


def test_reliability_counts_every_row_once_in_its_tenth() -> None:
    predicted = np.array([0.0, 0.05, 0.1, 0.95, 1.0])
    held = np.array([False, True, True, True, False])
    found = reliability(predicted, held)
    assert [entry["rows"] for entry in found] == [2, 1, 2]
    assert [entry["held"] for entry in found] == [0.5, 1.0, 0.5]
    assert found[-1]["predicted"] == pytest.approx(0.975)
