"""Scores keep the order of their errors, and nothing that was predicted wrongly vanishes from them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from softneck.core import DataError, Matrix, load
from softneck.identification import Model, Rules, Validation, validate
from softneck.identification.models._scores import nrmse_fit, r_squared, rmse, worst_error
from softneck.identification.validation import _baselines, _error_statistics, _score_tables
from softneck.identification.validation._error_statistics import (
    ResidualTests,
    _left_out,
    _path,
    _pointwise,
    calibrated_bounds,
    judged_bounds,
    judged_validity,
    reliability,
    residual_tests,
    useful_parts,
)
from softneck.identification.validation._score_tables import (
    INFINITE,
    Rows,
    _block_sums,
    block_length,
    coverage_tables,
    divergence,
    fit_intervals,
    interval_tables,
    outside_table,
    run_tables,
    score_tables,
)
from softneck.robot import Robot, Scaling

from ...data import ROOT, neck_recording
from ...laws.worlds import View, world
from ...order import is_worse

SCORES: dict[str, Callable[..., float]] = {
    "fits": nrmse_fit, "r2": r_squared, "rmse_deg": rmse, "worst_deg": lambda y, yhat: worst_error(y, yhat)[0],
}  # fmt: skip
TS = 0.02
# Of the tests of residuals.
LAGS, LEVEL = 25, 0.99


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


@pytest.mark.parametrize(("unit", "shown"), [("rad", 1.0), ("deg", 180.0 / math.pi), ("mm", 1e3), ("m", 1.0)])
def test_errors_are_told_in_the_unit_that_outputs_are_shown_in(unit: str, shown: float) -> None:
    si = "rad" if unit in ("rad", "deg") else "m"
    robot = Robot.from_dict({
        "name": "cart", "directions": {"kind": "matrix", "matrix": [[1.0]]},
        "motors": {"names": ["drive"], "unit": "V"},
        "outputs": {"names": ["place"], "unit": si, "display_unit": unit},
    })  # fmt: skip
    rows = replace(rows_of(np.zeros((4, 1))), robot=robot)
    assert rows.to_display_unit(0.25) == pytest.approx(0.25 * shown, rel=1e-12)


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


def test_each_segment_has_scores_of_its_own_rows_and_says_where_it_begins() -> None:
    y, yhat = signals(400)
    rows, lost = rows_of(y, segments=4), [None, 5.5, None, None]
    segments: Any = [
        SimpleNamespace(run=k // 2, scored=np.arange(100) >= 10 * k,
                        recording=SimpleNamespace(time=rows.time[rows.segment == k])) for k in range(4)
    ]  # fmt: skip
    found = run_tables(segments, rows, {INFINITE: y, "1": y}, {INFINITE: yhat, "1": y}, lost)
    assert [(entry["stretch"], entry["run"], entry["diverged"]) for entry in found] == [
        (k, k // 2, lost[k]) for k in range(4)
    ]
    assert [entry["start_s"] for entry in found] == [rows.time[100 * k] for k in range(4)]
    assert [entry["rows_scored"] for entry in found] == [100 - 10 * k for k in range(4)]
    for k, entry in enumerate(found):
        at = rows.segment == k
        for i, name in enumerate(rows.names):
            expected = None if lost[k] else nrmse_fit(y[at, i], yhat[at, i])
            assert entry["fits"][INFINITE][name] == expected
            assert entry["fits"]["1"][name] == 100.0
            row = np.flatnonzero(at)[int(np.argmax(np.abs(y[at, i] - yhat[at, i])))]
            assert lost[k] or entry["worst_time_s"][INFINITE][name] == rows.time[row]


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


@pytest.mark.parametrize("unit", [1e-3, 50.0])
def test_a_simulation_leaves_after_as_many_ranges_in_any_unit(unit: float) -> None:
    """The least range is of the scaled outputs: a robot of millimetres and one of tens of metres are told alike."""
    plain = world("arm", View()).robot
    nominal = (unit * 0.2, unit * 0.4)
    robot = replace(plain, outputs=replace(plain.outputs, nominal=nominal, min=None, max=None))
    scaled = Scaling.of(robot).output_unit
    for width in (0.6, 0.01):
        y = np.outer(np.linspace(-1.0, 1.0, 50), 0.5 * width * scaled)
        rows = replace(rows_of(y), robot=robot)
        reach = 3.0 * max(width, np.radians(5.0))
        for share, expected in ((0.999, None), (1.001, rows.time[20])):
            at = y.copy()
            at[20, 1] = share * reach * scaled[1]
            assert divergence(rows, at) == [expected]


def test_rounding_of_a_set_point_is_not_outside_the_trained_range() -> None:
    y, _ = signals(200)
    least, most = np.array([-1.0, 0.0, -3.0]), np.array([1.0, 4.0, 3.0])
    model: Any = SimpleNamespace(
        kind="rls", robot=Robot.preset(),
        findings={"set_points_rad": {"min": least.tolist(), "max": most.tolist()}},
    )  # fmt: skip
    for share, outside in ((0.5e-6, 0.0), (2e-6, 50.0)):
        for end, sign in ((most, 1.0), (least, -1.0)):
            U = np.tile(0.5 * (least + most), (200, 1))
            U[::2, 1] = end[1] + sign * share * (most[1] - least[1])
            found = outside_table(model, replace(rows_of(y), set_points=U), y)
            assert found == {"pitch": outside, "roll": outside}


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
    # Wider than half of what was measured: said, no number, and the other output keeps its own.
    for wide, other, factors in (("roll", "pitch", [1.0, 13.0]), ("pitch", "roll", [51.0, 1.0])):
        bounds = calibrated_bounds(rows, errors * factors)
        for what in ("path", "pointwise"):
            assert bounds[what] == {other: found[what][other]}
            assert f"no useful {what} bound in {wide}" in bounds["reason"]


def test_reliability_counts_every_row_once_in_its_tenth() -> None:
    predicted = np.array([0.0, 0.05, 0.1, 0.95, 1.0])
    held = np.array([False, True, True, True, False])
    found = reliability(predicted, held)
    assert [entry["rows"] for entry in found] == [2, 1, 2]
    assert [entry["held"] for entry in found] == [0.5, 1.0, 0.5]
    assert found[-1]["predicted"] == pytest.approx(0.975)


# -- residuals --------------------------------------------------------------------------------------------------------


def test_residuals_are_correlated_within_their_segments_at_every_lag_up_to_25() -> None:
    rng = np.random.default_rng(4)
    e, u = rng.standard_normal((300, 2)), rng.standard_normal((300, 3))
    e[7:, 1] += 0.8 * u[:-7, 2]  # the error of roll follows the third input by seven samples
    e[40, 0] = math.nan
    segment = np.repeat([0, 1], 150)
    found = residual_tests(e, u, segment)
    assert found.lags.tolist() == list(range(LAGS + 1))
    assert found.cross_lags.tolist() == list(range(-LAGS, LAGS + 1))
    assert (found.autocorrelation.shape, found.cross_correlation.shape) == ((2, LAGS + 1), (2, 3, 2 * LAGS + 1))

    def by_hand(a: np.ndarray, b: np.ndarray, lag: int) -> float:
        """Sum of late a times early b over both segments, over their sizes."""
        pairs = [(k + lag, k) for k in range(300) if 0 <= k + lag < 300 and segment[k + lag] == segment[k]]
        return sum(a[i] * b[j] for i, j in pairs) / math.sqrt((a @ a) * (b @ b))

    for axis in (0, 1):
        there = np.isfinite(e[:, axis])
        own = np.where(there, e[:, axis] - e[there, axis].mean(), 0.0)
        for lag in (0, 1, LAGS):
            assert found.autocorrelation[axis, lag] == pytest.approx(by_hand(own, own, lag), rel=1e-9, abs=1e-12)
        inputs = np.where(there[:, None], u - u[there].mean(axis=0), 0.0)
        for lag in (-LAGS, -3, 0, 7, LAGS):
            expected = by_hand(own, inputs[:, 2], lag)
            assert found.cross_correlation[axis, 2, LAGS + lag] == pytest.approx(expected, rel=1e-9, abs=1e-12)
        assert found.bound[axis] == pytest.approx(2.5758 / math.sqrt(there.sum()), rel=1e-4)
    assert int(np.argmax(np.abs(found.cross_correlation[1, 2]))) == LAGS + 7
    assert not found.uncorrelated
    # Too few rows say nothing, and that is no pass.
    few = residual_tests(e[: 2 * LAGS], u[: 2 * LAGS], segment[: 2 * LAGS])
    assert np.isnan(few.p_value).all()
    assert not few.white
    assert not few.uncorrelated
    assert np.isfinite(
        residual_tests(e[50 : 51 + 2 * LAGS], u[50 : 51 + 2 * LAGS], segment[50 : 51 + 2 * LAGS]).p_value
    ).all()
    table = found.as_dict(("pitch", "roll"))
    assert table["p_value"] == {"pitch": found.p_value[0], "roll": found.p_value[1]}


@pytest.mark.parametrize(
    ("p", "white"),
    [((1.0 - LEVEL, 1.0), True), ((1.0, 1.0 - LEVEL - 1e-9), False), ((1.0 - LEVEL - 1e-9, 1.0), False),
     ((math.nan, 1.0), False), ((1.0, math.nan), False)],
)  # fmt: skip
def test_residuals_are_white_where_both_outputs_pass(p: tuple[float, float], white: bool) -> None:
    none = np.zeros((2, 3, 2 * LAGS + 1))
    found = ResidualTests(
        np.arange(26), np.zeros((2, 26)), np.ones(2), np.array(p), np.arange(51), none, np.ones((2, 3))
    )
    assert found.white is white
    assert found.uncorrelated is (not any(math.isnan(value) for value in p))
    # Causal lags alone count, each output and each input; at the bound itself it passes.
    for axis, motor, lag, passes in ((0, 0, LAGS, False), (1, 2, 2 * LAGS, False), (1, 1, LAGS - 1, True)):
        cross = none.copy()
        cross[axis, motor, lag] = -2.0
        assert replace(found, p_value=np.ones(2), cross_correlation=cross).uncorrelated is passes


def rls() -> Model:
    return load(ROOT / "tests" / "golden" / "rls.npz")


# -- validity, horizons and blocks ------------------------------------------------------------------------------------


def test_a_validity_is_judged_against_what_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_error_statistics, "has_validity", lambda _: True)
    monkeypatch.setattr(_error_statistics, "tolerance_of", lambda _: np.array([0.1, 0.2]))
    y = np.zeros((6, 2))
    y[5, 1] = math.nan
    # Errors within, pitch beyond, roll beyond, at both tolerances, no number, not measured.
    free = np.array([[0.0, 0.0], [0.11, 0.0], [0.0, 0.21], [0.1, -0.2], [math.nan, 0.0], [0.0, 0.0]])
    chance = np.array([0.9, 0.4, 0.3, 0.8, 0.2, 0.0])
    found = judged_validity(None, rows_of(y), np.column_stack([free, np.full(6, 7.0), chance]))  # pyright: ignore[reportArgumentType]
    assert found is not None
    held = np.array([1.0, 0.0, 0.0, 1.0, 0.0])
    assert (found["least"], found["mean"], found["held"]) == (0.2, pytest.approx(0.52), 0.4)
    assert found["brier"] == pytest.approx(float(np.mean((chance[:5] - held) ** 2)))
    assert found["brier_base_rate"] == pytest.approx(0.4 * 0.6)
    nothing = np.column_stack([free, np.full(6, math.nan)])
    assert judged_validity(None, rows_of(y), nothing) is None  # pyright: ignore[reportArgumentType]
    assert judged_validity(None, rows_of(y), free) is None  # pyright: ignore[reportArgumentType]


def test_blocks_are_of_the_rows_that_are_judged_and_of_every_segment_that_has_some() -> None:
    table = np.zeros((30, 2))
    table[2:9, 0], table[3:8, 1] = 1.0, 2.0  # first segment, of ten rows: seven of them are judged
    table[20:30] = [3.0, 4.0]  # of the second none is, of the third all are
    found = _block_sums(table, np.repeat([0, 1, 2], 10), 3)
    assert found.shape == (17, 2)
    rows = [table[2:9], table[20:30]]
    expected = [sum(part[(k + i) % len(part)] for i in range(3)) for part in rows for k in range(len(part))]
    np.testing.assert_allclose(found, expected)
    assert _block_sums(np.zeros((30, 2)), np.repeat([0, 1, 2], 10), 3).shape == (0, 2)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_block_has_three_correlation_times_of_the_slowest_signal(order: tuple[int, int]) -> None:
    """The autocorrelation of a wave of period T is `(1 - k/n) cos(2 pi k/T)` at lag k, but for its end."""
    rows, segment = 4000, np.zeros(4000, dtype=int)
    lags, waves = np.arange(rows), [np.sin(2.0 * np.pi * np.arange(rows) / period) for period in (25.0, 125.0)]
    quick, slow = (int(np.argmax((1.0 - lags / rows) * np.cos(2.0 * np.pi * lags / period) < 1.0 / np.e))
                   for period in (25.0, 125.0))  # fmt: skip
    signals = np.column_stack(waves)[:, order]
    # Of two signals the slower; its end moves the lag by one at most.
    assert block_length(signals, segment, 1.0) == pytest.approx(3 * slow, abs=3)
    assert block_length(signals[:, :1], segment, 1.0) == pytest.approx(3 * (quick, slow)[order[0]], abs=3)
    # At least five time constants, and at most an eighth of the rows; where both cannot be there is none.
    assert block_length(signals, segment, 60.0) == 300
    assert block_length(signals[:400], segment[:400], 1.0) == 50
    assert block_length(signals, segment, 100.0) == 500
    assert block_length(signals, segment, 100.2) is None
    assert block_length(np.full((80, 1), np.nan), np.zeros(80, dtype=int), 1.0) == 5


def test_every_row_is_predicted_up_to_75000_steps_and_every_nth_beyond() -> None:
    def stride(rows: int, horizon: int) -> int:
        return replace(rows_of(np.zeros((2, 2))), since=np.arange(rows)).stride(horizon)

    assert [stride(75_000, 1), stride(75_001, 1)] == [1, 1]
    assert [stride(7_510, 10), stride(7_511, 10), stride(15_010, 10), stride(15_011, 10)] == [1, 2, 2, 3]
    rows = replace(rows_of(np.ones((60_000, 2))), since=np.arange(60_000))
    kept = np.flatnonzero(np.isfinite(rows.outputs_at(5)).all(axis=1))
    assert kept.tolist() == list(range(5, 60_000, rows.stride(5)))


def test_threads_and_strides_predict_as_one_call_does(monkeypatch: pytest.MonkeyPatch) -> None:
    run = neck_recording(120, seed=8)
    model = rls()
    whole = model.predict(run, 4)
    monkeypatch.setattr(_score_tables, "_WORTH_A_THREAD", 0)
    for workers in (1, 2, 3):
        monkeypatch.setattr(_score_tables.os, "cpu_count", lambda workers=workers: workers)
        np.testing.assert_array_equal(_score_tables.predict(model, [run], 4, motors="simulated"), whole)
        for stride in (2, 7):
            found = _score_tables.predict(model, [run, run], 4, motors="simulated", stride=stride)
            for part in (found[:120], found[120:]):
                rows = np.flatnonzero(np.isfinite(part).all(axis=1))
                assert rows.tolist() == list(range(4, 120, stride))
                # The same arithmetic from the same state.
                np.testing.assert_allclose(part[rows], whole[rows], rtol=1e-9, atol=1e-12)


# -- what is judged ---------------------------------------------------------------------------------------------------


def test_what_cannot_be_judged_is_refused() -> None:
    model, run = rls(), neck_recording(120, seed=8)
    blind = replace(run, channels={name: values for name, values in run.channels.items() if "position" not in name})
    with pytest.raises(DataError, match="needs logged motor positions"):
        validate(model, blind, motors="measured")
    mute = {name: np.full(120, math.nan) if name in ("pitch", "roll") else v for name, v in run.channels.items()}
    with pytest.raises(DataError, match="neither pitch nor roll was ever measured"):
        validate(model, replace(run, channels=mute))
    with pytest.raises(DataError, match="a horizon of 120 samples is longer than what is judged"):
        validate(model, run, horizons=(1, 120, "inf"))
    assert list(validate(model, run, horizons=(119,)).fits) == ["119"]
    assert Rules().include_training is False
    for wrong in (0, -1, 1.5, "far"):
        with pytest.raises(DataError, match="a horizon is a number of samples"):
            Rules(horizons=(wrong,))  # pyright: ignore[reportArgumentType]


def test_without_a_simulation_there_is_none_and_a_row_with_one_output_is_a_row() -> None:
    run = neck_recording(120, seed=8)
    half = run.channels["roll"].copy()
    half[60:70] = math.nan
    found = validate(rls(), replace(run, channels={**run.channels, "roll": half}), horizons=(1, 5))
    assert found.rows_by_horizon == {"1": 95, "5": 95}
    assert found.calibrated_bounds == {"reason": "there is no simulation, or it diverged"}
    assert found.cold_fits == {"pitch": None, "roll": None}
    assert np.isnan(found.free_run).all()
    assert found.diverged is None
    whole = validate(rls(), run, horizons=(1, "inf"))
    assert "1 were given" in whole.calibrated_bounds["reason"]
    assert whole.cold_fits["pitch"] is not None


def test_errors_of_outputs_in_another_unit_than_degrees_are_named_without_one() -> None:
    entry = {"rmse_deg": 1, "r2": 2, "measured_range": 3, "per_run": [{"worst_deg": 4, "fits": 5}]}
    plain = {"rmse": 1, "r2": 2, "measured_range": 3, "per_run": [{"worst": 4, "fits": 5}]}
    cart = Robot.from_dict({
        "name": "cart", "motors": {"names": ["p"], "unit": "kPa"}, "outputs": {"names": ["x"], "unit": "mm"},
        "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip
    for robot, told in ((Robot.preset("neck"), entry), (cart, {**plain, "unit": "mm"})):
        assert Validation.as_dict(SimpleNamespace(robot=robot, _entry=lambda: entry)) == told  # pyright: ignore[reportArgumentType]
    measured = np.array([[-0.002], [np.nan], [0.005]])
    for y, told in ((measured, [-2.0, 5.0]), (measured * np.nan, None)):
        view: Any = SimpleNamespace(robot=cart, measured=y)
        found = cast("Any", Validation.measured_range).fget(view)
        assert found == {"x": told if told is None else pytest.approx(told)}


# -- baselines --------------------------------------------------------------------------------------------------------


def test_a_missed_sample_is_the_last_one_before_it_in_its_own_output() -> None:
    y = np.array([[math.nan, 5.0], [1.0, math.nan], [math.nan, 6.0], [2.0, math.nan]])
    run: Any = SimpleNamespace(outputs=y)
    held = _baselines.held_outputs(run)
    np.testing.assert_array_equal(held, [[math.nan, 5.0], [1.0, 5.0], [1.0, 6.0], [2.0, 6.0]])
    late = _baselines.persistence(run, 2)
    np.testing.assert_array_equal(late, [*held[[0, 0]], *held[:2]])
    assert _baselines.persistence(run, 9).shape == (4, 2)


def test_the_best_linear_fit_is_of_each_output_on_its_own_rows() -> None:
    rng = np.random.default_rng(3)
    X = np.column_stack([np.ones(200), rng.standard_normal((200, 2))])
    y = X @ np.array([[0.1, 2.0], [1.0, -1.0], [0.5, 0.3]]) + 0.1 * rng.standard_normal((200, 2))

    def alone(axis: int, rows: np.ndarray) -> float:
        fit = X[rows] @ np.linalg.lstsq(X[rows], y[rows, axis], rcond=None)[0]
        return nrmse_fit(y[rows, axis], fit)

    every = np.ones(200, dtype=bool)
    assert _baselines._fits(X, y) == pytest.approx([alone(0, every), alone(1, every)])
    for axis in (0, 1):
        gone = y.copy()
        gone[50:90, axis] = math.nan
        rows = np.isfinite(gone[:, axis])
        expected = [alone(0, rows if axis == 0 else every), alone(1, rows if axis == 1 else every)]
        assert _baselines._fits(X, gone) == pytest.approx(expected)
    # Ten rows for each of three parameters are the fewest.
    for rows, known in ((30, True), (29, False)):
        few = np.where(np.arange(200)[:, None] < rows, y, math.nan)
        assert [value is not None for value in _baselines._fits(X, few)] == [known] * 2


def test_each_horizon_has_its_own_best_linear_fit_in_whatever_order_they_are_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = neck_recording(400)
    # Of two columns: all of them have a hundred and take seconds.
    monkeypatch.setattr(_baselines, "_response_columns", lambda u, _: u[:, :2])
    monkeypatch.setattr(_baselines, "_decay_columns", lambda *_: np.zeros((400, 0)))
    segments: Any = [SimpleNamespace(recording=run)]
    rows: Any = SimpleNamespace(robot=run.robot, measured=run.outputs, outputs_at=lambda _: run.outputs)
    alone = [_baselines.best_linear(segments, rows, [horizon])[0] for horizon in (None, 1, 5)]
    assert _baselines.best_linear(segments, rows, [None, 1, 5]) == alone
    assert _baselines.best_linear(segments, rows, [5, 1, None]) == alone[::-1]
    # What was measured a sample before tells more than the set-points alone.
    assert all(one >= five >= free for free, one, five in zip(*alone, strict=True))


def test_a_start_that_decays_as_slowly_as_0_1_to_6_4_scaled_seconds_is_met_in_every_segment() -> None:
    """Seven time constants, an octave apart; one less would blame a model for the state that a segment begins in."""
    part: Any = SimpleNamespace(recording=np.zeros(400))
    columns = _baselines._decay_columns([part, part], 0.02)
    assert columns.shape == (800, 14)
    assert not columns[:400, 7:].any()
    assert not columns[400:, :7].any()
    for seconds in 0.1 * 2.0 ** np.arange(7):
        start = np.exp(-0.02 * np.arange(400) / seconds)
        for rows, own in ((slice(0, 400), slice(0, 7)), (slice(400, 800), slice(7, 14))):
            left = start - columns[rows, own] @ np.linalg.lstsq(columns[rows, own], start)[0]
            assert np.abs(left).max() < 1e-9  # rounding, through columns that are nearly alike
