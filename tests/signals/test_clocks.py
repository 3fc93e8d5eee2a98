"""Times of foreign logs: several clocks, rates that are summed up, dates; and what they refuse."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError
from softneck.signals import guess_layout, import_log
from softneck.signals.importing._clocks import axis_rotations, integrate_rates, merge_clocks
from softneck.signals.importing._guess_units import judge
from softneck.signals.importing._layout import Source, Term
from softneck.signals.importing.formats._mat import mat_arrays
from softneck.signals.importing.formats._text import is_date, seconds
from softneck.signals.recording._resampling import Samples, find_gaps, jitter

from ..data import neck_recording
from .log_writers import from_angles
from .test_formats import columns, named


def test_messages_of_several_clocks_meet_at_the_rows_of_the_outputs() -> None:
    """Angles each 20 ms; set-points each 50 ms, which hold; positions each 30 ms, on lines, missed in a gap."""
    clocks = {"pitch": 0.02 * np.arange(60), "motor_setpoint_1": 0.05 * np.arange(24) + 0.005,
              "motor_position_1": np.delete(0.03 * np.arange(41), slice(10, 16)) + 0.001}  # fmt: skip
    time = np.unique(np.concatenate(list(clocks.values())))
    channels = {name: np.where(np.isin(time, t), np.round(3.0 * time, 12), np.nan) for name, t in clocks.items()}
    found, note = merge_clocks(Samples(time, np.zeros(time.size, dtype=int), channels), ("pitch", "roll"))
    assert "59 of" in note  # the first angle comes before the first set-point
    np.testing.assert_array_equal(found.time, clocks["pitch"][1:])
    last = np.searchsorted(clocks["motor_setpoint_1"], found.time, side="right") - 1
    np.testing.assert_allclose(found.channels["motor_setpoint_1"], 3.0 * clocks["motor_setpoint_1"][last], rtol=1e-12)
    t, x = found.time, found.channels["motor_position_1"]
    gap = (t > 0.271) & (t < 0.481)
    np.testing.assert_array_equal(np.isnan(x), gap | (t > 1.201))
    np.testing.assert_allclose(x[np.isfinite(x)], 3.0 * t[np.isfinite(x)], rtol=1e-12)  # a line stays one


def test_a_channel_that_was_never_told_cannot_be_merged() -> None:
    time = np.arange(5.0)
    with pytest.raises(DataError, match="`motor_setpoint_1` holds no number in any row"):
        merge_clocks(
            Samples(time, np.zeros(5, dtype=int), {"pitch": time, "motor_setpoint_1": time * np.nan}), ("pitch",)
        )
    late = {"pitch": np.array([1, 1, np.nan]), "motor_setpoint_1": np.array([np.nan, np.nan, 1])}
    with pytest.raises(DataError, match="no row has both an output and all set-points before it"):
        merge_clocks(Samples(np.arange(3.0), np.zeros(3, dtype=int), late), ("pitch",))


@given(rates=st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=12), missed=st.integers(1, 2))
def test_rates_on_straight_lines_sum_up_exactly_and_each_run_begins_at_zero(rates: list[float], missed: int) -> None:
    time = np.cumsum(np.linspace(0.01, 0.03, len(rates)))  # uneven, as logged
    v = rates[0] + rates[1] * time
    there = v.copy()
    there[missed] = np.nan  # lies on the line between its neighbours
    run = np.repeat([0, 1], len(rates))
    samples = Samples(np.tile(time, 2), run, {"motor_setpoint_1": np.tile(there, 2)})
    found, _ = integrate_rates(samples, {"motor_setpoint_1": Source((Term("v"),), "rad/s", integrate=True)})
    exact = rates[0] * (time - time[0]) + rates[1] * (time**2 - time[0] ** 2) / 2.0
    # Trapezoids are exact on lines: what is left is the rounding of a dozen sums.
    np.testing.assert_allclose(found.channels["motor_setpoint_1"], np.tile(exact, 2), rtol=0, atol=1e-13)


def test_times_of_day_pass_midnight() -> None:
    t = seconds(pd.Series(["23:59:59.90", "23:59:59.95", "00:00:00.00", "00:00:00.05"]), "t")
    np.testing.assert_allclose(t, [0.0, 0.05, 0.1, 0.15], atol=1e-9)  # nanoseconds are whole


@pytest.mark.parametrize(
    "form", ["%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S", "%Y-%m-%d %H:%M:%S", "%d/%m/%Y %I:%M:%S %p"]
)
def test_days_and_months_are_told_apart(form: str) -> None:
    # Over midnight from the 12th to the 13th, which alone tells which number is the day.
    moments = pd.date_range("2026-11-12 12:00", periods=4, freq="6h")
    cells = pd.Series([moment.strftime(form) for moment in moments])
    assert all(is_date(cell) for cell in cells)
    np.testing.assert_array_equal(seconds(cells, "t"), 21_600.0 * np.arange(4))


def test_a_word_among_dates_is_named() -> None:
    with pytest.raises(DataError, match=r"column `t` holds `soon` at row 1 \(the first is 0\), which is no date"):
        seconds(pd.Series(["2026-11-23 06:00:00", "soon"]), "t")


def test_dates_in_german_with_a_comma_before_the_milliseconds(tmp_path: Path) -> None:
    table = named(columns())
    stamps = [
        f"23.11.2026 06:{int(t // 60):02d}:{t % 60:06.3f}".replace(".", ",").replace(",", ".", 2) for t in table["t"]
    ]
    frame = pd.DataFrame({**table, "t": stamps}).rename(columns={"t": "Zeitstempel"})
    frame.to_csv(tmp_path / "log.csv", sep=";", decimal=",", index=False, float_format="%.17g")
    guess = guess_layout(tmp_path / "log.csv")
    assert (guess.layout.time, guess.layout.decimal) == (Source((Term("Zeitstempel"),), "date"), ",")
    assert import_log(tmp_path / "log.csv", guess.layout).recording.sample_time == pytest.approx(0.02, rel=1e-6)


def test_what_is_no_quaternion_is_refused_and_zeros_are_missed() -> None:
    sound = np.array([from_angles(0.1, -0.2)] * 4)
    sound[2] = 0.0
    np.testing.assert_allclose(axis_rotations(sound)["y"], [0.1, 0.1, np.nan, 0.1], rtol=1e-14)
    np.testing.assert_allclose(axis_rotations(sound)["x"], [-0.2, -0.2, np.nan, -0.2], rtol=1e-14)
    with pytest.raises(DataError, match="have length 2, not 1: they are no unit quaternion"):
        axis_rotations(np.ones((5, 4)))


def test_references_in_a_circle_end(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        cell = file.create_dataset("trials", (40, 1), dtype=h5py.ref_dtype)
        for k in range(40):
            cell[k, 0] = cell.ref if k else file.create_dataset("x", data=np.ones((3, 1))).ref
    # Followed each time they are met these were 40^4 of them.
    assert set(mat_arrays(tmp_path / "a.mat")) == {"x", "trials{1}"}


def test_drives_that_hardly_moved_are_no_other_unit() -> None:
    """Set-points and positions of one log are in one unit unless it is said or all but sure."""
    found = judge({"set-points": 115.0, "positions": 4.0, "tilt": 2.0}, {})
    assert (found["set-points"].unit, found["positions"].unit) == ("deg", "deg")


def test_rows_that_a_logger_dropped_again_and_again_are_missed_samples_and_not_gaps(tmp_path: Path) -> None:
    neck, path = neck_recording(1500), tmp_path / "log.csv"
    frame = pd.DataFrame({"time": neck.time, **{f"target_motor{j}": neck.set_points[:, j - 1] for j in (1, 2, 3)},
                          "pitch": neck.outputs[:, 0], "roll": neck.outputs[:, 1]})  # fmt: skip
    dropped = np.random.default_rng(2).choice(np.arange(1, 1499), 60, replace=False)
    frame.drop(index=dropped).to_csv(path, index=False, float_format="%.17g")
    done = import_log(path, guess_layout(path).layout)
    assert any(note.startswith("60 row(s) that were not logged, in ") for note in done.notes)
    found, rows = done.recording, np.isin(np.arange(1500), dropped)
    assert (len(found), len(found.runs())) == (1500, 1)
    assert np.isnan(found.outputs[rows]).all()
    # The rest is as it was logged; a set-point that was not is the last one before it.
    np.testing.assert_allclose(found.outputs[~rows], neck.outputs[~rows], rtol=1e-12)
    last = np.maximum.accumulate(np.where(rows, 0, np.arange(1500)))
    np.testing.assert_allclose(found.set_points, neck.set_points[last], rtol=1e-12)
    # Few or long gaps split runs as ever.
    frame.drop(index=[300, 700]).to_csv(path, index=False)
    assert len(import_log(path, guess_layout(path).layout).recording.runs()) == 3


@pytest.mark.parametrize("late", ["uniform", "normal", "loop"])
def test_a_clock_that_jitters_splits_nothing_and_is_doubted(late: str, tmp_path: Path) -> None:
    neck, path = neck_recording(1500), tmp_path / "log.csv"
    rng, k = np.random.default_rng(4), np.arange(1500)
    time = {
        "uniform": lambda: k + rng.uniform(-0.3, 0.3, 1500),  # steps of 0.4 to 1.6
        "normal": lambda: np.maximum.accumulate(k + 0.2 * rng.standard_normal(1500)) + 1e-4 * k,
        "loop": lambda: np.cumsum(np.exp(0.2 * rng.standard_normal(1500))),  # of which each takes its time
    }[late]()
    outputs = [np.interp(time, k, neck.outputs[:, i]) for i in (0, 1)]
    frame = pd.DataFrame({"time": 0.02 * (time - time[0]), "pitch": outputs[0], "roll": outputs[1]})
    for j in (1, 2, 3):
        frame[f"target_motor{j}"] = neck.set_points[:, j - 1]
    frame.to_csv(path, index=False, float_format="%.9f")
    found = guess_layout(path)
    [doubt] = [doubt for doubt in found.doubts if doubt.about == "clock"]
    assert "the clock jitters" in doubt.why
    # Medians of 1,500 steps that scatter by 30 %: 1 % of it.
    assert float(doubt.why.split("sample_time_s = ")[1].split("`")[0]) == pytest.approx(0.02, rel=0.04)
    recording = import_log(path, found.layout).recording
    assert len(recording.runs()) == 1
    # A pause is a gap on any clock.
    frame["time"] += np.where(k >= 700, 0.4, 0.0)
    frame.to_csv(path, index=False, float_format="%.9f")
    assert len(import_log(path, guess_layout(path).layout).recording.runs()) == 2


def test_two_rows_at_once_are_no_gap(tmp_path: Path) -> None:
    # A logger that writes some rows late, and the next one right behind.
    k = np.arange(600)
    time = 0.02 * (k + np.where(k % 20 == 7, 0.9, 0.0))
    samples = Samples(time, np.zeros(600, dtype=np.int64), {})
    assert not find_gaps(samples)[0].any()
    assert find_gaps(samples.rows(k != 300))[0].sum() == 1


def test_a_clock_of_exact_steps_has_a_gap_where_one_is_twice_as_long() -> None:
    k = np.delete(np.arange(100), 50)
    assert find_gaps(Samples(0.25 * k, np.zeros(99, dtype=np.int64), {}))[0].nonzero()[0].tolist() == [49]


def test_a_pause_of_more_than_four_usual_steps_is_a_gap_on_a_clock_of_steps_of_all_lengths() -> None:
    # Each 1.1 times the one before, none beside another: no hole tells any of them from the others.
    steps = np.ones(400)
    steps[5:165:10] = 1.1 ** np.arange(1, 17)
    found = find_gaps(Samples(np.cumsum(steps), np.zeros(400, dtype=np.int64), {}))[0]
    np.testing.assert_array_equal(found, steps[1:] >= 4.0)


@pytest.mark.parametrize("start", [0.0, 3.0])
def test_a_clock_jitters_where_long_steps_of_all_lengths_stand_and_not_where_it_is_even_or_has_gaps(
    start: float,
) -> None:
    """What it tells are its shortest, longest and usual step; a stamp that stands twice and a new run are no steps."""
    even = start + 0.02 * np.arange(300)
    assert jitter(even) is None
    assert jitter(np.where(np.arange(300) < 150, even, even + 5.0)) is None  # one gap
    steps = np.full(400, 0.02)
    steps[5:135:10] *= 1.1 ** np.arange(1, 14)  # none of four usual steps or more, which would be a pause
    found = jitter(start + np.cumsum(steps))
    assert found == pytest.approx((0.02, 0.02 * 1.1**13, 0.02))
    twice = np.repeat(start + np.cumsum(steps), 2)
    assert jitter(twice) == pytest.approx(found)
    again = np.concatenate([start + np.cumsum(steps), start + np.cumsum(steps)])
    assert jitter(again) == pytest.approx(found)
    assert jitter(np.array([start, start - 1.0])) is None


@pytest.mark.parametrize(("steps", "gaps"), [(1.5, []), (1.5 + 2.0**-20, [49])])
@pytest.mark.parametrize("other", [1.0, 1.25])
def test_a_step_of_half_more_than_the_usual_is_no_gap_and_a_longer_one_is(
    steps: float, gaps: list[int], other: float
) -> None:
    # Times are exact in binary, so that the step is at the border, alone or beside one that is a bit long.
    k = np.arange(100)
    time = 0.25 * (k + (steps - 1.0) * (k > 49) + (other - 1.0) * (k > 70))
    assert find_gaps(Samples(time, np.zeros(100, dtype=np.int64), {}))[0].nonzero()[0].tolist() == gaps
