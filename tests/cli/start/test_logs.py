"""Logs as labs leave them, a stand-in of each kind: each goes on, or ends in one line that says what to do."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from softneck.cli.start import _plan, _start
from softneck.cli.start._plan import STAGES, Options, Step
from softneck.robot import Robot
from softneck.signals import read_recording
from softneck.signals.importing._robot_guess import is_of_another_robot

from ...data import neck_recording
from ..conftest import Call, Said
from .conftest import facts_of

NECK = neck_recording(700)
TILT = ("target_inclination", "sensor_inclination", "target_orientation", "sensor_orientation")


def tilted() -> tuple[np.ndarray, np.ndarray]:
    """Inclination and orientation of NECK [deg], as the data's README turns them into pitch and roll."""
    x, y = np.tan(NECK.outputs.T)
    inclination = np.arctan(np.hypot(x, y))
    return np.degrees(inclination), np.degrees(np.arctan2(x, -y)) % 360.0


def in_degrees_and_constant(path: Path) -> None:
    """`motor_target1..3`, `encoder1..3`, inclination and orientation, all in degrees; set-points of one step."""
    inclination, orientation = tilted()
    settled = 115.189 * (1.0 - np.exp(-np.arange(len(NECK)) / 5.0))
    table: dict[str, Any] = {"time": 0.01 * np.arange(len(NECK))}
    for j, size in ((1, 1.0), (2, -0.347), (3, -0.347)):
        table |= {f"motor_target{j}": 115.189 * size, f"encoder{j}": size * settled}
    table |= {"inclination_sensor": inclination, "orientation_sensor": orientation}
    pd.DataFrame(table).to_csv(path, index=False)


def velocities_alone(path: Path) -> None:
    """Targets and angles [rad], velocities of motors, time in ms with uneven steps; no set-points."""
    rates = np.gradient(NECK.set_points, NECK.sample_time, axis=0)
    jitter = np.random.default_rng(3).uniform(-2.0, 2.0, len(NECK))
    table = {"Time": 1e3 * NECK.time + 14.0 + jitter, "TargetPitch": 0.17, "SensorPitch": NECK.outputs[:, 0],
             "TargetRoll": 0.17, "SensorRoll": NECK.outputs[:, 1],
             **{f"VelM{j}": rates[:, j - 1] for j in (1, 2, 3)}}  # fmt: skip
    pd.DataFrame(table).to_csv(path, index=False)


def bare(path: Path) -> None:
    """No header and no clock, spaces around the commas: angles and positions among constant columns."""
    table = np.column_stack([NECK.outputs, np.zeros(len(NECK)), NECK.set_points, np.full(len(NECK), 93.0)])
    np.savetxt(path, table, delimiter=" , ", fmt="%.6g")


def bare_with_rates(path: Path) -> None:
    """The same with the motors' positions and velocities, which tell the sample time."""
    rates = np.gradient(NECK.set_points, NECK.sample_time, axis=0)
    table = np.column_stack([np.full(len(NECK), 40.0), NECK.outputs, NECK.set_points, rates])
    np.savetxt(path, table, delimiter=" , ", fmt="%.8g")


def references_alone(path: Path) -> None:
    """Where the platform was asked to be and where it was; nothing of the motors."""
    inclination, orientation = tilted()
    columns = (15.0, inclination, 90.0, orientation)
    pd.DataFrame({"time": NECK.time, **dict(zip(TILT, columns, strict=True))}).to_csv(path, index=False)


@pytest.fixture
def until(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Let a run end before a stage."""

    def cut(stage: str) -> None:
        def first(asked: Options) -> Iterator[Step]:
            known = set(STAGES[: STAGES.index(stage)])
            yield from itertools.takewhile(lambda step: step.stage in known, _plan.steps(asked))

        monkeypatch.setattr(_start, "steps", first)
        monkeypatch.setattr(_start, "_facts", facts_of)

    return cut


def begun(call: Call, name: str, write: Callable[[Path], None]) -> Said:
    write(Path.cwd() / name)
    return call("start", name, "-o", "p", "--yes", "--json")


@pytest.mark.parametrize("write", [velocities_alone, bare_with_rates], ids=["velocities", "bare"])
def test_logs_that_hold_what_is_needed_become_recordings(
    call: Call, tmp_path: Path, until: Callable[[str], None], write: Callable[[Path], None]
) -> None:
    until("quality")
    said = begun(call, "log.csv", write)
    assert said.code == 0, said.err
    assert [step["holds"] for step in json.loads(said.out)["steps"]] == [True, True]
    recording = read_recording(tmp_path / "p" / "recordings" / "log.csv")
    # Time stamps that jitter by a tenth of a sample give its mean to a thousandth.
    assert recording.sample_time == pytest.approx(NECK.sample_time, rel=1e-3)
    # Sums of rates that were differences, resampled: a few percent of the range.
    np.testing.assert_allclose(np.ptp(recording.set_points, axis=0), np.ptp(NECK.set_points, axis=0), rtol=0.1)
    assert (tmp_path / "p" / "recordings" / "log.layout.toml").is_file()


def test_a_log_without_motors_ends_in_a_line_that_says_what_to_record(call: Call) -> None:
    said = begun(call, "log.csv", references_alone)
    assert said.code == 2
    last = said.err.splitlines()[-1]
    assert last.startswith("softneck: import: ")
    assert last == (
        "softneck: import: log.csv: not found: motor_setpoint_1..3: no column is of a motor; record their "
        "set-points, positions or velocities too."
    )
    assert "run the same command again" in said.err
    assert said.out == ""


def test_a_log_without_a_clock_goes_on_by_its_layout_once_that_says_the_sample_time(
    call: Call, tmp_path: Path, until: Callable[[str], None]
) -> None:
    until("quality")
    said = begun(call, "log.csv", bare)
    assert said.code == 2
    assert "the sample time: no column rises by equal steps" in said.err.splitlines()[-1]
    assert "say `--sample-time S`" in said.err.splitlines()[-1]
    layout = tmp_path / "p" / "recordings" / "log.layout.toml"
    assert not layout.with_name("log.csv").exists()
    text = layout.read_text(encoding="utf-8")
    layout.write_text(f"{text}\n[time]\nsample_time_s = 0.02\n", encoding="utf-8")
    said = call("start", "log.csv", "-o", "p", "--yes", "--json")
    assert said.code == 0, said.err
    assert "--layout recordings/log.layout.toml" in json.loads(said.out)["steps"][0]["command"]
    assert read_recording(layout.with_name("log.csv")).sample_time == 0.02
    # An edit of the layout is read again, and nothing else is.
    layout.write_text(layout.read_text(encoding="utf-8").replace("0.02", "0.04"), encoding="utf-8")
    call("start", "log.csv", "-o", "p", "--yes", "--json")
    assert read_recording(layout.with_name("log.csv")).sample_time == 0.04


def test_a_log_without_a_clock_goes_on_by_a_sample_time_that_is_given(
    call: Call, tmp_path: Path, until: Callable[[str], None]
) -> None:
    until("quality")
    assert begun(call, "log.csv", bare).code == 2
    said = call("start", "log.csv", "-o", "p", "--yes", "--json", "--sample-time", "0.04")
    assert said.code == 0, said.err
    assert "--sample-time 0.04" in json.loads(said.out)["steps"][0]["command"]
    assert read_recording(tmp_path / "p" / "recordings" / "log.csv").sample_time == 0.04


def test_a_sample_time_for_a_log_that_has_a_clock_is_refused(call: Call, tmp_path: Path) -> None:
    velocities_alone(tmp_path / "log.csv")
    said = call("start", "log.csv", "-o", "p", "--yes", "--sample-time", "0.04")
    assert said.code == 2
    assert "has a clock; leave out --sample-time" in said.err.splitlines()[-1]


@pytest.mark.slow
def test_constant_set_points_are_refused_with_the_reason_and_what_to_record(call: Call, tmp_path: Path) -> None:
    said = begun(call, "log.csv", in_degrees_and_constant)
    assert said.code == 1
    last = said.err.splitlines()[-1]
    assert last.count("the motor set-points are constant") == 1
    assert "motor_setpoint_1, motor_setpoint_2, motor_setpoint_3 never moves" in said.err, "and all else that it lacks"
    assert "Record 60 s of `mixed`" in last
    # What was done stays: 115.189 degrees are 2.01 rad.
    recording = read_recording(tmp_path / "p" / "recordings" / "log.csv")
    assert recording.set_points.max() == pytest.approx(np.radians(115.189), rel=1e-6)
    assert not (tmp_path / "p" / "models").exists()


@pytest.mark.parametrize("axis", ["pitch", "roll"])
def test_one_output_of_a_necks_log_without_titles_may_be_taken_alone(
    call: Call, tmp_path: Path, until: Callable[[str], None], axis: str
) -> None:
    until("quality")
    bare_with_rates(tmp_path / "log.csv")
    said = call("start", "log.csv", "-o", "p", "--yes", "--json", "--output", axis)
    assert said.code == 0, said.err
    recording = read_recording(tmp_path / "p" / "recordings" / "log.csv")
    row = ("pitch", "roll").index(axis)
    assert recording.robot.outputs.names == (axis,)
    # To the eight digits of the file.
    np.testing.assert_allclose(recording.outputs[:, 0], NECK.outputs[: len(recording), row], atol=1e-6)
    weights, of_neck = recording.robot.weights(), Robot.preset().weights()
    assert weights is not None
    assert of_neck is not None
    np.testing.assert_array_equal(weights, of_neck[row : row + 1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("test_soft25mm_400gr", "the motor set-points are constant; nothing can be identified. Record 60 s of `mixed`"),
        # A single step each: all of the motion is in the rows that are trained on.
        ("arm_PI_P40Y40_first600", "the rows held out stand still: pitch moves by 0.1 % of what it does in all rows."),
        ("pid_200", "the rows held out stand still: pitch moves by 2.1 % of what it does in all rows. Record 60 s"),
        ("joystick_first600", "no column is of a motor; record their set-points, positions or velocities too."),
        ("step-coupled_first400", "no column is of a motor; record their set-points, positions or velocities too."),
    ],
)
def test_logs_of_labs_that_teach_nothing_end_in_one_short_line(
    call: Call, shared_data: Path, name: str, says: str
) -> None:
    said = call("start", shared_data / "foreign_logs" / f"{name}.csv", "-o", "p", "--yes")
    assert said.code in (1, 2)
    last = said.err.splitlines()[-1]
    assert says in last
    assert len(last) <= 160


def test_one_angle_of_two_is_doubted_in_the_verdict_of_terminal_json_and_page(
    call: Call, tmp_path: Path, until: Callable[[str], None]
) -> None:
    until("identification")
    table = {"time": NECK.time, **{f"target_motor{j}": NECK.set_points[:, j - 1] for j in (1, 2, 3)}}
    pd.DataFrame({**table, "roll": NECK.outputs[:, 1]}).to_csv("log.csv", index=False)
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert said.code == 0, said.err
    doubt, file = "outputs: roll only (80 % sure)", "recordings/log.layout.toml"
    assert said.err.splitlines()[-1] == f"not sure of the log: {doubt}; see NOT SURE in {file}"
    assert f"not sure: {doubt}: " in said.out
    facts = json.loads(call("start", "log.csv", "-o", "p", "--yes", "--json").out)
    assert [line.startswith(doubt) for line in facts["doubts"][file]] == [True]
    assert call("report", "p", "-o", "page.html").code == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert f"Not sure of the log: {doubt}." in page
    # The import alone says so in its last line too.
    said = call("import", "log.csv", "--guess", "--yes", "-o", "r.csv")
    assert said.out.splitlines()[-1].endswith("; NOT SURE: roll only, as no column is the other angle")
    # Who looked, and found it right, removes the remark.
    layout = tmp_path / "p" / file
    kept = [line for line in layout.read_text().splitlines() if "NOT SURE" not in line]
    layout.write_text("\n".join(kept) + "\n")
    assert json.loads(call("start", "log.csv", "-o", "p", "--yes", "--json").out)["doubts"] == {}


def of_tanks(path: Path) -> None:
    """A pump and a level: no winch, no angle."""
    u = NECK.set_points[:, 0]
    table = {"time [s]": 4.0 * np.arange(len(u)), "pump [V]": 3.0 + u, "level [V]": 5.0 + NECK.outputs[:, 0]}
    pd.DataFrame(table).to_csv(path, index=False)


def of_pressures(path: Path) -> None:
    pressures = {f"pressure_{j}": NECK.set_points[:, j - 1] for j in (1, 2, 3)}
    tip = dict(zip("xy", NECK.outputs.T, strict=True))
    pd.DataFrame({"time [s]": NECK.time, **pressures, **tip}).to_csv(path, index=False)


@pytest.mark.parametrize(("write", "outputs"), [(of_tanks, ("level",)), (of_pressures, ("x", "y"))])
def test_a_log_whose_titles_are_of_another_robot_is_taken_for_one_and_that_is_doubted(
    call: Call, tmp_path: Path, until: Callable[[str], None], write: Callable[[Path], None], outputs: tuple[str, ...]
) -> None:
    until("quality")
    said = begun(call, "log.csv", write)
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert "--robot-out" in facts["steps"][0]["command"]
    doubts = facts["doubts"]["recordings/log.layout.toml"]
    robot_doubt, *others = sorted(doubts, key=lambda doubt: not doubt.startswith("robot: "))
    assert robot_doubt.startswith("robot: ")
    assert others == []  # tanks may be sampled every 4 s, as the title says
    recording = read_recording(tmp_path / "p" / "recordings" / "log.csv")
    assert recording.robot.outputs.names == outputs
    # The range of the recording stands for the limits that nobody gave, and that is doubted too.
    robot = Robot.read(tmp_path / "p" / "robot.toml")
    assert robot.motors.setpoint_max is not None
    assert robot.motors.setpoint_max == pytest.approx(tuple(recording.set_points.max(axis=0)), rel=1e-2)  # three digits
    assert any("range of the set-points" in line for line in facts["doubts"]["robot.toml"])
    # What was proposed is read again by its layout, and nothing is done twice.
    again = json.loads(call("start", "log.csv", "-o", "p", "--yes", "--json").out)
    assert all(step["done_before"] for step in again["steps"][1:])


def test_titles_of_a_neck_are_a_neck_s_whatever_else_was_logged(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    table = {"time": NECK.time, **{f"target_motor{j}": NECK.set_points[:, j - 1] for j in (1, 2, 3)}}
    pd.DataFrame({**table, "pitch": NECK.outputs[:, 0], "roll": NECK.outputs[:, 1], "voltage": 24.0}).to_csv(path)
    assert not is_of_another_robot(path)
    path.write_bytes(b"\x89PNG")
    assert not is_of_another_robot(path)
