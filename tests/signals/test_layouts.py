"""Foreign logs through layouts: what a layout may say, what a log may not, and the layouts that come with us."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, SettingsError, SoftneckError
from softneck.signals import import_log, read_layout
from softneck.signals.importing._log import ImportResult

from ..data import LAYOUTS

LAYOUT = """
[time]
column = "t"
unit = "ms"
[channels]
motor_setpoint_1 = { column = "a", unit = "rad", factor = 0.125 }
motor_setpoint_2 = { column = "b", unit = "deg", sign = -1 }
pitch = { column = "p", unit = "deg" }
roll = { column = "r", unit = "deg" }
[channels.motor_setpoint_3]
unit = "rad"
terms = [{ column = "a", factor = 0.0625 }, { column = "b", factor = -0.125 }]
"""
LOG = "t, a, b, p, r\n" + "\n".join(f"{20 * k}, {k}, {2 * k}, {3 * k}, {4 * k}" for k in range(30))


def imported(folder: Path, layout: str = LAYOUT, log: str = LOG) -> ImportResult:
    (folder / "layout.toml").write_text(layout)
    (folder / "log.csv").write_text(log)
    return import_log(folder / "log.csv", read_layout(folder / "layout.toml"))


def test_units_signs_and_sums_of_columns(tmp_path: Path) -> None:
    r = imported(tmp_path).recording
    k = np.arange(30.0)
    assert r.sample_time == 0.02
    expected = np.column_stack([k / 8, -np.radians(2 * k), 0.0625 * k - 0.25 * k])
    np.testing.assert_allclose(r.set_points, expected, rtol=1e-15)
    np.testing.assert_allclose(r.outputs, np.radians(np.column_stack([3 * k, 4 * k])), rtol=1e-15)


def test_a_file_without_header_is_read_by_index(tmp_path: Path) -> None:
    layout = LAYOUT
    for index, name in enumerate("tabpr"):
        layout = layout.replace(f'"{name}"', str(index))
    body = "\n".join(LOG.splitlines()[1:]).replace(",", ";")
    by_index = imported(tmp_path, '[file]\nheader = false\ndelimiter = ";"\nrows = [3, 13]\n' + layout, body).recording
    np.testing.assert_array_equal(by_index.outputs, imported(tmp_path).recording.outputs[3:13])


def test_restarts_of_time_are_new_runs_where_the_layout_says_so(tmp_path: Path) -> None:
    body = LOG.splitlines()
    twice = "\n".join([*body, *body[1:]])
    r = imported(tmp_path, LAYOUT.replace('unit = "ms"', 'unit = "ms"\nnew_run_at_restart = true'), twice).recording
    assert [len(run) for run in r.runs()] == [30, 30]
    with pytest.raises(DataError, match="`time` runs backwards or stands still at row 30"):
        imported(tmp_path, LAYOUT, twice)


def test_the_true_sample_time_beats_the_column_and_is_told(tmp_path: Path) -> None:
    done = imported(tmp_path, LAYOUT.replace('unit = "ms"', 'unit = "ms"\nsample_time_s = 0.021'))
    assert done.notes == ("the time column says 20 ms a sample; the layout's 21 ms is used",)
    np.testing.assert_allclose(done.recording.time, 0.021 * np.arange(30), rtol=1e-15)


def test_a_gap_in_the_time_column_splits_the_run_under_any_sample_time(tmp_path: Path) -> None:
    gap = "\n".join(line for line in LOG.splitlines() if not line.startswith("200,"))
    for layout in (LAYOUT, LAYOUT.replace('unit = "ms"', 'unit = "ms"\nsample_time_s = 0.021')):
        done = imported(tmp_path, layout, gap)
        assert [len(run) for run in done.recording.runs()] == [10, 19]
        told = (
            "1 gap(s) in the time column, the longest 0.04 s, the first at row 10 (t = 0.22 s): each starts a new run"
        )
        assert told in done.notes


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"p", unit = "deg"', '"p", unit = "grad"', "unknown unit `grad`"),
        ('"p", unit = "deg"', '"p", unit = "mm"', r"\[channels\.pitch\] cannot be in `mm`; its SI unit is rad"),
        ('"p", unit = "deg"', '"p"', r"\[channels\.pitch\] names no unit"),
        ('"p", unit = "deg"', '"p", unit = 5', "unknown unit `5`"),
        ('"p", unit = "deg"', '"p", unit = ["deg"]', "wrong type"),
        ('{ column = "p", unit', "{ unit", r"\[channels\.pitch\] needs `column`"),
        (
            '"p", unit = "deg"',
            '"p", unit = "deg", sing = -1',
            "unknown key `sing`; known: column, factor, integrate, sign",
        ),
        (
            '"p", unit = "deg"',
            '"p", unit = "deg", sign = "x"',
            "pitch]: sign must be 1 or -1; got 'x'. Scale it by `factor`",
        ),
        ("[time]", "[file]\nunit_row = 1\n[time]", "`unit_row` must be true or false; got 1"),
        ("[time]", "[file]\nheader = false\nunit_row = true\n[time]", "unit_row is the line below the names"),
        ('"p", unit = "deg"', '"p", unit = "deg", sign = 0', "sign must be 1 or -1; got 0"),
        ('"p", unit = "deg"', '"p", unit = "deg", factor = 0', "a factor must be a finite number other than 0; got 0"),
        ('"p", unit = "deg"', '"p", unit = "deg", factor = "x"', "wrong type"),
        ("pitch =", "yaw =", r"\[channels\.yaw\]: not a channel of a recording"),
        ("[time]", "[times]", "the layout has the unknown key `times`"),
        ("[time]", "[time]\nsample_time_s = -1", "sample_time_s must be a positive number or `estimate`; got -1"),
        ("[time]", "[file]\nskip = -1\n[time]", "skip must be a number of lines; got -1"),
        ("[time]", "[file]\ndelimiter = '(a+)+$'\n[time]", "delimiter must be one character or `whitespace`"),
        ("[time]", "[file]\ndecimal = ';'\n[time]", r"`decimal` must be one of \., ,; got ';'"),
        ("[time]", "[time]\nduplicates = 'mean'", "`duplicates` must be one of first, last; got 'mean'"),
        ('unit = "deg", sign = -1', 'unit = "deg", sign = nan', "sign must be 1 or -1; got nan"),
        ("[time]", "[file]\nrows = [5, 2]\n[time]", r"rows must be \[first, last\]"),
        ("[time]", "[file]\nrows = ['a', 'b']\n[time]", r"rows must be \[first, last\]"),
        (
            "[time]",
            "[tilt]\ninclination = {column='p', unit='deg'}\n[time]",
            "needs both `inclination` and `orientation`",
        ),
        ("[time]", "file = 5\n[time]", r"\[file\] must be a table"),
        ('{ column = "a", factor = 0.0625 }', "5", "needs `column`"),
    ],
)
def test_a_wrong_layout_is_one_clear_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in LAYOUT
    with pytest.raises(SettingsError, match=message) as caught:
        imported(tmp_path, LAYOUT.replace(old, new))
    assert str(caught.value).startswith(f"{tmp_path / 'layout.toml'}: ")


@pytest.mark.parametrize("text", ["channels = 5", "channels = [1]", "[channels]\npitch = 3", "time = []", "tilt = 1"])
def test_a_layout_of_wrong_types_is_a_settings_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(SettingsError, match=r"layout\.toml: .*(must be a table|wrong type)"):
        imported(tmp_path, text)


def test_a_layout_that_is_absent_or_no_toml(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_layout(tmp_path / "none.toml")
    for content in (b"a = = 1", b"\xff\xfe\x00"):
        (tmp_path / "bad.toml").write_bytes(content)
        with pytest.raises(FileFormatError, match="is not a TOML file"):
            read_layout(tmp_path / "bad.toml")
    with pytest.raises(FileFormatError, match="is a folder"):
        read_layout(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (", p,", ", q,", r"column `p` for `pitch` is not in the file; it has t, a, b, q, r"),
        ("\n200, 10,", "\n200, ten,", "column `a` holds `ten` at row 10"),
        ("\n200, 10,", "\n200, ,", "column `a` holds an empty cell at row 10"),
        ("\n200, 10,", "\n200, nan,", "column `a` holds `nan` at row 10"),
        ("\n200,", "\n20,", "`time` runs backwards or stands still at row 10"),
    ],
)
def test_a_log_that_does_not_fit_is_one_clear_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in LOG
    with pytest.raises(DataError, match=message) as caught:
        imported(tmp_path, log=LOG.replace(old, new))
    assert str(caught.value).startswith(f"{tmp_path / 'log.csv'}: ")


def test_a_layout_without_time_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="neither a time column nor `sample_time_s`"):
        imported(tmp_path, LAYOUT.split("[channels]")[1].join(["[channels]", ""]))


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=150)
def test_damaged_layouts_are_a_clear_error_and_nothing_else(tmp_path: Path, data: st.DataObject) -> None:
    tokens = [str(token) for token in LAYOUT.split(" ")]
    words = ["[", "]", "{", "}", "5", "-1", "true", '"x"', "=", "\n", "[1,2]", "1e400", "nan", "99999999999999999999"]
    for _ in range(data.draw(st.integers(1, 3))):
        tokens[data.draw(st.integers(0, len(tokens) - 1))] = data.draw(st.sampled_from(words) | st.text(max_size=3))
    with contextlib.suppress(SoftneckError):  # anything else fails the test
        imported(tmp_path, " ".join(tokens).encode("utf-8", "ignore").decode())


def test_the_open_loop_recording_is_what_its_readme_says(shared_data: Path) -> None:
    done = import_log(shared_data / "neck_openloop/spring_test_0gr.csv", read_layout(LAYOUTS / "neck_openloop.toml"))
    r = done.recording
    assert (len(r), len(r.runs()), r.sample_time) == (7000, 1, 0.021)
    assert any("10 ms" in remark for remark in done.notes)
    # Steps of orientation at 15, then 25 deg of inclination; the neck reaches somewhat more or less.
    tilt = np.degrees(np.arccos(np.cos(r.outputs[:, 0]) * np.cos(r.outputs[:, 1])))
    assert 12 < np.median(tilt[1000:3000]) < 18
    assert 20 < np.median(tilt[4500:6500]) < 30
    # Positions follow their set-points within the drive's lag.
    assert np.abs(r.motor_positions - r.set_points).mean() < 0.05 * np.ptp(r.set_points)


@pytest.mark.parametrize("payload", ["000", "400", "1000"])
def test_the_closed_loop_recordings_are_three_runs(shared_data: Path, payload: str) -> None:
    path = shared_data / f"neck_closedloop/frontier_test_{payload}gr.csv"
    r = import_log(path, read_layout(LAYOUTS / "neck_closedloop.toml")).recording
    assert [len(run) for run in r.runs()] == [251, 251, 251]
    assert r.sample_time == pytest.approx(0.02)
    # Each step ends near 15 deg of tilt, whatever its orientation.
    for run in r.runs():
        pitch, roll = run.outputs[-50:].mean(axis=0)
        assert np.degrees(np.hypot(pitch, roll)) == pytest.approx(15.0, abs=1.5)


def test_the_arm_gives_13000_rows_whose_pitch_follows_theta(shared_data: Path) -> None:
    path = shared_data / "arm_multisine/arm_multisine_400s.csv"
    r = import_log(path, read_layout(LAYOUTS / "arm_multisine.toml")).recording
    assert (len(r), r.sample_time) == (13_000, 0.02)
    P = r.motor_positions
    theta, phi = P[:, 0] - 0.5 * (P[:, 1] + P[:, 2]), 0.866 * (P[:, 1] - P[:, 2])
    # The README says of yaw and phi_i: -0.90 over the whole record, and roll = -yaw.
    assert np.corrcoef(theta, r.outputs[:, 0])[0, 1] > 0.7
    assert np.corrcoef(phi, r.outputs[:, 1])[0, 1] > 0.7
    # Targets and logged positions agree: the layout's sums of columns are right in scale and sign.
    for j in range(3):
        assert np.corrcoef(r.set_points[:, j], P[:, j])[0, 1] > 0.95


@pytest.mark.parametrize("line", ['header = "false"', "header = 0"])
def test_a_flag_is_true_or_false(line: str, tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    path.write_text(f"[file]\n{line}\n[time]\nsample_time_s = 0.02\n[channels]\n", encoding="utf-8")
    with pytest.raises(SettingsError, match="`header` must be true or false"):
        read_layout(path)
