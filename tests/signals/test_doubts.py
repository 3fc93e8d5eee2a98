"""What a guess is not sure of: units judged together, how sure it is, and how a doubt is settled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, SettingsError
from softneck.signals import Guess, guess_layout, import_log, parse_layout
from softneck.signals.importing._guess import percent
from softneck.signals.importing._guess_units import UNITS, judge
from softneck.signals.importing._layout import doubts_in

from ..data import neck_recording

NECK = neck_recording(400)


def log(folder: Path, *, motors: float, platform: float, positions: bool = True, header: str = "") -> Path:
    """The synthetic neck scaled so that its motors and its platform reach these numbers, in units that nothing says."""
    scale = motors / np.abs(NECK.set_points).max(), platform / np.abs(NECK.outputs).max()
    columns = {"time": NECK.time} | {f"target{j}{header}": scale[0] * NECK.set_points[:, j - 1] for j in (1, 2, 3)}
    if positions:
        columns |= {f"encoder{j}": scale[0] * NECK.motor_positions[:, j - 1] for j in (1, 2, 3)}
    columns |= {"pitch": scale[1] * NECK.outputs[:, 0], "roll": scale[1] * NECK.outputs[:, 1]}
    pd.DataFrame(columns).to_csv(folder / "log.csv", index=False, float_format="%.17g")
    return folder / "log.csv"


@pytest.mark.parametrize(
    ("motors", "platform", "units"),
    [(115.189, 25.0, ("deg", "deg")), (2.01, 25.0, ("rad", "deg")), (2.01, 0.44, ("rad", "rad")),
     (30.0, 3.0, ("deg", "deg")), (340.0, 45.0, ("deg", "deg")), (5.9, 0.75, ("rad", "rad")),
     (60.0, 0.1, ("deg", "rad"))],
)  # fmt: skip
def test_units_of_clear_logs_are_told_without_a_doubt(
    tmp_path: Path, motors: float, platform: float, units: tuple[str, str]
) -> None:
    guess = guess_layout(log(tmp_path, motors=motors, platform=platform))
    found = {guess.layout.channels[name].unit for name in ("motor_setpoint_1", "motor_position_2")}
    assert (found, guess.layout.channels["roll"].unit) == ({units[0]}, units[1])
    assert guess.doubts == ()


def test_what_could_be_either_is_doubted_and_can_be_settled(tmp_path: Path) -> None:
    # 12 deg are a small move, 12 rad are beyond the range: neither is likely.
    guess = guess_layout(log(tmp_path, motors=12.0, platform=25.0))
    (doubt,) = guess.doubts
    assert doubt.about == "unit of motor set-points and positions"
    assert doubt.confidence < 0.9
    assert f"NOT SURE ({100 * doubt.confidence:.0f} %)" in guess.text
    other = guess.settle_doubt(doubt, doubt.choices[0])
    assert other.doubts == ()
    assert {other.layout.channels[name].unit for name in doubt.channels} == set(doubt.choices)
    assert parse_layout(other.text) == other.layout
    assert "NOT SURE" not in other.text
    with pytest.raises(SettingsError, match=r"unit of motor .*: `turns` is none of"):
        guess.settle_doubt(doubt, "turns")


def test_the_title_of_one_settles_the_unit_of_both(tmp_path: Path) -> None:
    guess = guess_layout(log(tmp_path, motors=12.0, platform=25.0, header=" [deg]"))
    assert guess.doubts == ()
    assert guess.layout.channels["motor_position_1"].unit == "deg"


reach = st.floats(1e-3, 1e4)


@given(asked=reach, moved=reach, tilt=reach)
def test_probabilities_are_of_the_likelier_choice_and_do_not_depend_on_the_unit_of_all(
    asked: float, moved: float, tilt: float
) -> None:
    """Marginals of the likeliest choice of all groups are at least 1/8; a group more never changes a certain title."""
    found = judge({"set-points": asked, "positions": moved, "tilt": tilt}, {})
    assert set(found) == {"set-points", "positions", "tilt"}
    assert all(verdict.unit in UNITS and 1.0 / 8.0 <= verdict.probability <= 1.0 + 1e-12 for verdict in found.values())
    titled = judge({"set-points": asked, "positions": moved, "tilt": tilt}, {"positions": "deg", "tilt": "rad"})
    assert (titled["positions"].unit, titled["tilt"].unit) == ("deg", "rad")
    assert titled["positions"].probability == titled["tilt"].probability == 1.0


@pytest.mark.slow
def test_guesses_that_are_sure_are_right(tmp_path: Path) -> None:
    """Of the units of 300 robots, drawn half as wide again as the odds expect, 90 % of those judged sure are right."""
    rng = np.random.default_rng(0)
    sure = right = 0
    for _ in range(300):
        motors = min(2.0 * np.exp(1.2 * rng.standard_normal()), 6.0)
        tilt = min(motors * 0.1 * np.exp(1.2 * rng.standard_normal()), 1.2)
        units = rng.choice(["rad", "deg"], 2)
        reaches = {"set-points": motors / UNITS[units[0]], "tilt": tilt / UNITS[units[1]]}
        reaches["positions"] = reaches["set-points"] * np.exp(0.1 * rng.standard_normal())
        for group, unit in (("set-points", units[0]), ("tilt", units[1])):
            verdict = judge(reaches, {})[group]
            sure += verdict.probability >= 0.9
            right += verdict.probability >= 0.9 and verdict.unit == unit
    assert sure > 400  # of 600: a rule that doubts everything is no use
    assert right > 0.9 * sure  # the promise; 96 % are


@pytest.mark.parametrize(("scale", "code"), [(1.0, "fine"), (1.2, "warned"), (2.0, "refused")])
def test_more_than_the_robot_s_range_is_told_or_refused(tmp_path: Path, scale: float, code: str) -> None:
    path = log(tmp_path, motors=5.9 * scale, platform=0.5, positions=False)
    layout = guess_layout(log(tmp_path, motors=5.0, platform=0.5, positions=False)).layout
    log(tmp_path, motors=5.9 * scale, platform=0.5, positions=False)
    if code == "refused":
        with pytest.raises(DataError, match=r"reaches 11.* rad, which is 2 turns; the motors' range is 6 rad.*degrees"):
            import_log(path, layout)
        return
    notes = import_log(path, layout).notes
    assert any("the motors' range is 6 rad" in note for note in notes) == (code == "warned")


def test_a_wrong_sign_is_turned_round_doubted_and_can_be_taken_as_logged(tmp_path: Path) -> None:
    path = log(tmp_path, motors=3.0, platform=20.0)
    right = guess_layout(path)
    frame = pd.read_csv(path)
    frame["roll"] *= -1.0
    frame.to_csv(path, index=False)
    guess = guess_layout(path)
    (doubt,) = guess.doubts
    assert (doubt.about, doubt.taken, doubt.choices) == ("sign of roll", "inverted", ("as logged",))
    assert 0.5 < doubt.confidence < 0.9, "the likelier answer is taken, and asked about"
    assert guess.layout.channels["roll"].sign == -1.0
    assert guess.layout == parse_layout(guess.text)
    assert guess.settle_doubt(doubt, "as logged").layout == right.layout
    assert guess.settle_doubt(doubt).layout == guess.layout


def test_a_log_without_a_clock_takes_the_sample_time_that_is_answered(tmp_path: Path) -> None:
    path = log(tmp_path, motors=3.0, platform=20.0)
    pd.read_csv(path).drop(columns="time").to_csv(path, index=False)
    guess = guess_layout(path)
    assert guess.missing == ("the sample time: no column rises by equal steps; say `--sample-time S`",)
    told: Guess = guess.with_sample_time(0.02)
    assert told.missing == ()
    assert parse_layout(told.text) == told.layout
    assert import_log(path, told.layout).recording.sample_time == 0.02
    assert told.doubts == guess.doubts


def test_a_sample_time_that_is_answered_is_doubted_where_a_column_may_be_a_clock(tmp_path: Path) -> None:
    path = log(tmp_path, motors=3.0, platform=20.0)
    frame = pd.read_csv(path)
    frame["time"] = [f"row {k}" for k in range(len(frame))]
    frame.to_csv(path, index=False)
    told = guess_layout(path).with_sample_time(0.02)
    assert [(doubt.about, doubt.taken) for doubt in told.doubts] == [("sample time", "20 ms as given")]
    assert "column 'time' was not recognised as a clock" in told.doubts[0].why
    path.with_suffix(".toml").write_text(told.text, encoding="utf-8")
    assert any("sample time: 20 ms as given (60 % sure)" in line for line in doubts_in(path.with_suffix(".toml")))


def test_grad_is_doubted_with_gon_beside_it_unless_the_log_is_german(tmp_path: Path) -> None:
    path = log(tmp_path, motors=115.0, platform=20.0, header=" [grad]")
    (doubt,) = guess_layout(path).doubts
    assert (doubt.taken, "gon" in doubt.choices) == ("deg", True)
    other = guess_layout(path).settle_doubt(doubt, "gon")
    assert other.layout.channels["motor_setpoint_1"].unit == "gon"
    path.write_text(path.read_text().replace("target", "Sollwert Motor "), encoding="utf-8")
    assert guess_layout(path).doubts == ()


def test_references_in_another_unit_than_the_angles_do_not_change_theirs_and_are_doubted(tmp_path: Path) -> None:
    path = log(tmp_path, motors=2.01, platform=0.44)
    frame = pd.read_csv(path)
    frame.assign(pitch_target=np.degrees(1.1 * frame["pitch"])).to_csv(path, index=False)
    guess = guess_layout(path)
    units = {name: guess.layout.channels[name].unit for name in ("pitch", "roll", "pitch_reference")}
    assert units == {"pitch": "rad", "roll": "rad", "pitch_reference": "deg"}
    assert [doubt.about for doubt in guess.doubts] == ["unit of angles of the platform"]
    # In one unit nothing is to be doubted.
    frame.assign(pitch_target=1.1 * frame["pitch"]).to_csv(path, index=False)
    assert guess_layout(path).doubts == ()


@pytest.mark.parametrize("size", [4096 / (2.0 * np.pi), 53.0 * 4096 / (2.0 * np.pi), 300.0, 1.0 / (2.0 * np.pi)],
                         ids=["counts", "geared counts", "before the gear", "turns"])  # fmt: skip
@pytest.mark.parametrize("motors", [2.01, 115.189], ids=["rad", "deg"])
def test_positions_in_counts_come_back_as_what_was_asked_and_are_doubted(
    tmp_path: Path, size: float, motors: float
) -> None:
    path = log(tmp_path, motors=motors, platform=25.0)
    frame, told = pd.read_csv(path), {}
    for k in (1, 2, 3):
        x = frame[f"encoder{k}"]
        told[f"encoder{k}"] = size * (np.radians(x) if motors > 100.0 else x)
    frame.assign(**told).to_csv(path, index=False)
    guess = guess_layout(path)
    assert [doubt.about for doubt in guess.doubts] == ["unit of motor set-points and positions"]
    truth = import_log(path, guess.layout).recording
    # The factor is fitted by one linear pole; the synthetic drives have a slew limit beside it: 1 %.
    scale = 2.01 / np.abs(NECK.set_points).max()
    np.testing.assert_allclose(truth.motor_positions, scale * NECK.motor_positions, rtol=1e-2, atol=1e-6)


def test_counts_of_set_points_and_positions_are_refused_with_the_fix(tmp_path: Path) -> None:
    path = log(tmp_path, motors=69_000.0, platform=25.0)
    with pytest.raises(DataError, match=r"\d+ turns; .* are they an encoder's counts \(`unit = \"rad\", factor"):
        import_log(path, guess_layout(path).layout)


def test_a_number_that_stands_for_what_was_missed_is_refused_by_its_name(tmp_path: Path) -> None:
    path = log(tmp_path, motors=2.01, platform=25.0)
    frame = pd.read_csv(path)
    frame.loc[frame.index[50::60], "pitch"] = -999.0
    frame.to_csv(path, index=False)
    with pytest.raises(DataError, match=r"column `pitch` holds -999 in 6 rows, \d+ times as far as all others"):
        import_log(path, guess_layout(path).layout)
    frame["pitch"] = frame["pitch"].where(frame["pitch"] > -900.0)
    frame.to_csv(path, index=False)
    recording = import_log(path, guess_layout(path).layout).recording
    assert np.isnan(recording.channels["pitch"]).sum() == 6


def test_a_layout_file_tells_its_doubts_until_they_are_settled(tmp_path: Path) -> None:
    path, layout = log(tmp_path, motors=12.0, platform=25.0), tmp_path / "log.layout.toml"
    pd.read_csv(path).drop(columns="roll").to_csv(path, index=False)
    guess = guess_layout(path)
    layout.write_text(guess.text)
    # Which outputs there are comes first: all else follows from it.
    assert [line.partition(" sure): ")[0] for line in doubts_in(layout)] == [
        "outputs: pitch only (80 %",
        *(f"motor_{what}_1, motor_{what}_2, motor_{what}_3 ({percent(guess.doubts[0].confidence)}" for what in
          ("setpoint", "position")),
    ]  # fmt: skip
    for doubt in guess.doubts:
        guess = guess.settle_doubt(doubt)
    layout.write_text(guess.text)
    assert doubts_in(layout) == ()
    layout.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match="is not a layout"):
        doubts_in(layout)
