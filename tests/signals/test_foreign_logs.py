"""Six logs as labs left them (shared/data/foreign_logs): what each trap needs is done, or said in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck.signals import SET_POINTS, Guess, guess_layout, import_log, parse_layout
from softneck.signals.recording._channels import MOTOR_POSITIONS


@pytest.fixture(scope="module")
def logs(shared_data: Path) -> Path:
    """The folder of the logs."""
    folder = shared_data / "foreign_logs"
    if not folder.is_dir():
        pytest.skip("../shared/data has no foreign logs")
    return folder


def test_a_step_in_degrees_is_one_and_teaches_nothing(logs: Path) -> None:
    guess = guess_layout(logs / "test_soft25mm_400gr.csv")
    assert {guess.layout.channels[name].unit for name in (*SET_POINTS, *MOTOR_POSITIONS)} == {"deg"}
    assert guess.doubts == ()
    done = import_log(logs / "test_soft25mm_400gr.csv", guess.layout)
    # README of the logs: 115.189 is 2.01 rad.
    assert done.recording.set_points[0, 0] == pytest.approx(2.01, abs=0.005)
    assert any("no set-point ever changes: nothing can be identified" in note for note in done.notes)
    for unit in ("rad", "deg"):
        lines = [line.replace('"deg"', f'"{unit}"') if line.startswith("motor_") else line
                 for line in guess.text.splitlines()]  # fmt: skip
        layout = parse_layout("\n".join(lines))
        if unit == "deg":
            assert layout == guess.layout
            continue
        with pytest.raises(ValueError, match=r"reaches 115.* rad, which is 18 turns; .*is it in degrees"):
            import_log(logs / "test_soft25mm_400gr.csv", layout)


def test_velocities_become_inputs_and_it_is_said(logs: Path) -> None:
    guess = guess_layout(logs / "pid_200.csv")
    assert {guess.layout.channels[name].integrate for name in SET_POINTS} == {True}
    assert {doubt.about for doubt in guess.doubts} == {"motor set-points", "sign of pitch", "sign of roll"}
    done = import_log(logs / "pid_200.csv", guess.layout)
    # Time in ms, 16 to 21 of them: resampled at the mean, 20.05.
    assert done.recording.sample_time == pytest.approx(0.02005, abs=5e-5)
    assert any("integrated from rates" in note for note in done.notes)
    assert any("uneven" in note for note in done.notes)
    # Rectangles over the raw rows: half a step of the first move apart from trapezoids, 5 % of the whole.
    t, v = np.loadtxt(logs / "pid_200.csv", delimiter=",", skiprows=1, usecols=(0, 5), unpack=True)
    assert done.recording.set_points[-1, 0] == pytest.approx(float(np.sum(v[1:] * np.diff(t)) / 1e3), rel=0.05)


def columns_of(guess: Guess, *channels: str) -> list[list[int | str]]:
    return [[term.column for term in guess.layout.channels[name].terms] for name in channels]


@pytest.mark.parametrize(
    ("name", "inputs", "positions", "angles"),
    [
        # README of the arm: roll pitch yaw, three positions, velocities, currents, commands of pitch and yaw; here the
        # third motor stands still. What was asked of motor 1 is a part of the pitch command, of motor 2 of both.
        ("MocapTest1_first400", [[12, 13], [12, 13], [5]], [[3], [4], [5]], [[1], [2]]),
        # Two targets and two commands before them; of one step no sums of the commands can be told.
        ("arm_PI_P40Y40_first600", [[7], [8], [9]], [[7], [8], [9]], [[5], [6]]),
    ],
    ids=["mocap", "arm"],
)
def test_tables_without_names_and_clock_are_read_as_they_are_with_doubts(
    logs: Path, name: str, inputs: list[list[int]], positions: list[list[int]], angles: list[list[int]]
) -> None:
    guess = guess_layout(logs / f"{name}.csv")
    assert guess.missing == ()
    assert {"pitch", "roll", "motor set-points"} <= {doubt.about for doubt in guess.doubts}
    assert guess.layout.sample_time == 0.02  # positions and velocities tell it: 20 ms, says the README
    assert columns_of(guess, *MOTOR_POSITIONS) == positions
    assert columns_of(guess, *SET_POINTS) == inputs
    # The second axis is yaw, as the README says, and no command is taken for an angle.
    assert columns_of(guess, "pitch", "roll") == angles


def test_the_factors_of_commands_are_those_of_the_arm(logs: Path) -> None:
    layout = guess_layout(logs / "MocapTest1_first400.csv").layout
    found = {(j, term.column): term.factor for j in (0, 1) for term in layout.channels[SET_POINTS[j]].terms}
    # README: L = [cs0/1.5, -cs0/3 - cs1/1.732] mm over a winch of 9.3 mm. 400 rows give them to a tenth.
    told = {(0, 12): 1 / 1.5, (1, 12): -1 / 3, (1, 13): -1 / 1.732}
    for key, value in told.items():
        assert found[key] == pytest.approx(value / 9.3, rel=0.1), key


@pytest.mark.parametrize("name", ["joystick_first600", "step-coupled_first400"])
def test_a_log_without_motors_says_that_they_are_missing_and_what_is_left(logs: Path, name: str) -> None:
    guess = guess_layout(logs / f"{name}.csv")
    assert len(guess.missing) == 1
    assert guess.missing[0].startswith("motor_setpoint_1..3: no column is of a motor")
    assert "record their set-points, positions or velocities too" in guess.missing[0]
