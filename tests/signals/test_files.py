"""Recordings as files: round trips, and one clear line for everything that is no recording."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, OutputFileError, SoftneckError
from softneck.identification.models._fitting import row_hashes
from softneck.robot import Robot
from softneck.signals import SET_POINTS, Recording, concatenate, read_recording, write_recording
from softneck.signals.recording import _files
from softneck.signals.recording._channels import known_channels
from softneck.signals.recording._files import TextForm, open_recording, read_plain_csv, read_table, recording_names

from ..data import changed, csv_lines, neck_recording

VALUES = st.floats(-1e3, 1e3)
MISSABLE = ("pitch", "roll", "pitch_rate", "compression", "motor_velocity_2", "tension_1")


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    runs = draw(st.lists(st.integers(2, 6), min_size=1, max_size=3))
    n, Ts = sum(runs), draw(st.sampled_from([0.001, 0.02, 0.021, 1.0]))
    optional = draw(st.sets(st.sampled_from(known_channels()[1:]), max_size=5))
    column = st.lists(VALUES, min_size=n, max_size=n)
    channels = {name: np.array(draw(column)) for name in {*SET_POINTS, "pitch", "roll", *optional}}
    for name in ("pitch", "roll"):
        channels[name] = np.clip(channels[name], -3.0, 3.0)  # beyond half a turn is refused
    for name in set(MISSABLE) & set(channels):
        # The first sample stays: an angle without any sample is refused.
        channels[name][draw(st.lists(st.integers(1, n - 1), max_size=3))] = np.nan
    time = np.concatenate([np.arange(rows) * Ts for rows in runs])
    return Recording(time, Ts, channels, np.repeat(np.arange(len(runs)), runs))


def test_a_delimiter_at_the_end_of_each_line_is_no_channel_unless_something_stands_behind_it(tmp_path: Path) -> None:
    lines, path = csv_lines(neck_recording(30), 30), tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    plain = read_recording(path)
    for title in ("", ","):
        path.write_text("\n".join([lines[0] + title, *[line + "," for line in lines[1:]]]))
        assert same(read_recording(path), plain)
    path.write_text("\n".join([f"{line}, {0.5 if k == 9 else ''}" for k, line in enumerate(lines)]))
    with pytest.raises(DataError, match="column `Unnamed: 6` names no unit"):
        read_recording(path)


# Numbers as loggers print them, and what is not a number at all, which is left to pandas.
CELLS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**20), 10**20).map(str),
    st.decimals(-1000, 1000, places=6).map(str),
    st.sampled_from(["", "1e5", "-.5", "+3", "5.", "nan", "1_0", " 1", "0x1", "1e999", "text", '"2"', "1e", "--1"]),
)


@given(rows=st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=6))
def test_a_plain_table_is_read_as_by_pandas_or_left_to_it(tmp_path: Path, rows: list[tuple[str, str]]) -> None:
    path = tmp_path / "table.csv"
    path.write_text("a,b\n" + "".join(",".join(row) + "\n" for row in rows))
    plain = read_plain_csv(path)
    if plain is not None:
        by_pandas = pd.read_csv(path, keep_default_na=False, na_values=[""], skip_blank_lines=False, low_memory=False)
        for title, column in plain.items():
            # To the bit: rows are known by hashes of what was read.
            np.testing.assert_array_equal(column, by_pandas[title].to_numpy(dtype=np.float64))


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@given(recording=recordings())
@settings(max_examples=25)
def test_a_recording_survives_its_file(tmp_path: Path, suffix: str, recording: Recording) -> None:
    path = tmp_path / f"a.{suffix}"
    write_recording(path, recording, force=True)
    back = read_recording(path)
    assert set(back.channels) == set(recording.channels)
    assert [len(run) for run in back.runs()] == [len(run) for run in recording.runs()]
    assert back.sample_time == pytest.approx(recording.sample_time, rel=1e-9)  # ten digits, see `median_step`
    np.testing.assert_array_equal(back.time, recording.time)
    for name, values in recording.channels.items():
        # Degrees in the file: one quotient and one product, half an ulp each. NaN stays NaN.
        np.testing.assert_allclose(back.channels[name], values, rtol=2.3e-16, atol=1e-300)


def test_blocks_of_rows_make_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = concatenate([neck_recording(300), neck_recording(200, seed=7)])
    write_recording(tmp_path / "whole.csv", recording)
    # The last block is not full, and one ends inside a run.
    monkeypatch.setattr(_files, "_ROWS_AT_ONCE", len(recording) // 3 + 1)
    write_recording(tmp_path / "blocks.csv", recording)
    assert (tmp_path / "blocks.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert len(recording) < 4096  # `whole` is one block


def test_a_models_memory_of_rows_survives_the_file(tmp_path: Path) -> None:
    recording = concatenate([neck_recording(300), neck_recording(200, seed=7)])
    write_recording(tmp_path / "a.csv", recording)
    np.testing.assert_array_equal(row_hashes(read_recording(tmp_path / "a.csv")), row_hashes(recording))


def test_radians_are_read_as_well(tmp_path: Path) -> None:
    r = neck_recording(150)
    lines = csv_lines(r)
    radians = [lines[0].replace("pitch [deg]", "pitch [rad]")]
    radians += [",".join([*line.split(",")[:4], repr(float(r.outputs[k, 0])), line.split(",")[5]])
                for k, line in enumerate(lines[1:])]  # fmt: skip
    (tmp_path / "deg.csv").write_text("\n".join(lines))
    (tmp_path / "rad.csv").write_text("\n".join(radians))
    one, other = read_recording(tmp_path / "deg.csv"), read_recording(tmp_path / "rad.csv")
    np.testing.assert_allclose(one.outputs, other.outputs, rtol=2.3e-16, atol=0)


Edit = Callable[[list[str]], list[str]]
BAD: dict[str, tuple[Edit, str]] = {
    "missing column": (lambda s: [",".join(line.split(",")[:5]) for line in s], "missing: roll"),
    "no time": (lambda s: [line.split(",", 1)[1] for line in s], r"there is no column `time \[s\]`"),
    "unknown column": (lambda s: changed(s, -1, 5, "yaw [deg]"), "column `yaw` is not a channel of a recording"),
    "no unit": (lambda s: changed(s, -1, 5, "roll"), r"column `roll` names no unit; write `roll \[deg\]`"),
    "unit that is none": (lambda s: changed(s, -1, 5, "roll [grad]"), "unknown unit `grad`"),
    "unit of another quantity": (lambda s: changed(s, -1, 5, "roll [mm]"), "column `roll` cannot be in `mm`"),
    "twice": (lambda s: changed(s, -1, 5, "pitch [rad]"), "channel `pitch` is in two columns"),
    "twice the same": (lambda s: changed(s, -1, 5, "pitch [deg]"), "channel `pitch` is in two columns"),
    "text": (lambda s: changed(s, 9, 1, "abc"), "column `motor_setpoint_1` holds `abc` at row 9"),
    "NaN": (lambda s: changed(s, 9, 1, "NaN"), "column `motor_setpoint_1` holds `NaN` at row 9"),
    "NaN in a sensor": (
        lambda s: changed(s, 9, 4, "nan"),
        r"holds `nan` at row 9 .*A missing sample is an empty cell",
    ),
    "gap in a set-point": (lambda s: changed(s, 9, 2, ""), "column `motor_setpoint_2` holds an empty cell at row 9"),
    "infinite": (lambda s: changed(s, 9, 4, "inf"), "channel `pitch` is inf at row 9"),
    "backwards": (lambda s: changed(s, 9, 0, "0.01"), "`time` runs backwards or stands still at row 9"),
    "gap": (lambda s: [*s[:50], *s[80:]], "`time` jumps by 0.62 s at row 49"),
    "time stands still": (
        lambda s: [s[0], *[changed(s, k, 0, "0")[k + 1] for k in range(99)]],
        "`time` never increases",
    ),
    "one row": (lambda s: s[:2], "a recording needs at least 2 rows; got 1"),
    "header only": (lambda s: s[:1], "a recording needs at least 2 rows; got 0"),
    "long rows": (lambda s: [s[0], *[f"{line},7.0" for line in s[1:]]], "cannot be read as a table"),
    "one long row": (lambda s: changed(s, 9, 5, "1,2,3"), "cannot be read as a table"),
    "short row": (lambda s: [*s[:10], s[10].rsplit(",", 3)[0], *s[11:]], "holds an empty cell at row 9"),
    "run is no integer": (lambda s: [f"{line},{'run' if k == 0 else '0.5'}" for k, line in enumerate(s)], "integers"),
    "nothing": (lambda _: [], "cannot be read as a table"),
    "a poem": (lambda _: ["roses are red", "violets are blue"], "names no unit; use `softneck import`"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_recording_is_one_clear_line(tmp_path: Path, case: str) -> None:
    edit, message = BAD[case]
    path = tmp_path / "bad.csv"
    path.write_text("\n".join(edit(csv_lines(neck_recording(150)))))
    with pytest.raises(SoftneckError, match=message) as caught:
        read_recording(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_late_word_in_a_large_file_is_an_error_without_a_warning(tmp_path: Path) -> None:
    """pandas reads 2^20 cells at once and warned of mixed types on stderr, beside the one line there may be."""
    titles, row = [f"c{j}" for j in range(128)], ",1" * 127
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",".join(titles), *[f"1{row}"] * 8200, f"x{row}"]))
    column = pd.Series(read_table(path, ".csv", TextForm())["c0"])
    with pytest.raises(DataError, match="column `c0` holds `x` at row 8200"):
        _files.numbers(column, "c0", missing=True)


def test_an_index_of_pandas_is_a_column_of_a_parquet_file(tmp_path: Path) -> None:
    table = neck_recording(30).to_pandas().set_index("time [s]")
    table.to_parquet(tmp_path / "a.parquet")
    assert same(read_recording(tmp_path / "a.parquet"), neck_recording(30))


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_a_file_that_is_absent_or_binary(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        read_recording(tmp_path / name)
    (tmp_path / name).write_bytes(bytes(range(256)) * 20)
    with pytest.raises(SoftneckError, match=r"cannot be read as a table|is not a text"):
        read_recording(tmp_path / name)


def test_another_ending_is_refused(tmp_path: Path) -> None:
    for name in ("a.xlsx", "a"):
        with pytest.raises(DataError, match=r"a recording is a `\.csv` or a `\.parquet` file"):
            read_recording(tmp_path / name)
        with pytest.raises(DataError, match=r"a recording is a `\.csv` or a `\.parquet` file"):
            write_recording(tmp_path / name, neck_recording(120))
    assert list(tmp_path.iterdir()) == []


def test_an_existing_recording_is_kept(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.csv", neck_recording(120))
    before = (tmp_path / "a.csv").read_bytes()
    with pytest.raises(OutputFileError, match="exists already; use --force"):
        write_recording(tmp_path / "a.csv", neck_recording(130))
    assert (tmp_path / "a.csv").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@given(data=st.data())
@settings(max_examples=120)
def test_damaged_bytes_are_a_clear_error_and_nothing_else(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    whole = tmp_path / f"whole.{suffix}"
    if not whole.exists():
        write_recording(whole, neck_recording(40))
    content = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
    damaged = tmp_path / f"damaged.{suffix}"
    damaged.write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    with contextlib.suppress(SoftneckError):  # anything else fails the test
        read_recording(damaged)


@pytest.mark.parametrize("cell", ["text", None, [1.0]])
def test_a_parquet_file_of_something_else(tmp_path: Path, cell: object) -> None:
    pd.DataFrame({"time [s]": [0.0, 0.02], "pitch [deg]": [cell, cell]}).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(DataError, match=r"pitch|missing"):
        read_recording(tmp_path / "a.parquet")


# -- whatever may stand for a recording -------------------------------------------------------------------------------


def same(one: Recording, other: Recording) -> bool:
    return (
        set(one.channels) == set(other.channels)
        and one.robot.hash == other.robot.hash
        and one.sample_time == pytest.approx(other.sample_time, rel=1e-9)
        and all(np.allclose(one.channels[name], other.channels[name], rtol=1e-12) for name in one.channels)
        and one.run.tolist() == other.run.tolist()
    )


def test_a_recording_is_opened_from_all_that_holds_one(tmp_path: Path) -> None:
    recording = concatenate([neck_recording(60), neck_recording(40, seed=3)])
    write_recording(tmp_path / "a.csv", recording)
    table = recording.to_pandas()
    for thing in (recording, tmp_path / "a.csv", str(tmp_path / "a.csv"), table, table.set_index("time [s]"),
                  {title: table[title].to_numpy() for title in table}, [*recording.runs()], (recording,)):  # fmt: skip
        assert same(open_recording(thing), recording)
    assert open_recording(recording, recording.robot) is recording
    with pytest.raises(DataError, match="the robot and a recording of two robots cannot be used together"):
        open_recording(recording, "finger")
    # Several are named by their files, else by their numbers.
    slow = Recording(2 * recording.time[:60], 0.04, recording.rows(0, 60).channels)
    with pytest.raises(DataError, match=rf"\({tmp_path / 'a.csv'} and recording 2\)"):
        open_recording([tmp_path / "a.csv", slow])
    assert recording_names(["a.csv", slow, Path("b.csv")]) == ["a.csv", "recording 2", "b.csv"]


def test_an_array_is_a_recording_of_a_robot_that_is_named() -> None:
    robot = Robot.from_dict({"name": "slow", "extends": "neck", "sample_time_s": 4.0})
    U, Y = np.arange(18.0).reshape(6, 3), 0.1 * np.arange(12.0).reshape(6, 2)
    Y[2, 1] = np.nan
    both, alone = open_recording(np.hstack([U, Y]), robot), open_recording(U, robot)
    for made in (both, alone):
        assert (made.sample_time, made.robot.hash) == (4.0, robot.hash)
        np.testing.assert_array_equal(made.set_points, U)
    np.testing.assert_array_equal(both.outputs, Y)
    assert np.isnan(alone.outputs).all()
    for wrong in (U[:, :2], np.hstack([U, Y, Y]), U[:, 0], np.hstack([U, Y])[:, :4]):
        with pytest.raises(DataError, match="recording"):
            open_recording(wrong, robot)
    for thing, hint in ((U, "an array needs `robot=`"), (3.0, "got a float"), (None, "got a NoneType")):
        with pytest.raises(DataError, match=rf"a list of them is needed; {hint}\."):
            open_recording(thing)


def test_a_table_names_its_robot_and_one_that_is_given_goes_first() -> None:
    finger = Robot.preset("finger")
    made = Recording.from_arrays(np.zeros((5, len(finger.set_points))), robot=finger)
    table = made.with_channels(**dict.fromkeys(finger.outputs.names, np.zeros(5))).to_pandas()
    assert Recording.from_pandas(table).robot.hash == finger.hash
    with pytest.raises(DataError, match=r"is not a channel|cannot be in|needs the channels"):
        Recording.from_pandas(table, robot="arm")
    for nothing in ({"pitch [deg]": [1.0], "roll [deg]": [1.0, 2.0]}, {"a": object()}):
        with pytest.raises(DataError, match="the columns do not make a table"):
            open_recording(nothing)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("a,b\n1,2\n", {"a": [1.0], "b": [2.0]}), ("a,b\n1,\n\n-2.5e1,+3\n", {"a": [1.0, -25.0], "b": [np.nan, 3.0]}),
        ("# robot x\na\n1\n", {"a": [1.0]}), ("a,b\r\n1,2\r\n", {"a": [1.0], "b": [2.0]}),
        ("a,b\n1\n", None), ("a,b\n1,2,3\n", None), ("a,a\n1,2\n", None), ("a,\n1,2\n", None), ("a,b\n", None),
        ("a,b\n1,x\n", None), ('"a",b\n1,2\n', None), ("a,b\n1,-\n", None), ("a,b\n1, 2\n", None),
    ],
)  # fmt: skip
def test_a_plain_table_is_numbers_under_titles_that_differ(text: str, plain: dict | None, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode())
    found = read_plain_csv(path)
    assert (found is None) is (plain is None)
    if found is not None and plain is not None:
        assert list(found) == list(plain)
        for name, values in plain.items():
            np.testing.assert_array_equal(found[name], values)


def test_a_plain_table_may_be_as_large_as_it_is_read_fast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a\n12\n")
    for most, read in ((5, True), (4, False)):
        monkeypatch.setattr(_files, "_MAX_PLAIN_BYTES", most)
        assert (read_plain_csv(path) is not None) is read
    path.write_bytes(b"a\n\xff\n")
    monkeypatch.undo()
    assert read_plain_csv(path) is None
    assert read_plain_csv(tmp_path / "none.csv") is None


def test_a_plain_recording_is_read_without_pandas_and_any_other_by_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, read = neck_recording(30), list[str]()
    monkeypatch.setattr(_files, "read_table", lambda *args: read.append(args[1]) or read_table(*args))
    for name in ("a.csv", "a.parquet"):
        write_recording(tmp_path / name, recording)
        assert same(read_recording(tmp_path / name), recording)
    assert read == [".parquet"]


def test_missing_samples_are_allowed_where_a_sensor_may_miss_one() -> None:
    values = pd.Series(["1", None, "NaN", "2"], dtype=object)
    plain = np.array([1.0, np.nan])
    np.testing.assert_array_equal(_files.numbers(plain, "x", missing=True), plain)
    for column, missing, words, said in (
        (plain, False, False, "an empty cell at row 1"), (values, False, False, "an empty cell at row 1"),
        (values, True, False, "`NaN` at row 2"), (values, False, True, "an empty cell at row 1"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=rf"column `x` holds {said}"):
            _files.numbers(column, "x", missing=missing, nan_words=words)
    np.testing.assert_array_equal(_files.numbers(values, "x", missing=True, nan_words=True), [1.0, np.nan, np.nan, 2.0])
    # A cell is told in one line of at most 60 characters.
    for cell, told in (("one\n two", "one two"), ("9" * 60 + "a", "9" * 60)):
        with pytest.raises(DataError, match=f"`{told}` at row 0"):
            _files.numbers(pd.Series([cell, "3"]), "x", missing=True, nan_words=True)


@pytest.mark.parametrize("bad", [0.5, np.nan, np.inf, 2.0**53, -(2.0**53)])
def test_runs_are_numbered_by_integers_that_a_float_holds(bad: float) -> None:
    for column in (np.array([1.0, bad]), pd.Series([1.0, bad])):
        told = "holds an empty cell at row 1" if np.isnan(bad) else "must hold integers"
        with pytest.raises(DataError, match=f"column `run` {told}"):
            _files.integers(column)
    assert _files.integers(np.array([2.0**53 - 1, -3.0])).tolist() == [2**53 - 1, -3]


@pytest.mark.parametrize("name", ["pitch", "roll", "motor_position_2"])
def test_a_sensor_without_any_sample_is_named_with_what_to_do(name: str, tmp_path: Path) -> None:
    silent = neck_recording(30).with_channels(**{name: np.full(30, np.nan)})
    hint = "Leave the column out" if name.startswith("motor") else "A recording needs it; record it again"
    with pytest.raises(DataError, match=rf"channel `{name}` has no sample in any of its 30 rows; .* {hint}\."):
        write_recording(tmp_path / "a.csv", silent)
    assert not list(tmp_path.iterdir())
    # One sample is enough.
    silent.channels[name][29] = 0.1  # pyright: ignore[reportIndexIssue]
    write_recording(tmp_path / "a.csv", silent)


WORDS = {"a": [1.5, -2.0], "b": ["NA", "x y"]}


@pytest.mark.parametrize(
    ("text", "form", "expected"),
    [
        ("a, b\n1.5, NA\n-2.0, x y\n", TextForm(), WORDS),
        ("a;b\n1,5;NA\n-2;x y\n", TextForm(delimiter=";", decimal=","), WORDS),
        ("1.5\tNA\n-2\tx y\n", TextForm(header=False, delimiter="\t"), {"0": WORDS["a"], "1": WORDS["b"]}),
        ("a  b\n1.5 \t 2\n-2 7\n", TextForm(delimiter="whitespace"), {"a": [1.5, -2.0], "b": [2.0, 7.0]}),
        ("x\ny,1,2,3\na,b\n1.5,NA\n-2,x y\n", TextForm(skip=2), WORDS),
        ("x\na,b\ndeg,-\n1.5,NA\n-2,x y\n", TextForm(skip=1, unit_row=True), WORDS),
        ("a,b\ndeg,-\n1.5,NA\n-2,x y\n", TextForm(unit_row=True), WORDS),
        ("a,b\n1.5,\n-2,5\n", TextForm(), {"a": [1.5, -2.0], "b": [np.nan, 5.0]}),
        ("ä,b\n1.5,NA\n-2,x y\n", TextForm(encoding="latin-1"), {"ä": WORDS["a"], "b": WORDS["b"]}),
        ("a,b\n1.5,NA\n-2,x y\n", TextForm(encoding="utf-16"), WORDS),
        ("a,b\n1.5,NA\n-2,x y\n", TextForm(encoding="utf-32"), WORDS),
    ],
)  # fmt: skip
def test_a_table_is_read_by_its_form(text: str, form: TextForm, expected: dict, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(form.encoding))
    found = read_table(path, ".csv", form)
    assert [str(title) for title in found] == list(expected)
    for (_, cells), values in zip(found.items(), expected.values(), strict=True):
        np.testing.assert_array_equal(cells, values)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_zeros_make_a_text_none_unless_its_letters_have_them(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"a,b\n1,2\n\0\0\0\0\n")
    with pytest.raises(FileFormatError, match="is not a text"):
        read_table(tmp_path / "a.csv", ".csv", TextForm(encoding=encoding))
