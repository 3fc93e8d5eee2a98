"""Logs of other tools come back as the recording that they were written from, by guess and by layout."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from softneck.core import SoftneckError
from softneck.signals import SET_POINTS, Recording, guess_layout, import_log, parse_layout
from softneck.signals.recording._channels import MOTOR_POSITIONS

from ..data import TS, neck_recording
from . import log_writers as write
from .test_import_laws import mangled

NECK = neck_recording(400)
CHANNELS = (*SET_POINTS, *MOTOR_POSITIONS, "pitch", "roll")


def columns(r: Recording = NECK, *, degrees: bool = False) -> dict[str, np.ndarray]:
    """The synthetic neck as t, s1 to s3, x1 to x3, pitch and roll."""
    angle = np.degrees if degrees else np.asarray
    found = {"t": r.time}
    for short, names in (("s", SET_POINTS), ("x", MOTOR_POSITIONS)):
        found |= {f"{short}{j}": angle(r.channels[name]) for j, name in enumerate(names, 1)}
    return found | {"pitch": angle(r.channels["pitch"]), "roll": angle(r.channels["roll"])}


def same(found: Recording, known: Recording = NECK, *, atol: float = 1e-12, names: tuple[str, ...] = CHANNELS) -> None:
    """Assert equality to `atol`; degrees there and back cost a few digits of sixteen."""
    assert found.sample_time == pytest.approx(TS, rel=1e-5)
    for name in names:
        np.testing.assert_allclose(found.channels[name], known.channels[name], rtol=1e-12, atol=atol)


def named(r: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns under names that loggers use."""
    return {{"s": "target", "x": "encoder"}.get(n[0], n) + n[1:] if n[1:].isdigit() else n: c for n, c in r.items()}


def abroad(words: dict[str, str]) -> dict[str, np.ndarray]:
    """The columns in degrees under the names of another language."""
    return dict(write.titled(columns(degrees=True), words))


def sparse(path: Path) -> None:
    """A row for each message, as PlotJuggler exports: set-points 4 ms before positions and angles."""
    table = columns()
    asked = pd.DataFrame({"time": table["t"] - 0.004} | {f"cmd.position[{j - 1}]": table[f"s{j}"] for j in (1, 2, 3)})
    there = {f"state.position[{j - 1}]": table[f"x{j}"] for j in (1, 2, 3)} | {n: table[n] for n in ("pitch", "roll")}
    rows = pd.concat([asked, pd.DataFrame({"time": table["t"], **there})]).sort_values("time")
    rows.assign(time=rows["time"] + 0.004).to_csv(path, index=False, float_format="%.17g")


WRITERS: dict[str, Callable[[Path], None]] = {
    "german cp1252.csv": lambda p: write.write_text(p, abroad(write.GERMAN), encoding="cp1252"),
    "spanish utf-16.csv": lambda p: write.write_text(p, abroad(write.SPANISH), encoding="utf-16"),
    "utf-16 without a mark.txt": lambda p: write.write_text(p, named(columns()), encoding="utf-16-le", sep="\t"),
    "sheet.xlsx": lambda p: write.write_sheet(p, named(columns())),
    "sheet with dates.xlsx": lambda p: write.write_sheet(p, named(columns()), dates=True),
    "iso.csv": lambda p: write.write_dates(p, named(columns()), "iso"),
    "day first.csv": lambda p: write.write_dates(p, named(columns()), "%d.%m.%Y %H:%M:%S.%f"),
    "time of day.csv": lambda p: write.write_dates(p, named(columns()), "%H:%M:%S.%f"),
    "epoch.csv": lambda p: write.write_dates(p, named(columns()), "epoch"),
    "epoch ns.csv": lambda p: write.write_dates(p, named(columns()), "epoch_ns"),
    "matrices.mat": lambda p: write.write_mat(p, columns()),
    "turned matrices.mat": lambda p: write.write_mat(p, columns(), turned=True),
    "bag.mcap": lambda p: write.write_mcap(p, columns()),
    "bag of a controller that writes first.mcap": lambda p: write.write_mcap(p, columns(), late=0.004),
    "several clocks.csv": sparse,
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_a_log_of_any_tool_comes_back_by_a_guess(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    guess = guess_layout(path)
    assert guess.missing == (), guess.lines
    assert parse_layout(guess.text) == guess.layout
    assert [str(doubt) for doubt in guess.doubts] == []
    # Excel's days are read back to the microsecond, by which time and not a value is off.
    same(import_log(path, guess.layout).recording)


@pytest.mark.parametrize("mark", ["# operator paused here", "  % mark, 2"])
def test_remarks_between_the_rows_are_left_out_and_it_is_said(tmp_path: Path, mark: str) -> None:
    path = tmp_path / "log.csv"
    write.write_text(path, named(columns()), sep=",", decimal=".")
    lines = path.read_text(encoding="utf-8").splitlines()
    for row in (40, 90):
        lines.insert(row, mark)
    path.write_text("\n".join(lines), encoding="utf-8")
    guess = guess_layout(path)
    assert "file: 2 line(s) of remarks between the rows are left out" in guess.lines
    same(import_log(path, guess.layout).recording)


def test_a_quaternion_is_pitch_and_roll_of_the_axes_that_answer(tmp_path: Path) -> None:
    write.write_mcap(tmp_path / "bag.mcap", columns(), quaternion=True)
    guess = guess_layout(tmp_path / "bag.mcap")
    assert guess.layout.quaternion is not None
    assert (guess.layout.quaternion.pitch, guess.layout.quaternion.roll) == ("y", "x")
    # Half angles and their inverse: a few ulp of 1.
    same(import_log(tmp_path / "bag.mcap", guess.layout).recording, atol=1e-14)
    assert parse_layout(guess.text) == guess.layout
    turned = columns()
    turned["pitch"], turned["roll"] = -turned["roll"], turned["pitch"]
    write.write_mcap(tmp_path / "mounted askew.mcap", turned, quaternion=True)
    askew = guess_layout(tmp_path / "mounted askew.mcap")
    assert askew.layout.quaternion is not None
    assert (askew.layout.quaternion.pitch, askew.layout.quaternion.roll) == ("x", "-y")
    found = import_log(tmp_path / "mounted askew.mcap", askew.layout).recording
    # Two turns about other axes: equal to the order of their product, 0.1^2 / 2 rad here.
    assert np.abs(found.outputs - NECK.outputs).max() < 0.02


@pytest.mark.parametrize("kind", ["mat", "v73"])
def test_cells_of_structures_are_runs(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "trials.mat"
    trials = [columns(NECK.rows(0, 250)), columns(NECK.rows(250, 400))]
    (write.write_trials if kind == "mat" else write.write_trials_v73)(path, trials)
    guess = guess_layout(path)
    found = import_log(path, guess.layout).recording
    assert [len(run) for run in found.runs()] == [trial["t"].size for trial in trials]
    for run, trial in zip(found.runs(), trials, strict=True):
        np.testing.assert_allclose(run.outputs[:, 0], trial["pitch"], rtol=1e-12)
        np.testing.assert_allclose(run.set_points[:, 2], trial["s3"], rtol=1e-12)


def test_positions_stand_in_for_set_points_and_it_is_said(tmp_path: Path) -> None:
    table = {name: c for name, c in named(columns()).items() if not name.startswith("target")}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    found = import_log(tmp_path / "log.csv", guess.layout).recording
    np.testing.assert_allclose(found.set_points, NECK.motor_positions, rtol=1e-12)
    assert [doubt.about for doubt in guess.doubts] == ["motor set-points"]
    assert "NOT SURE (85 %): no set-points were logged, so the positions are the inputs" in guess.text


def test_velocities_are_summed_up_where_nothing_else_moves_the_motors(tmp_path: Path) -> None:
    r = neck_recording(1200)
    table = {"time": r.time, **{f"VelM{j}": np.gradient(r.motor_positions[:, j - 1], TS) for j in (1, 2, 3)},
             "pitch": r.outputs[:, 0], "roll": r.outputs[:, 1]}  # fmt: skip
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    done = import_log(tmp_path / "log.csv", guess.layout)
    # Trapezoids of central differences are the three-point mean (1/4, 1/2, 1/4) of the positions, which the drives of
    # this neck never leave by more than a quarter of their largest step.
    largest = np.abs(np.diff(r.motor_positions, axis=0)).max()
    expected = r.motor_positions - r.motor_positions[0]
    assert np.abs(done.recording.set_points - expected).max() < largest
    assert any("integrated from rates" in note for note in done.notes)


@pytest.mark.parametrize(("axis", "weights"), [("pitch", [1.0, -0.5, -0.5]), ("roll", [0.0, 0.866, -0.866])])
def test_one_axis_is_a_robot_of_one_output(tmp_path: Path, axis: str, weights: list[float]) -> None:
    table = named(columns())
    del table["roll" if axis == "pitch" else "pitch"]
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    assert guess.missing == ()
    # A neck has two: what is missing is said, asked in a terminal and marked in the layout.
    assert [(doubt.about, doubt.taken) for doubt in guess.doubts] == [("outputs", f"{axis} only")]
    assert any(line.startswith(f"not sure: outputs: {axis} only") for line in guess.lines)
    assert f"NOT SURE: outputs: {axis} only" in guess.text
    r = import_log(tmp_path / "log.csv", guess.layout).recording
    assert r.robot.outputs.names == (axis,)
    found = r.robot.weights()
    assert found is not None
    np.testing.assert_allclose(found, [weights], atol=1e-4)  # the paper prints 0.866
    np.testing.assert_allclose(r.channels[axis], NECK.channels[axis], rtol=1e-12)


def test_a_column_without_a_title_is_an_angle_or_an_index_by_its_numbers(tmp_path: Path) -> None:
    table = pd.DataFrame({"": np.arange(len(columns()["t"])), **named(columns())})
    table.to_csv(tmp_path / "whole.csv", index=False)
    whole = guess_layout(tmp_path / "whole.csv")
    assert any("because it counts the rows" in line for line in whole.lines)
    table.drop(columns="").rename(columns={"pitch": ""}).to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    assert guess.layout.robot.outputs.names == ("pitch", "roll")
    assert [doubt.about for doubt in guess.doubts] == ["pitch"]
    found, expected = (import_log(tmp_path / f"{name}.csv", one.layout).recording.outputs
                       for name, one in (("log", guess), ("whole", whole)))  # fmt: skip
    np.testing.assert_array_equal(found, expected)


LAYOUT = """
{file}
[time]
column = "{t}"
[channels]
motor_setpoint_1 = {{ column = "{a}", unit = "rad" }}
motor_setpoint_2 = {{ column = "{b}", unit = "rad" }}
motor_setpoint_3 = {{ column = "{c}", unit = "rad" }}
pitch = {{ column = "pitch", unit = "rad" }}
roll = {{ column = "roll", unit = "rad" }}
"""
FLAT = {"t": "t", "a": "s1", "b": "s2", "c": "s3"}
MATRICES = {"t": "t", "a": "u(:,1)", "b": "u(:,2)", "c": "u(:,3)"}
# Within what motors and platform may reach; exact by any decimal of 17 digits.
numbers = st.floats(-3.0, 3.0, allow_subnormal=False)


@st.composite
def tables(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """Any log of 5 to 30 rows without positions, at any sample time from 1 ms to 1 s."""
    rows, Ts = draw(st.integers(5, 30)), draw(st.floats(1e-3, 1.0))
    found = {"t": Ts * np.arange(rows)}
    for name in ("s1", "s2", "s3", "pitch", "roll"):
        found[name] = draw(arrays(np.float64, rows, elements=numbers))
    return found


COMMA = 'delimiter = ";"\ndecimal = ","\n'
EXACT: dict[str, tuple[Callable[[Path, dict[str, np.ndarray]], None], dict[str, str], str]] = {
    "cp1252.csv": (lambda p, c: write.write_text(p, c, encoding="cp1252"), FLAT, f'{COMMA}encoding = "cp1252"'),
    "utf-16.csv": (lambda p, c: write.write_text(p, c, encoding="utf-16"), FLAT, f'{COMMA}encoding = "utf-16"'),
    "a.xlsx": (write.write_sheet, FLAT, 'sheet = "log"'),
    "a.mat": (write.write_mat, MATRICES, ""),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
@given(table=tables())
@settings(max_examples=25)
def test_any_numbers_come_back(tmp_path: Path, name: str, table: dict[str, np.ndarray]) -> None:
    writer, keys, file = EXACT[name]
    writer(tmp_path / name, table)
    text = LAYOUT.format(file=f"[file]\n{file}" if file else "", **keys)
    found = import_log(tmp_path / name, parse_layout(text)).recording
    # openpyxl writes 16 digits, half an ulp short of all; every other writer 17.
    rtol = 1e-15 if name.endswith("xlsx") else 0.0
    np.testing.assert_allclose(found.time, table["t"], rtol=rtol, atol=0.0)
    for channel, key in zip((*SET_POINTS, "pitch", "roll"), ("s1", "s2", "s3", "pitch", "roll"), strict=True):
        np.testing.assert_allclose(found.channels[channel], table[key], rtol=rtol, atol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["german cp1252.csv", "spanish utf-16.csv", "sheet.xlsx", "day first.csv", "bag.mcap", "several clocks.csv"]
)  # fmt: skip
@given(data=st.data())
@settings(max_examples=40)
def test_damaged_logs_are_a_result_or_a_clear_error(tmp_path: Path, name: str, data: st.DataObject) -> None:
    whole = tmp_path / name
    if not whole.exists():
        WRITERS[name](whole)
    damaged = tmp_path / f"damaged{whole.suffix}"
    damaged.write_bytes(mangled(data, whole.read_bytes()))
    with contextlib.suppress(SoftneckError):  # anything else fails the test
        guess = guess_layout(damaged)
        assert parse_layout(guess.text, robot=guess.layout.robot) == guess.layout
        import_log(damaged, guess.layout)


@pytest.mark.parametrize("head", [b"# Created by Octave 8.4.0, Mon Nov 23 2026 <lab@neck>\n", b"Octave-1-L\0"])
def test_a_file_of_octaves_own_is_named_with_the_way_out(tmp_path: Path, head: bytes) -> None:
    path = tmp_path / "a.mat"
    path.write_bytes(head)
    with pytest.raises(SoftneckError, match=r"of Octave.*, not a log; save it there by `save -v7 log.mat`\."):
        guess_layout(path)
