"""Uneven times are made even and said so, gaps stay gaps, and even times pass bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import DataError
from softneck.signals import Recording, concatenate, import_log, parse_layout, resampled
from softneck.signals.importing._log import ImportResult
from softneck.signals.recording._resampling import (
    Samples,
    low_pass,
    mean_step,
    resample,
    split_at_gaps,
    without_duplicates,
)

LAYOUT = """
[time]
column = "t"
[channels]
motor_setpoint_1 = { column = "s1", unit = "rad" }
motor_setpoint_2 = { column = "s2", unit = "rad" }
motor_setpoint_3 = { column = "s3", unit = "rad" }
pitch = { column = "p", unit = "rad" }
roll = { column = "r", unit = "rad" }
"""
TS = 0.02


def truth(t: np.ndarray) -> np.ndarray:
    """Three tones up to 4 rad/s, the band in which the neck moves; amplitude 0.3 rad in all."""
    return 0.1 * (np.sin(1.3 * t) + np.cos(2.7 * t + 1) + np.sin(4.0 * t + 2))


def imported(folder: Path, time: np.ndarray, layout: str = LAYOUT, **columns: np.ndarray) -> ImportResult:
    pitch = columns.get("p", truth(time))
    step = columns.get("s1", np.arange(len(time)) % 3)
    rows = zip(time, step, 0 * time, 0 * time, pitch, truth(time), strict=True)
    cells = [",".join("" if np.isnan(cell) else repr(float(cell)) for cell in row) for row in rows]
    (folder / "log.csv").write_text("\n".join(["t,s1,s2,s3,p,r", *cells]))
    return import_log(folder / "log.csv", parse_layout(layout))


@pytest.mark.slow
@given(jitter=st.floats(0.05, 0.2), seed=st.integers(0, 99))
def test_a_band_limited_signal_is_recovered_from_jittered_samples(tmp_path: Path, jitter: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = TS * (np.arange(400) + rng.uniform(-jitter, jitter, 400))
    done = imported(tmp_path, time)
    r = done.recording
    assert np.ptp(np.diff(r.time)) < 1e-12
    assert any("resampled at" in note and "largest shift" in note for note in done.notes)
    # PCHIP is second order where it flattens extrema: error <= h^2 max|x''| / 4 with h = 1.4 TS and
    # max|x''| = 0.1 (1.3^2 + 2.7^2 + 4^2) = 2.5 rad/s^2: 0.49e-3 rad = 0.028 deg, below the sensor's 0.05 deg.
    assert np.abs(r.outputs[:, 0] - truth(r.time)).max() < 0.5e-3


@settings(max_examples=25)
@given(Ts=st.sampled_from([0.001, 0.01, 1 / 30, 0.021, 0.1, 1.0]), start=st.floats(-10, 1000), rows=st.integers(12, 60))
def test_even_times_pass_bit_for_bit(tmp_path: Path, Ts: float, start: float, rows: int) -> None:
    time = start + Ts * np.arange(rows)
    done = imported(tmp_path, time)
    assert done.notes == ()
    np.testing.assert_array_equal(done.recording.time, time)
    np.testing.assert_array_equal(done.recording.outputs[:, 0], truth(time))


def test_the_largest_shift_is_the_one_that_is_there(tmp_path: Path) -> None:
    time = TS * np.arange(100)
    time[40] += 0.007  # the mean step is not touched
    done = imported(tmp_path, time)
    assert done.notes == (
        "the time column is uneven (13 to 27 ms a step): resampled at 20 ms, largest shift of a sample 7 ms",
    )
    # Instants that are logged ones keep their samples, but for the rounding of products.
    others = np.arange(100) != 40
    np.testing.assert_array_equal(done.recording.outputs[others, 0], truth(time)[others])


def test_set_points_hold_their_last_value(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    time = TS * (np.arange(200) + rng.uniform(-0.2, 0.2, 200))
    r = imported(tmp_path, time, s1=np.arange(200.0) / 100).recording
    expected = [np.flatnonzero(time <= instant + 1e-9)[-1] for instant in r.time]
    np.testing.assert_array_equal(r.set_points[:, 0], np.array(expected) / 100)


@pytest.mark.slow
@given(data=st.data())
def test_a_missed_sample_is_never_invented(tmp_path: Path, data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 9)))
    time = TS * (np.arange(60) + rng.uniform(-0.2, 0.2, 60))
    pitch = truth(time)
    pitch[data.draw(st.lists(st.integers(0, 59), min_size=1, max_size=40))] = np.nan
    if np.isnan(pitch).all():
        return
    r = imported(tmp_path, time, p=pitch).recording
    for instant, value in zip(r.time, r.outputs[:, 0], strict=True):
        before = np.flatnonzero(time <= instant + 1e-9)[-1]
        after = min(before + (abs(time[before] - instant) > 1e-7), 59)
        assert np.isnan(value) == (np.isnan(pitch[before]) or np.isnan(pitch[after]))


def test_gaps_split_and_short_pieces_are_dropped_with_a_note(tmp_path: Path) -> None:
    k = np.concatenate([np.arange(50), np.arange(60, 65), np.arange(100, 150)])
    done = imported(tmp_path, TS * k)
    assert [len(run) for run in done.recording.runs()] == [50, 50]
    assert done.notes == (
        "2 gap(s) in the time column, the longest 0.72 s, the first at row 50 (t = 1.2 s): each starts a new run",
        "1 piece(s) between gaps, 5 rows, dropped: shorter than 10 samples",
    )
    np.testing.assert_array_equal(done.recording.outputs[:, 0], truth(TS * np.delete(k, np.arange(50, 55))))


@pytest.mark.parametrize(
    "runs", [[[12, 5, 10]], [[5], [20, 9, 10]], [[9, 10], [4]], [[4, 9]], [[12], [11]], [[4, 13, 4], [13, 4]]], ids=str
)
def test_pieces_beside_a_gap_are_runs_of_their_own_if_they_have_ten_samples_and_others_stay(
    runs: list[list[int]],
) -> None:
    """In each run pieces of so many rows at 0.25 s, with 1 s between them; a run without a gap may be short."""
    lengths = [size for pieces in runs for size in pieces]
    number = np.repeat(np.repeat(np.arange(len(runs)) * 3, [len(pieces) for pieces in runs]), lengths)
    step = np.full(sum(lengths), 0.25)
    step[np.cumsum([0, *lengths[:-1]])] = 1.0
    samples = Samples(np.cumsum(step), number, {"x": np.arange(step.size) * 1.0})
    kept = [size >= 10 or len(pieces) == 1 for pieces in runs for size in pieces]
    gaps = len(lengths) - len(runs)
    if not any(kept):
        with pytest.raises(DataError, match=rf"`time` has {gaps} gaps \(steps of 1 s and more\) and no 10 samples"):
            split_at_gaps(samples)
        return
    found, notes = split_at_gaps(samples)
    rows = np.repeat(kept, lengths)
    np.testing.assert_array_equal(found.time, samples.time[rows])
    np.testing.assert_array_equal(found.channels["x"], np.flatnonzero(rows))
    if not gaps:
        assert (found, notes) == (samples, ())
        return
    assert found.run.tolist() == [k for k, size in enumerate([s for s, k in zip(lengths, kept, strict=True) if k])
                                  for _ in range(size)]  # fmt: skip
    first = int(np.flatnonzero((np.diff(samples.time) > 0.5) & (np.diff(number) == 0))[0]) + 1
    at = f"the first at row {first} (t = {samples.time[first]:g} s)"
    assert notes[0] == f"{gaps} gap(s) in the time column, the longest 1 s, {at}: each starts a new run"
    lost = kept.count(False)
    assert notes[1:] == ((f"{lost} piece(s) between gaps, {step.size - rows.sum()} rows, dropped: shorter than 10 "
                          "samples",) if lost else ())  # fmt: skip
    assert mean_step(found) == 0.25


def test_an_instant_that_is_logged_has_its_sample_and_the_shift_is_to_the_nearest() -> None:
    time, run = np.array([0.0, 1.0, 2.25, 3.0, 4.0, 0.0, 1.0]), np.array([5, 5, 5, 5, 5, 7, 7])
    x = np.array([1.0, 2.0, 4.0, np.nan, 8.0, -1.0, -3.0])
    found, shift = resample(Samples(time, run, {"pitch": x, "motor_setpoint_1": time}), 1.0)
    assert (found.time.tolist(), found.run.tolist()) == ([0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 1.0], [5] * 5 + [7] * 2)
    assert shift == 0.25
    assert found.channels["motor_setpoint_1"].tolist() == [0.0, 1.0, 1.0, 3.0, 4.0, 0.0, 1.0]
    y = found.channels["pitch"]
    np.testing.assert_array_equal(y[[0, 1, 3, 4, 5, 6]], x[[0, 1, 3, 4, 5, 6]])
    assert 2.0 < y[2] < 4.0
    # Between samples of which one is missed there is none, and one alone is held where it is.
    one = resample(Samples(time[:3], run[:3], {"pitch": np.array([np.nan, 3.0, np.nan])}), 0.5)[0].channels["pitch"]
    np.testing.assert_array_equal(one, [np.nan, np.nan, 3.0, np.nan, np.nan])


@pytest.mark.parametrize(("rule", "kept"), [("first", [0, 1, 3, 4, 5]), ("last", [0, 2, 3, 4, 5])])
def test_one_of_two_rows_of_one_time_is_kept_and_runs_may_begin_at_the_same(rule: str, kept: list[int]) -> None:
    samples = Samples(np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0]), np.array([0, 0, 0, 0, 1, 1]), {"x": np.arange(6.0)})
    found, notes = without_duplicates(samples, rule)
    assert found.channels["x"].tolist() == kept
    assert found.run.tolist() == samples.run[kept].tolist()
    assert notes == ("1 row(s) left out: their time stamp occurs twice, the first time at row 2",)
    with pytest.raises(DataError, match=r"stands still at row 2: 1 s occurs twice \(1 such row\(s\)\)"):
        without_duplicates(samples, None)
    again, none = without_duplicates(found, None)
    assert (again, none) == (found, ())


def test_nothing_is_bridged_between_pieces(tmp_path: Path) -> None:
    """A resampled piece is the same whatever lies behind the gap."""
    rng = np.random.default_rng(2)
    first = TS * (np.arange(40) + rng.uniform(-0.2, 0.2, 40))
    second = 5.0 + TS * (np.arange(40) + rng.uniform(-0.2, 0.2, 40))
    pitch = [np.concatenate([truth(first), level + truth(second)]) for level in (0.0, 1.0)]
    one, other = (imported(tmp_path, np.concatenate([first, second]), p=p).recording.runs()[0] for p in pitch)
    np.testing.assert_array_equal(one.outputs, other.outputs)
    assert one.time[-1] <= first[-1]


def test_a_log_of_gaps_only_is_refused(tmp_path: Path) -> None:
    time = np.cumsum(np.tile([1.0, 1.0, 1.0, 5.0], 10))
    with pytest.raises(DataError, match=r"`time` has 10 gaps .* is the unit of the time column right"):
        imported(tmp_path, time)


def test_duplicated_time_stamps_are_an_error_or_one_row_by_the_layouts_word(tmp_path: Path) -> None:
    time = TS * np.arange(40)
    twice = np.sort(np.append(time, time[7]))
    pitch = np.insert(truth(time), 8, 0.5)
    with pytest.raises(DataError, match=r"`time` stands still at row 8: 0\.14 s .*`duplicates = \"first\"`"):
        imported(tmp_path, twice, p=pitch)
    for rule, expected in (("first", truth(time)[7]), ("last", 0.5)):
        layout = LAYOUT.replace("[time]", f'[time]\nduplicates = "{rule}"')
        done = imported(tmp_path, twice, layout, p=pitch)
        assert done.recording.outputs[7, 0] == expected
        assert len(done.recording) == 40
        assert done.notes == ("1 row(s) left out: their time stamp occurs twice, the first time at row 8",)


def test_the_layouts_sample_time_counts_rows_and_says_so(tmp_path: Path) -> None:
    time = TS * np.arange(100)
    time[40] += 0.007
    done = imported(tmp_path, time, LAYOUT.replace("[time]", "[time]\nsample_time_s = 0.02"))
    np.testing.assert_array_equal(done.recording.outputs[:, 0], truth(time))
    assert done.notes == ("the time column is uneven, but the layout's sample time counts rows: nothing was resampled",)


def test_a_channel_without_a_number_is_named(tmp_path: Path) -> None:
    time = TS * np.arange(40)
    with pytest.raises(DataError, match=r"column `p` for `pitch` holds no number in any of its 40 rows"):
        imported(tmp_path, time, p=np.full(40, np.nan))


def test_numbers_beyond_all_bounds_are_refused_without_a_warning(tmp_path: Path) -> None:
    time = TS * np.arange(40)
    time[9] += 0.003
    step = np.linspace(0, 1.5e308, 40)  # steeper than the largest number a second
    layout = LAYOUT.replace("[channels]", '[channels]\nmotor_position_1 = { column = "s1", unit = "rad" }')
    with pytest.raises(DataError, match=r"a channel reaches 1\.5e\+308 within .* is the log damaged"):
        imported(tmp_path, time, layout, s1=step)


def test_a_recording_goes_to_another_sample_time_and_its_runs_stay_apart() -> None:
    time = 0.021 * np.arange(300)
    step = np.floor(time)
    run = Recording(
        time,
        0.021,
        {**{f"motor_setpoint_{j}": step for j in (1, 2, 3)}, "pitch": truth(time), "roll": truth(time)},
    )
    both = concatenate([run, run.rows(0, 100)])
    slower = resampled(both, 0.02)
    assert slower.sample_time == 0.02
    assert [len(part) for part in slower.runs()] == [314, 104]  # floor(0.021 (n - 1) / 0.02) + 1
    for part in slower.runs():
        # PCHIP, as above: h^2 max|x''| / 4 with h = 21 ms.
        assert np.abs(part.outputs[:, 0] - truth(part.time)).max() < 0.3e-3
        assert set(np.unique(part.set_points)) <= set(step)
    same = resampled(run, run.sample_time)
    np.testing.assert_array_equal(same.outputs, run.outputs)
    with pytest.raises(DataError, match=r"a run of 100 rows at 0\.021 s has no two samples 5 s apart"):
        resampled(both, 5.0)
    ten = of(truth(0.25 * np.arange(11)), 0.25)
    assert len(resampled(ten, 2.5)) == 2
    with pytest.raises(DataError, match="no two samples"):
        resampled(ten, np.nextafter(2.5, 3.0))


def of(outputs: np.ndarray, sample_time: float, set_points: np.ndarray | None = None) -> Recording:
    """A recording of one motion, `outputs` (time,) [rad], on both axes."""
    held = np.zeros(outputs.size) if set_points is None else set_points
    channels = {f"motor_setpoint_{j}": held for j in (1, 2, 3)} | {"pitch": outputs, "roll": -outputs}
    return Recording(sample_time * np.arange(outputs.size), sample_time, channels)


def test_at_its_own_sample_time_a_recording_is_the_same_to_the_bit() -> None:
    run = of(truth(0.02 * np.arange(200)), 0.02)
    assert resampled(run, 0.02) is run
    assert resampled(run, 0.02 * (1 + 1e-9)) is run  # a rounding of printed times


@pytest.mark.parametrize("ratio", [2, 3, 5])
def test_a_slow_motion_comes_back_from_a_slower_sample_time(ratio: int) -> None:
    """There and back: what is slow enough for the slower grid is lost by its interpolation alone."""
    time = 0.01 * np.arange(2000)
    # Up to a tenth of the slower grid's Nyquist frequency.
    omega = 0.1 * np.pi / (0.01 * ratio)
    motion = 0.2 * np.sin(omega * time) + 0.1 * np.sin(0.37 * omega * time + 1.0)
    back = resampled(resampled(of(motion, 0.01), 0.01 * ratio), 0.01)
    inside = slice(100, len(back) - 100)  # the ends are continued, not known
    # A monotone cubic between samples 1/20 of a period apart: h^2 max|x''| / 4 (h omega = 0.31), and 1e-3 of ripple.
    bound = (0.1 * np.pi) ** 2 * 0.2 / 4.0 + 0.3e-3
    assert np.abs(back.outputs[inside, 0] - motion[: len(back)][inside]).max() < bound
    assert np.abs(back.outputs[inside, 0]).max() > 0.25


@pytest.mark.parametrize("ratio", [2, 5])
def test_there_and_back_by_a_faster_sample_time_is_the_identity_on_the_pass_band(ratio: int) -> None:
    time = 0.02 * np.arange(1000)
    motion = 0.2 * np.sin(5.0 * time)
    back = resampled(resampled(of(motion, 0.02), 0.02 / ratio), 0.02)
    # The faster grid holds each logged sample; what is left is the ripple of a window of 60 dB, 1e-3.
    assert np.abs(back.outputs[100:-100, 0] - motion[100:-100]).max() < 1e-3 * 0.2


@pytest.mark.parametrize("ratio", [1.05, 1.5, 2.0, 3.0, 8.0, 20.0])
def test_a_low_pass_passes_seven_tenths_of_the_band_and_stops_at_its_end_within_the_shortest_window(
    ratio: float,
) -> None:
    impulse = np.zeros(1001)
    impulse[500] = 1.0
    found = low_pass(impulse, ratio)
    reach = np.flatnonzero(found)[[0, -1]] - 500
    # Kaiser's length for 60 dB and a transition of 0.3 of the band; the window is symmetric: no delay.
    order = (60.0 - 7.95) / (2.285 * 0.3 * np.pi / ratio)
    assert -reach[0] == reach[1] == np.ceil(order / 2.0)
    gain = np.abs(np.fft.rfft(found, 16384))
    frequency = np.linspace(0.0, 1.0, gain.size) * ratio  # of the new Nyquist frequency
    # 60 dB; the sum of the weights is 1, which shifts the pass band by as much as its ripple.
    assert np.abs(gain[frequency <= 0.7] - 1.0).max() < 1.5e-3
    assert gain[frequency >= 1.0].max(initial=0.0) < 1.5e-3


def test_what_a_slower_grid_cannot_hold_is_filtered_out_and_not_folded_down() -> None:
    time = 0.01 * np.arange(4000)
    # 40 Hz at 100 Hz; at 20 Hz it would stand still as a constant of its amplitude.
    noise = 0.3 * np.cos(2.0 * np.pi * 40.0 * time)
    slow = resampled(of(noise, 0.01), 0.05).outputs[:, 0]
    assert np.abs(slow[30:-30]).max() < 0.3e-3  # 60 dB
    assert np.abs(noise[::5]).min() > 0.29  # what taking each fifth would have made of it


@given(start=st.floats(-0.5, 0.5), slope=st.floats(-0.05, 0.05), ratio=st.floats(1.0, 8.0), rows=st.integers(12, 300))
@settings(max_examples=40)
def test_straight_lines_stay_straight_to_their_ends(start: float, slope: float, ratio: float, rows: int) -> None:
    time = 0.02 * np.arange(rows)
    found = resampled(of(start + slope * time, 0.02), 0.02 * ratio)
    # Sums of some hundred weights, each rounded.
    np.testing.assert_allclose(found.outputs[:, 0], start + slope * found.time, rtol=0, atol=1e-13)


@given(data=st.data())
@settings(max_examples=30)
def test_set_points_are_held_and_missed_samples_stay_missed_at_any_sample_time(data: st.DataObject) -> None:
    rows = data.draw(st.integers(12, 80))
    asked = np.array(data.draw(st.lists(st.floats(-5.0, 5.0), min_size=rows, max_size=rows)))
    outputs = truth(0.02 * np.arange(rows))
    missed = data.draw(st.integers(1, rows - 2))
    outputs[missed] = np.nan
    sample_time = 0.02 * data.draw(st.floats(0.3, 4.0))
    found = resampled(of(outputs, 0.02, asked), sample_time)
    before = np.floor(found.time / 0.02 + 1e-5).astype(int)
    np.testing.assert_array_equal(found.set_points[:, 0], asked[np.minimum(before, rows - 1)])
    lost = np.isnan(found.outputs[:, 0])
    near = np.abs(found.time - 0.02 * missed) < 0.02 * (1.0 - 1e-5)
    np.testing.assert_array_equal(lost, near)
