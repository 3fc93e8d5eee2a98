"""A layout proposed from a log: by names, by data, and what it says where it does not know."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from softneck.core import DataError, FileFormatError, SettingsError
from softneck.signals import (
    SET_POINTS,
    Layout,
    Recording,
    guess_layout,
    import_log,
    layout_toml,
    parse_layout,
    read_layout,
)
from softneck.signals.importing._guess_shapes import find_outputs, find_rates, max_correlation
from softneck.signals.importing._layout import Source, Term
from softneck.signals.recording._channels import MOTOR_POSITIONS, known_channels, redefine, si_unit

from ..data import LAYOUTS, TS, neck_recording

NECK = neck_recording(1200)
UNITS = {"rad": ["rad", "deg"], "s": ["s", "ms"], "rad/s": ["rad/s", "deg/s", "rpm"], "m": ["m", "mm"], "N": ["N"],
         "kg": ["kg", "g"], "1": ["1"]}  # fmt: skip

columns = st.text(min_size=1, max_size=8) | st.integers(0, 30)
finite = st.floats(allow_nan=False, allow_infinity=False).filter(bool)


def sources(quantity: str) -> st.SearchStrategy[Source]:
    terms = st.lists(st.builds(Term, columns, finite), max_size=3).map(tuple)
    return st.builds(Source, terms, st.sampled_from(UNITS[quantity]), st.sampled_from([1.0, -1.0]))


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    names = draw(st.sets(st.sampled_from(known_channels()[1:]), max_size=6))
    tilt = draw(st.booleans())
    estimate = draw(st.booleans())
    first = draw(st.integers(0, 99))
    header = draw(st.booleans())
    clock = st.builds(Source, st.builds(Term, columns, finite).map(lambda term: (term,)), st.sampled_from(UNITS["s"]))
    return Layout(
        channels={name: draw(sources(si_unit(name))) for name in names},
        inclination=draw(sources("rad")) if tilt else None,
        orientation=draw(sources("rad")) if tilt else None,
        time=draw(st.none() | clock),
        sample_time=None if estimate else draw(st.none() | st.floats(1e-6, 1e3)),
        estimate=estimate,
        new_run_at_restart=draw(st.booleans()),
        duplicates=draw(st.sampled_from([None, "first", "last"])),
        run=draw(st.none() | columns),
        variable=draw(st.none() | st.text(max_size=5)),
        header=header,
        delimiter=draw(st.sampled_from([",", ";", "\t", "|", '"', "\\", "whitespace"])),
        decimal=draw(st.sampled_from([".", ","])),
        skip=draw(st.integers(0, 9)),
        unit_row=header and draw(st.booleans()),
        rows=draw(st.none() | st.just((first, first + 5))),
    )


@pytest.mark.slow
@given(layout=layouts(), remark=st.text(max_size=20))
@settings(max_examples=60)
def test_a_layout_survives_its_file(tmp_path: Path, layout: Layout, remark: str) -> None:
    remarks = dict.fromkeys(("time", "sample_time", "file", "pitch", "inclination", *layout.channels), remark)
    text = layout_toml(layout, remarks=remarks, open_ends=[remark])
    (tmp_path / "layout.toml").write_text(text, encoding="utf-8", newline="")
    assert read_layout(tmp_path / "layout.toml") == layout
    assert parse_layout(layout_toml(layout)) == layout


def test_a_time_that_a_file_cannot_say_is_refused() -> None:
    with pytest.raises(SettingsError, match="the time of a layout is one column without a sign"):
        layout_toml(Layout(channels={}, time=Source((Term("t"),), "s", -1.0)))


def table(*, degrees: bool = True, positions: bool = True, r: Recording = NECK) -> dict[str, np.ndarray]:
    """The columns of the synthetic neck under short keys."""
    angle = np.degrees if degrees else np.asarray
    found = {"t": r.time} | {f"s{j}": angle(r.channels[name]) for j, name in enumerate(SET_POINTS, 1)}
    if positions:
        found |= {f"x{j}": angle(r.channels[name]) for j, name in enumerate(MOTOR_POSITIONS, 1)}
    return found | {"pitch": np.degrees(r.outputs[:, 0]), "roll": np.degrees(r.outputs[:, 1])}


def same(r: Recording, *, rtol: float = 1e-12, channels: tuple[str, ...] = (*SET_POINTS, "pitch", "roll")) -> None:
    """Assert that the recording is the synthetic neck; twelve digits leave room for units there and back."""
    for name in channels:
        np.testing.assert_allclose(r.channels[name], NECK.channels[name], rtol=rtol, atol=1e-12)
    assert r.sample_time == pytest.approx(TS, rel=1e-6)


NAMES = {
    "lab": ("time", "target_motor{}", "encoder{}", "pitch", "roll"),
    "camel": ("Timestamp", "MotorSetPoint{}", "MotorPosition{}", "imuPitch", "imuRoll"),
    "short": ("t", "cs{}", "m{}", "pitch_sensor", "roll_sensor"),
    "ros": ("elapsed_s", "joint_{}_cmd_deg", "joint_{}_pos_deg", "imu_pitch_deg", "imu_roll_deg"),
    "titled": ("time (s)", "command m{} [deg]", "actual m{} [deg]", "pitch [deg]", "roll [deg]"),
}


@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
def test_names_that_loggers_use_are_known(tmp_path: Path, kind: str, delimiter: str) -> None:
    t, s, x, pitch, roll = NAMES[kind]
    names = [t, *(s.format(j) for j in (1, 2, 3)), *(x.format(j) for j in (1, 2, 3)), pitch, roll]
    if delimiter == " ":
        names = [name.replace(" ", "_").replace("_[", "[").replace("_(", "(") for name in names]
    frame = pd.DataFrame(dict(zip(names, table().values(), strict=True)))
    frame.to_csv(tmp_path / "log.txt", sep=delimiter, index=False)
    guess = guess_layout(tmp_path / "log.txt")
    assert guess.missing == ()
    same(
        import_log(tmp_path / "log.txt", guess.layout).recording,
        channels=(*SET_POINTS, *MOTOR_POSITIONS, "pitch", "roll"),
    )
    assert any(line.startswith(f"motor_setpoint_1 from column '{names[1]}' [deg]: because") for line in guess.lines)


def test_milliseconds_decimal_commas_and_columns_that_are_something_else(tmp_path: Path) -> None:
    more = {"pitch_error": np.sin(NECK.time), "current1": np.cos(NECK.time), "yaw": np.sin(3 * NECK.time),
            "note": np.full(1200, "ok"), "fan": np.ones(1200)}  # fmt: skip
    frame = pd.DataFrame(table(degrees=False) | more).rename(columns={"t": "timestamp"})
    frame["timestamp"] *= 1000
    frame.to_csv(tmp_path / "log.csv", sep=";", decimal=",", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    assert (guess.layout.delimiter, guess.layout.decimal) == (";", ",")
    assert guess.layout.time == Source((Term("timestamp"),), "ms")
    for start in ("column 'pitch_error': because 'error' is", "column 'current1': because 'current' is",
                  "column 'yaw': because yaw is not a channel", "column 'note': because it holds words",
                  "column 'fan': because it never changes"):  # fmt: skip
        assert any(line.startswith(f"ignored: {start}") for line in guess.lines), start


@pytest.mark.parametrize("remarks", [["# made by the lab's logger"], ["logger 3, 2026", "", "neck with spring"]])
@pytest.mark.parametrize("header", [True, False])
def test_remarks_before_the_table_are_left_out(tmp_path: Path, remarks: list[str], header: bool) -> None:
    columns = {f"target{name[1]}" if name[0] == "s" else name: c for name, c in table(degrees=False).items()}
    text = pd.DataFrame(columns).to_csv(index=False, header=header)
    (tmp_path / "log.csv").write_text("\n".join([*remarks, text]))
    guess = guess_layout(tmp_path / "log.csv")
    assert (guess.layout.skip, guess.layout.header) == (len(remarks), header)
    assert parse_layout(guess.text) == guess.layout
    assert len(import_log(tmp_path / "log.csv", guess.layout).recording) == 1200


@pytest.mark.parametrize("brackets", ["{}", "[{}]"])
@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", ",")])
def test_a_line_of_units_below_the_names_is_read(tmp_path: Path, brackets: str, delimiter: str, decimal: str) -> None:
    columns = {f"target{name[1]}" if name[0] == "s" else name.replace("x", "encoder"): c for name, c in table().items()}
    columns["t"] = 1000 * columns["t"]
    names, *rows = pd.DataFrame(columns).to_csv(index=False, sep=delimiter, decimal=decimal).splitlines()
    units = delimiter.join(brackets.format(unit) for unit in ["ms", *["deg"] * 8])
    # Loggers end lines with a delimiter, Windows with CR LF, and its editors begin with a byte order mark.
    text = "\r\n".join(line + delimiter for line in ["logger 3", names, units, *rows])
    (tmp_path / "log.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    guess = guess_layout(tmp_path / "log.csv")
    assert (guess.layout.skip, guess.layout.header, guess.layout.unit_row) == (1, True, True)
    assert guess.layout.time == Source((Term("t"),), "ms")
    assert parse_layout(guess.text) == guess.layout
    same(import_log(tmp_path / "log.csv", guess.layout).recording)
    assert any("because its title says so" in line or "says ms" in line for line in guess.lines)
    assert any(line.startswith("ignored: column 'Unnamed: 9': because it is empty") for line in guess.lines)


def test_the_set_points_are_those_that_the_positions_follow(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    decoy = {f"target_{j}": rng.standard_normal(1200) for j in (1, 2, 3)}
    real = {
        name.replace("s", "cs") if name[0] == "s" else name.replace("x", "encoder"): c for name, c in table().items()
    }
    pd.DataFrame(decoy | real).to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    assert [guess.layout.channels[name].terms[0].column for name in SET_POINTS] == ["cs1", "cs2", "cs3"]
    assert any("target_1" in line and "more closely" in line for line in guess.lines)


@pytest.mark.parametrize("kind", ["csv", "matrix", "names that say nothing"])
@pytest.mark.parametrize("positions", [True, False], ids=["positions", "set-points only"])
def test_a_table_without_names_is_told_by_its_data(tmp_path: Path, kind: str, positions: bool) -> None:
    found = table(degrees=False, positions=positions)
    found["pitch"], found["roll"] = NECK.outputs[:, 0], -NECK.outputs[:, 1]
    values = np.column_stack(list(found.values()))
    path = tmp_path / ("log.mat" if kind == "matrix" else "log.csv")
    if kind == "matrix":
        savemat(path, {"log": values, "gain": np.eye(2)})
    elif kind == "csv":
        np.savetxt(path, values, fmt="%.17g", delimiter="\t")
    else:
        pd.DataFrame(values, columns=[f"ch_{c}" for c in "abcdefghijkl"[: values.shape[1]]]).to_csv(path, index=False)
    guess = guess_layout(path)
    assert guess.missing == ()
    same(import_log(path, guess.layout).recording)
    assert guess.layout.channels["roll"].sign == -1.0
    assert any(line.startswith("not sure: pitch from column") for line in guess.lines)


def held(*, set_points: str, positions: str, sign: float = 1.0) -> dict[str, np.ndarray]:
    """A log of one held target, [0, 115.189, 0] deg, that motor 2 reaches and the platform answers."""
    arrived = 1.0 - np.exp(-NECK.time / 0.3)
    target, unit = np.array([0.0, sign * 115.189, 0.0]), {"deg": 1.0, "rad": np.pi / 180.0}
    rng = np.random.default_rng(0)
    found = {"time": NECK.time}
    found |= {f"motor_target{j}": np.full(NECK.time.size, unit[set_points] * target[j - 1]) for j in (1, 2, 3)}
    moved = arrived[:, None] * target + 0.05 * rng.standard_normal((NECK.time.size, 3))
    found |= {f"encoder{j}": unit[positions] * moved[:, j - 1] for j in (1, 2, 3)}
    return found | {"pitch": -10.0 * arrived, "roll": 17.0 * arrived}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("set_points", "positions"), [("deg", "deg"), ("rad", "rad"), ("deg", "rad"), ("rad", "deg")])
def test_set_points_that_stand_still_are_in_the_unit_of_their_positions(
    tmp_path: Path, set_points: str, positions: str, sign: float
) -> None:
    pd.DataFrame(held(set_points=set_points, positions=positions, sign=sign)).to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    done = import_log(tmp_path / "log.csv", guess.layout)
    np.testing.assert_allclose(done.recording.set_points[:, 1], sign * np.radians(115.189), rtol=1e-12)
    # Within the noise of the encoder, 0.05 deg, four standard deviations.
    np.testing.assert_allclose(done.recording.motor_positions[-50:, 1], sign * np.radians(115.189), atol=0.0035)
    assert "no set-point ever changes" in done.notes[-1]
    # One reaching 57 times the other is a clue, but not a proof.
    unsure = [line for line in guess.lines if line.startswith("not sure: motor_")]
    assert len(unsure) == (0 if set_points == positions else 6)


@pytest.mark.parametrize("titled", ["motor_target", "encoder"])
def test_a_unit_in_the_title_of_one_motor_s_column_is_that_of_all(tmp_path: Path, titled: str) -> None:
    # 10 deg are within reach in rad too: only the title tells.
    columns = {
        name: 0.08 * c if name[-1] in "123" else c for name, c in held(set_points="deg", positions="deg").items()
    }
    frame = pd.DataFrame(columns).rename(columns={f"{titled}{j}": f"{titled}{j} [deg]" for j in (1, 2, 3)})
    frame.to_csv(tmp_path / "log.csv", index=False)
    layout = guess_layout(tmp_path / "log.csv").layout
    assert {layout.channels[name].unit for name in (*SET_POINTS, *MOTOR_POSITIONS)} == {"deg"}


@pytest.mark.parametrize("channel", ["motor_setpoint_2", "motor_position_2"])
def test_motors_beyond_two_turns_are_refused_with_the_fix(tmp_path: Path, channel: str) -> None:
    pd.DataFrame(held(set_points="deg", positions="deg")).to_csv(tmp_path / "log.csv", index=False)
    text = guess_layout(tmp_path / "log.csv").text
    lines = [line.replace('"deg"', '"rad"') if line.startswith(channel) else line for line in text.splitlines()]
    with pytest.raises(DataError, match=rf"log.csv: `{channel}` reaches 115.* rad, which is 18 turns.*in degrees"):
        import_log(tmp_path / "log.csv", parse_layout("\n".join(lines)))


def test_a_glitch_of_an_encoder_is_not_a_unit(tmp_path: Path) -> None:
    columns = held(set_points="rad", positions="rad")
    columns["encoder2"][100] = 4096.0
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    source = {name: Source((Term(f"encoder{name[-1]}"),), "rad") for name in MOTOR_POSITIONS}
    source |= {name: Source((Term(f"motor_target{name[-1]}"),), "rad") for name in SET_POINTS}
    source |= {name: Source((Term(name),), "deg") for name in ("pitch", "roll")}
    layout = Layout(channels=source, sample_time=TS)
    assert import_log(tmp_path / "log.csv", layout).recording.motor_positions[100, 1] == 4096.0


def test_restarts_runs_and_duplicates_are_seen(tmp_path: Path) -> None:
    columns = table()
    columns["t"] = np.tile(NECK.time[:400], 3)
    pd.DataFrame(columns).rename(columns={"x1": "enc1", "x2": "enc2", "x3": "enc3"}).to_csv(tmp_path / "a.csv")
    frame = pd.read_csv(tmp_path / "a.csv").rename(columns={"s1": "ref1", "s2": "ref2", "s3": "ref3"})
    frame.to_csv(tmp_path / "a.csv", index=False)
    guess = guess_layout(tmp_path / "a.csv")
    assert guess.layout.new_run_at_restart
    assert [len(run) for run in import_log(tmp_path / "a.csv", guess.layout).recording.runs()] == [400] * 3
    assert any("'Unnamed: 0': because it counts the rows" in line for line in guess.lines)
    frame.assign(run=np.repeat([1, 2, 3], 400)).to_csv(tmp_path / "b.csv", index=False)
    guess = guess_layout(tmp_path / "b.csv")
    assert (guess.layout.run, guess.layout.new_run_at_restart) == ("run", False)
    pd.concat([frame[:20], frame[19:400]]).to_csv(tmp_path / "c.csv", index=False)
    guess = guess_layout(tmp_path / "c.csv")
    assert guess.layout.duplicates == "first"
    assert len(import_log(tmp_path / "c.csv", guess.layout).recording) == 400


def test_what_is_missing_is_named_with_its_candidates(tmp_path: Path) -> None:
    frame = pd.DataFrame({"time": NECK.time, **{f"encoder{j}": NECK.motor_positions[:, j - 1] for j in (1, 2, 3)},
                          "pitch": NECK.outputs[:, 0], "yaw": np.cos(NECK.time)})  # fmt: skip
    frame.to_csv(tmp_path / "log.csv", index=False)
    guess = guess_layout(tmp_path / "log.csv")
    assert len(guess.missing) == 1
    assert guess.missing[0].startswith("roll: is it 'yaw'? Write `roll = { column = 'yaw'")
    assert any("no set-points were logged, so the positions are the inputs" in line for line in guess.lines)
    assert parse_layout(guess.text) == guess.layout
    assert "# MISSING roll: is it 'yaw'?" in guess.text


def test_angles_that_fall_with_the_motors_are_doubted(tmp_path: Path) -> None:
    columns = {f"target{j}" if name[0] == "s" else name: c for name, c in table(positions=False).items()
               for j in (name[-1],)}  # fmt: skip
    columns["roll"] = -columns["roll"]
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    lines = guess_layout(tmp_path / "log.csv").lines
    assert any(line.startswith("not sure: roll falls as phi_i rises (correlation -") for line in lines)
    assert any(line.startswith("check: pitch and theta_i") for line in lines)


def test_what_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        guess_layout(tmp_path / "none.csv")
    for text, message in (("", "it is empty"), ("roses are red\nviolets are blue\n", r"has 0 column\(s\) of numbers"),
                          ("a,b\n1,2\n3,4\n", r"has 2 column\(s\) of numbers")):  # fmt: skip
        (tmp_path / "a.csv").write_text(text)
        with pytest.raises((FileFormatError, DataError), match=message):
            guess_layout(tmp_path / "a.csv")


def test_the_open_loop_recording_comes_out_as_its_layout(shared_data: Path) -> None:
    log = shared_data / "neck_openloop/spring_test_0gr.csv"
    guess, known = guess_layout(log), read_layout(LAYOUTS / "neck_openloop.toml")
    assert {name: guess.layout.channels[name] for name in known.channels} == known.channels
    assert (guess.layout.inclination, guess.layout.orientation) == (known.inclination, known.orientation)
    assert (guess.layout.time, guess.layout.new_run_at_restart) == (known.time, False)
    done = import_log(log, guess.layout)
    # The README of the recordings: 20.3 to 22.4 ms; speeds are the command less its error.
    assert 0.0203 < done.recording.sample_time < 0.0224
    np.testing.assert_array_equal(done.recording.outputs, import_log(log, known).recording.outputs)


@pytest.mark.parametrize("payload", ["000", "400", "1000"])
def test_the_closed_loop_recordings_come_out_as_their_layout(shared_data: Path, payload: str) -> None:
    guess = guess_layout(shared_data / f"neck_closedloop/frontier_test_{payload}gr.csv")
    assert guess.layout == read_layout(LAYOUTS / "neck_closedloop.toml")


@pytest.mark.slow
def test_the_arm_comes_out_as_far_as_its_data_tell(shared_data: Path) -> None:
    guess, known = (
        guess_layout(shared_data / "arm_multisine/arm_multisine_400s.csv"),
        read_layout(LAYOUTS / "arm_multisine.toml"),
    )
    assert guess.layout.sample_time == known.sample_time
    for name, source in known.channels.items():
        found = guess.layout.channels[name]
        assert (found.unit, found.sign) == (source.unit, source.sign)
        assert [term.column for term in found.terms] == [term.column for term in source.terms]
        for term, other in zip(found.terms, source.terms, strict=True):
            # Set-points are sums fitted to positions that trail them: 0.6 % off at most on this record.
            assert term.factor == pytest.approx(other.factor, rel=0.01)


def test_what_leads_the_motors_is_no_angle_however_alike() -> None:
    x = neck_recording(1500).motor_positions
    assert x is not None
    theta, phi = redefine(x)[:, 0], redefine(x)[:, 1]
    rng = np.random.default_rng(0)
    # The angle is noisy, so that the command, 3 samples ahead, is more alike.
    noisy = np.roll(theta, 5) + theta.std() * rng.standard_normal(theta.size)
    columns: dict[str | int, np.ndarray] = {0: np.roll(theta, -3), 1: noisy, 2: np.roll(phi, 5)}
    assert max_correlation(theta, columns[0], 25)[0] > max_correlation(theta, columns[1], 25)[0] + 0.1
    found = find_outputs(columns, x, list(columns))
    assert {axis: column for axis, (column, _) in found.items()} == {"pitch": 1, "roll": 2}


def test_a_motor_that_stands_still_hides_no_rates() -> None:
    x = neck_recording(1500).motor_positions
    assert x is not None
    x = x.copy()
    x[:, 2] = 1e-4 * np.random.default_rng(0).standard_normal(len(x))
    v = np.gradient(x, TS, axis=0)
    v[:, 2] = 1e-3 * np.random.default_rng(1).standard_normal(len(x))
    columns: dict[str | int, np.ndarray] = dict(zip(range(6), np.column_stack([x, v]).T, strict=True))
    found = find_rates(columns, np.zeros(len(x), dtype=np.int64))
    assert found is not None
    assert found[:2] == ((0, 1, 2), (3, 4, 5))
