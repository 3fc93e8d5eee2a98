"""A family tested against data: order and dead time, a weight that holds the truth, its band, and invalidation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import DataError, FileFormatError, load
from softneck.identification import Family
from softneck.identification.linear._srivc_fit import Continuous, SrivcFitOptions
from softneck.identification.models._directions import Directions
from softneck.identification.uncertainty._measured import (
    AxisMeasured,
    axis_points,
    axis_runs,
    band_borders,
    choose_order,
    covering_weight,
    judge_records,
    least_uncertainty,
    measured_responses,
    middle_model,
    needed_lines,
    nominal_output,
    raise_weight,
    recordings_without_response,
    response_of,
)
from softneck.signals import SET_POINTS, Recording, concatenate, multisine_experiments, redefinition_matrix

TS = 0.02
DIRECTIONS = Directions(("pitch", "roll"), redefinition_matrix()[:2], np.full(2, 0.2), learned=False)
ONE = Continuous(a=np.array([5.0]), b=np.array([0.5]), delay=0.06)
TWO = Continuous(a=np.array([11.0, 30.0]), b=np.array([3.0]), delay=0.05)
THREE = Continuous(a=np.array([15.0, 74.0, 120.0]), b=np.array([12.0]), delay=0.04)


def played(plant: Continuous, *, amplitude: float = 1.0, seed: int = 0, noise: float = 2e-4) -> Recording:
    """Two realisations of multisines on a plant whose roll answers as its pitch does."""
    rng = np.random.default_rng(seed)
    runs = []
    for item in multisine_experiments(amplitude=amplitude, band=(0.8, 20.0), realisations=2, seed=seed):
        T = redefinition_matrix()
        y = [nominal_output(plant, item.set_points @ T[axis], TS) for axis in (0, 1)]
        channels = dict(zip(SET_POINTS, item.set_points.T, strict=True))
        channels |= {name: part + noise * rng.standard_normal(part.size) for name, part in zip(("pitch", "roll"), y)}  # noqa: B905
        runs.append(Recording(item.time, TS, channels))
    return concatenate(runs)


def measured(recordings: list[Recording], start: Continuous, *, cover: bool = True) -> tuple[AxisMeasured, np.ndarray]:
    """What the recordings show of pitch."""
    responses, why = measured_responses(recordings, "set_points")
    assert why == []
    points = axis_points(responses, 0, DIRECTIONS, 0.95)
    model = middle_model(start, points, TS, 0.3)
    w, weight = covering_weight(model, points, TS)
    found = AxisMeasured(
        model=model, held_out=np.full(3, np.nan), points=points, frequency=w, weight=weight,
        borders=band_borders(float(w[0]), float(w[-1])), needed=np.zeros((0, 0)),
    )  # fmt: skip
    found = replace(found, needed=judge_records(axis_runs(recordings, DIRECTIONS, "set_points", 0), found, points, TS))
    return (raise_weight(found) if cover else found), points


@pytest.fixture(scope="module")
def spread() -> list[Recording]:
    """Three payloads: gains of 0.8 to 1.25, small and large."""
    return [played(replace(TWO, b=k * TWO.b), amplitude=A, seed=n) for n, (k, A) in enumerate(((0.8, 0.5), (1.25, 2)))]


@pytest.mark.parametrize("plant", [ONE, TWO, THREE], ids=["one pole", "two", "three"])
def test_order_and_dead_time_are_found_by_the_free_run_on_what_is_held_out(plant: Continuous) -> None:
    run = axis_runs([played(plant)], DIRECTIONS, "set_points", 0)[0][:2]
    search = SrivcFitOptions(sample_time=TS, offset=True, max_delay=0.3)
    model, rms = choose_order(search, run, replace(ONE, delay=0.08))
    assert model is not None
    assert model.a.size == plant.a.size
    # Noise of 2e-4 rad on motions of 0.1 rad: a millisecond for two poles, some for the third, which is nearly a delay.
    assert model.delay == pytest.approx(plant.delay, abs=0.004)
    assert rms[plant.a.size - 1] == pytest.approx(2e-4, rel=0.1)


def test_a_model_s_output_is_that_of_python_control() -> None:
    import control

    u = np.random.default_rng(0).standard_normal(200)
    G = control.sample_system(control.TransferFunction([3.0], [1.0, 11.0, 30.0]), TS, "zoh")
    whole = replace(TWO, delay=0.04)
    # The sampled plant's numerator is one shorter than its denominator: a sample of its own, and two of dead time.
    expected = lfilter(np.squeeze(G.num[0][0]), np.squeeze(G.den[0][0]), np.concatenate([np.zeros(3), u[1:]])[:200])
    got = nominal_output(whole, np.concatenate([[0.0], u[1:]]), TS)
    np.testing.assert_allclose(got[1:], expected[:-1], atol=1e-9)


def test_the_weight_holds_every_plant_that_was_recorded_in_the_band(spread: list[Recording]) -> None:
    found, points = measured(spread, TWO)
    low, high = found.band
    # Lines from 0.8 to 20 rad/s; answers at the upper end are 0.01 rad and known to 2e-4.
    assert low < 1.0
    assert high > 15.0
    assert set(points[:, 0]) == {0.0, 1.0}
    w = np.geomspace(low, high, 500)
    W = np.interp(np.log(w), np.log(found.frequency), found.weight)
    for k in (0.8, 1.25):
        G = response_of(replace(TWO, b=k * TWO.b), w, TS)
        error = np.abs(G / response_of(found.model, w, TS) - 1.0)
        # Each circle has 95 %; a line of the weight joins points 5 % of frequency apart.
        assert np.mean(error <= W) > 0.95
        assert np.max(error / W) < 1.1
    # The middle of 0.8 and 1.25 is some 22 % away from both: a weight of ones would hold them as well.
    assert np.median(found.weight) < 0.35
    assert np.nanmax(found.needed) <= 1.0 + 1e-9 or needed_lines(found, ["a", "b"], "pitch") != []


def test_a_circle_too_wide_to_be_supported_says_nothing_between_those_that_are(spread: list[Recording]) -> None:
    """It made weights of 1.4 at 4 rad/s on a neck whose other recordings know it there to 0.4."""
    response = measured_responses(spread[:1], "set_points")[0][0]
    assert response is not None
    wide = response.covariance.copy()
    wide[10:13] *= 1e4
    kept, fewer = (axis_points([item], 0, DIRECTIONS, 0.95) for item in (response, replace(response, covariance=wide)))
    assert len(fewer) == len(kept) - 3
    # Without those lines the weight is what their neighbours leave, and the band the same.
    (w, all_of_them), (same, weight) = (covering_weight(TWO, points, TS) for points in (kept, fewer))
    np.testing.assert_allclose(same, w)
    assert weight.max() <= 1.05 * all_of_them.max()


def test_a_plant_that_the_family_lacks_is_found_out_in_its_band(spread: list[Recording]) -> None:
    found, _ = measured(spread, TWO)
    late = played(replace(TWO, delay=0.15), seed=7)
    responses, _ = measured_responses([late], "set_points")
    points = axis_points(responses, 0, DIRECTIONS, 0.95)
    needed = judge_records(axis_runs([late], DIRECTIONS, "set_points", 0), found, points, TS)
    # 0.1 s of dead time more is a relative error of 2 sin(0.05 w): nothing at 1 rad/s, 0.8 at 8.
    assert needed[0, 0] < 1.0
    assert np.nanmax(needed[0, -3:]) > 2.0
    line = needed_lines(replace(found, needed=needed), ["late.csv"], "pitch")[0]
    assert line.startswith("pitch: late.csv needs ")
    assert "times the weight at" in line
    # One of its own is not found out.
    same = played(TWO, seed=9)
    own = judge_records(axis_runs([same], DIRECTIONS, "set_points", 0), found, points, TS)
    assert np.nanmax(own) < 1.0


def test_the_least_uncertainty_is_the_relative_error_of_a_linear_plant() -> None:
    """Twice the gain of the nominal is an uncertainty of 1, whatever the weight: 1/W times it."""
    # Up to 8 rad/s: what is far above is taken for noise.
    t, rng = np.arange(4000) * TS, np.random.default_rng(1)
    u = np.sin(np.outer(t, np.linspace(0.5, 8.0, 40)) + rng.uniform(0.0, 6.0, 40)).sum(axis=1)
    y = nominal_output(replace(ONE, b=2.0 * ONE.b), u, TS)
    w = np.array([0.1, 100.0])
    for weight in (0.5, 1.0, 2.0):
        found = least_uncertainty([(u, y)], ONE, w, np.full(2, weight), (1.0, 5.0), TS)
        # No noise but rounding; the window leaks 1e-3 of the neighbours.
        assert found == pytest.approx(1.0 / weight, rel=0.01)


def test_noise_alone_invalidates_nothing() -> None:
    rng = np.random.default_rng(2)
    u = rng.standard_normal(4000)
    y = nominal_output(ONE, u, TS) + 0.02 * rng.standard_normal(4000)
    # The noise is 40 % of the answer here; its bound leaves a tenth of the weight by chance.
    assert least_uncertainty([(u, y)], ONE, np.array([0.1, 100.0]), np.ones(2), (5.0, 10.0), TS) < 0.1


def test_where_a_record_needs_more_the_weight_is_raised() -> None:
    found, _ = measured([played(TWO)], TWO, cover=False)
    needs = np.full((1, found.borders.size - 1), 0.5)
    needs[0, 1] = 3.0
    more = raise_weight(replace(found, needed=needs))
    inside = (found.frequency > found.borders[1]) & (found.frequency < found.borders[2])
    np.testing.assert_allclose(more.weight[inside], 3.0 * found.weight[inside])
    np.testing.assert_allclose(more.weight[-5:], found.weight[-5:])


def test_a_recording_that_moves_an_axis_and_shows_nothing_is_named() -> None:
    """Seen on a foreign neck: slack tendons at 1 kg; half the recordings were in no weight, and nobody said so."""
    loud, slack = played(TWO), played(replace(TWO, b=1e-5 * TWO.b), seed=1)
    one_axis = played(TWO, seed=2)
    still = [[(np.zeros_like(u), y) for u, y in parts] for parts in axis_runs([one_axis], DIRECTIONS, "set_points", 1)]
    parts, names = [loud, slack, one_axis], ["loud", "slack", "one axis"]
    responses, why = measured_responses(parts, "set_points")
    assert why == []
    for axis in (0, 1):
        points = axis_points(responses, axis, DIRECTIONS, 0.95)
        runs = axis_runs(parts, DIRECTIONS, "set_points", axis)
        assert recordings_without_response(points, runs, names) == ["slack"]
        # What never moved the axis need not show anything of it.
        others = points[points[:, 0] != 2.0]
        assert recordings_without_response(others, [*runs[:2], *still], names) == ["slack"]
    family = replace(_family(), findings={"tested": {"names": ["a"], "unheard": {"pitch": ["slack"]}}})
    assert "pitch: slack moves it and shows no response known within 30 %" in family.summary()


def _family() -> Family:
    old = load(GOLDEN, role="family")
    assert isinstance(old, Family)
    found, _ = measured([played(TWO)], TWO)
    return replace(old, measured={"pitch": found})


GOLDEN = Path(__file__).parents[2] / "golden" / "family.npz"


def test_a_file_of_before_loads_and_says_that_it_was_not_tested(tmp_path: Path, spread: list[Recording]) -> None:
    old = load(GOLDEN, role="family")
    assert isinstance(old, Family)
    assert "pitch: not tested against data" in old.summary()
    assert old.band("pitch") is None
    with pytest.raises(DataError, match="not tested against data"):
        old.invalidated_by([], [])
    found, _ = measured(spread, TWO)
    tested = {"confidence": 0.95, "names": ["a.csv", "b.csv"], "why": []}
    new = replace(old, measured={"pitch": found}, findings={**old.findings, "tested": tested})
    new.save(tmp_path / "f.npz")
    again = load(tmp_path / "f.npz", role="family")
    for name, array in found.arrays().items():
        np.testing.assert_array_equal(again.measured["pitch"].arrays()[name], array)
    assert "the data excite" in again.summary()
    assert "roll: not tested against data" in again.summary()
    arrays = found.arrays()
    with pytest.raises(FileFormatError, match="`weight` has shape"):
        AxisMeasured.from_arrays({**arrays, "weight": np.ones(3)}, 2)
    with pytest.raises(FileFormatError, match="none of ours"):
        AxisMeasured.from_arrays({**arrays, "frequency": -arrays["frequency"]}, 2)
