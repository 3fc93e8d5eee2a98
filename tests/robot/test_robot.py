"""Robots: presets, files, what a file takes over, and every line that refuses one."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from softneck.core import FileFormatError, Matrix, SettingsError
from softneck.plant import NeckParameters
from softneck.robot import Robot, find_robot
from softneck.robot._channels import Directions
from softneck.signals import SET_POINTS, redefinition_matrix

PRESETS = {"neck": (3, 2), "arm": (3, 2), "antagonist": (2, 1), "finger": (1, 1), "trunk4": (4, 2)}
CHAMBERS = """
name = "pneumatic arm"
sample_time_s = 0.083
[motors]
names = ["a", "b", "c"]
unit = "1"
setpoint_min = 0.0
setpoint_max = [7, 7, 8]
[outputs]
names = ["x", "y"]
unit = "1"
[directions]
kind = "identified"
"""


def weights_of(robot: Robot) -> Matrix:
    weights = robot.weights()
    assert weights is not None
    return weights


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", PRESETS)
def test_presets_read_back_from_what_they_write(name: str, tmp_path: Path) -> None:
    robot = Robot.preset(name)
    assert (len(robot.motors.names), len(robot.outputs.names)) == PRESETS[name]
    again = Robot.read(written(tmp_path, tomli_w.dumps(robot.as_dict())))
    assert again.as_dict() == robot.as_dict()
    assert again.hash == robot.hash
    assert robot.is_neck == (name == "neck")


def test_the_neck_is_the_paper_s() -> None:
    neck, paper = Robot.preset(), NeckParameters.paper()
    assert neck.set_points == SET_POINTS
    np.testing.assert_array_equal(weights_of(neck), redefinition_matrix()[:2])
    assert neck.motors.setpoint_max == (paper.position_limit,) * 3
    assert neck.motors.rate_limit == (paper.speed_limit,) * 3
    assert (neck.noise_std, neck.delay_s) == (paper.noise_std, paper.sensor_delay)
    assert neck.winch_radius_m == paper.winch_radius


def test_roll_has_its_own_direction_without_pitch_or_before_it() -> None:
    neck = Robot.preset()
    table = {name: dict(part) for name, part in neck.as_dict().items() if name in ("motors", "outputs", "directions")}
    table["directions"].pop("names")

    def of(*names: str) -> np.ndarray:
        return weights_of(Robot.from_dict({**table, "name": "n", "outputs": {**table["outputs"], "names": [*names]}}))

    both = weights_of(neck)
    np.testing.assert_array_equal(of("pitch", "roll"), both)
    # Of the cosines of the complements 1e-15 is rounding.
    np.testing.assert_allclose(of("roll"), both[1:], atol=1e-15)
    np.testing.assert_allclose(of("roll", "pitch"), both[::-1], atol=1e-15)
    # Other names have their place in the file alone.
    np.testing.assert_array_equal(of("bend"), both[:1])
    np.testing.assert_array_equal(of("roll", "yaw"), both)


def test_tendons_pull_along_their_angles() -> None:
    np.testing.assert_allclose(weights_of(Robot.preset("antagonist")), [[1.0, -1.0]])
    np.testing.assert_allclose(weights_of(Robot.preset("trunk4")), [[1, 0, -1, 0], [0, 1, 0, -1]], atol=1e-15)
    # The lab's arm: its yaw command c moves the motors by (0, -c, c).
    pitch, yaw = weights_of(Robot.preset("arm")) @ [0.0, -1.0, 1.0]
    assert abs(pitch) < 1e-12 < yaw


def test_what_is_not_given_is_not_assumed_and_who_needs_it_says_so(tmp_path: Path) -> None:
    robot = Robot.read(written(tmp_path, CHAMBERS))
    assert robot.motors.setpoint_max == (7.0, 7.0, 8.0)
    assert (robot.motors.rate_limit, robot.outputs.min, robot.weights()) == (None, None, None)
    with pytest.raises(
        SettingsError,
        match=r"robot `pneumatic arm` \(\w{8}, from .*robot.toml\) gives no `sensor.noise_std`, which softneck x needs",
    ):
        robot.require("noise_std", "softneck x")
    assert robot.require("sample_time_s", "softneck x") == 0.083


def test_a_preset_s_values_stand_where_none_are_given(tmp_path: Path) -> None:
    robot = Robot.read(written(tmp_path, 'name = "mine"\nextends = "neck"\n[motors]\nsetpoint_max = 4\n'))
    assert (robot.motors.setpoint_max, robot.motors.setpoint_min) == ((4.0,) * 3, (-6.0,) * 3)
    assert robot.hash == Robot.preset("neck").hash  # its files mean the same


def test_numbers_in_another_unit_are_not_taken_over(tmp_path: Path) -> None:
    text = 'extends = "neck"\n[motors]\nunit = "deg"\n[outputs]\nunit = "mm"\n'
    robot = Robot.read(written(tmp_path, text))
    assert (robot.motors.setpoint_max, robot.motors.rate_limit) == (None, None)
    assert (robot.outputs.min, robot.outputs.display_unit, robot.noise_std) == (None, "mm", None)


def test_the_hash_is_of_what_numbers_in_a_file_mean() -> None:
    neck = Robot.preset("neck")

    def hash_with(table: str, **changes: object) -> str:
        content = neck.as_dict()
        return Robot.from_dict({**content, table: {**content.get(table, {}), **changes}}).hash

    assert hash_with("sensor", noise_std=0.1) == neck.hash
    assert hash_with("motors", setpoint_max=2.0, names=["a", "b", "c"]) == neck.hash
    assert hash_with("directions", angles_deg=[0, 120, 241]) != neck.hash
    assert hash_with("outputs", names=["pitch", "yaw"]) != neck.hash
    assert hash_with("motors", unit="deg") != neck.hash


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ('[motors]\nname = ["a"]', r"unknown key `motors.name`; did you mean `motors.names`\?"),
        ("sampletime = 1.0", r"unknown key `sampletime`; did you mean `sample_time_s`\?"),
        ("[zzz]\na = 1", r"unknown key `zzz`; known: name, extends"),
        ('extends = "nek"', r"must be one of neck, arm, antagonist, finger, trunk4; got 'nek'"),
        ("motors = 3", r"`motors` must be a table"),
        ("sample_time_s = true", r"`sample_time_s` must be a number; got True"),
        ("sample_time_s = 0", r"`sample_time_s` must be positive \[s\]; got 0"),
        ("sample_time_s = inf", r"`sample_time_s` must be a number; got inf"),
        ('[motors]\nnames = ["a", "b", "a"]', r"`motors.names` holds `a` twice"),
        ('[motors]\nnames = ["a b", "b", "c"]', r"`motors.names` holds `a b`; a name has letters"),
        ("[motors]\nnames = []", r"`motors.names` must be a list of texts"),
        (f"[motors]\nnames = {[f'm{i}' for i in range(9)]}", r"`motors.names` must hold 1 to 8 names; got 9"),
        ('[outputs]\nnames = ["a", "b", "c", "d", "e"]', r"`outputs.names` must hold 1 to 4 names; got 5"),
        ('[outputs]\nnames = ["pitch", "time"]', r"`outputs.names` holds `time`, the name of another channel"),
        ('[motors]\nunit = "furlong"', r"`motors.unit`: unknown unit `furlong`; use one of rad"),
        ('[outputs]\ndisplay_unit = "mm"', r"`outputs.display_unit` cannot be mm where `unit` is rad"),
        ("[motors]\nsetpoint_min = 7", r"`motors.setpoint_min` must be below `motors.setpoint_max`; got 7 and 6"),
        ("[outputs]\nmax = [0.5, -0.9]", r"`outputs.min` must be below `outputs.max`; got -0.8 and -0.9"),
        ("[motors]\nsetpoint_max = [1, 2]", r"`motors` gives 2 values for its 3 names"),
        ("[motors]\nrate_limit = 0", r"`motors.rate_limit` must be positive \[rad/s\]; got 0"),
        ("[motors]\nsign = [1, 1, 2]", r"`motors.sign` must be 1 or -1; got 2"),
        ('[directions]\nkind = "tendons"\nangles_deg = [0, 90]', r"holds 2 angles for 3 motor\(s\)"),
        ('[directions]\nkind = "tendons"\nangles_deg = [0, 180, 0]', r"at 0, 180, 0 deg cannot span 2 output"),
        ('[directions]\nkind = "tendons"', r'`directions` of kind = "tendons" needs `angles_deg`'),
        ('[directions]\nkind = "identified"\nangles_deg = [0, 1, 2]', r"takes no `angles_deg`"),
        ('[directions]\nkind = "guess"', r"`directions.kind` must be one of tendons, identified, matrix; got 'guess'"),
        ('[directions]\nkind = "matrix"\nmatrix = [[1, 0], [0, 1]]', r"outputs x motors, 2 x 3; got 2 x 2"),
        ('[directions]\nkind = "matrix"\nmatrix = [[1, 1, 1], [2, 2, 2]]', r"the matrix cannot span 2 output"),
        ('[motors]\nnames = ["a"]\n[directions]\nkind = "tendons"\nangles_deg = [0]', r"at 0 deg cannot span 2 output"),
        ('[outputs]\nnames = ["a", "b", "c"]', r"tendons bend 2 outputs at most, and there are 3"),
        ("[sensor]\nnoise_std = -1", r"`sensor.noise_std` must not be negative; got -1"),
    ],
)
def test_a_fault_in_a_file_is_one_line_that_says_which(change: str, line: str, tmp_path: Path) -> None:
    text = change if "extends" in change else f'extends = "neck"\n{change}'
    path = written(tmp_path, text)
    with pytest.raises(SettingsError, match=line) as caught:
        Robot.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_without_a_preset_a_table_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"there is no table `\[motors\]`"):
        Robot.read(written(tmp_path, 'name = "x"\n'))
    with pytest.raises(SettingsError, match=r"`motors.unit` is missing"):
        Robot.read(written(tmp_path, CHAMBERS.replace('unit = "1"\nsetpoint_min', "setpoint_min")))


def test_what_is_no_file_or_no_toml_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file; `softneck robot new"):
        Robot.read(tmp_path / "absent.toml")
    with pytest.raises(FileFormatError, match="is not valid TOML"):
        Robot.read(written(tmp_path, "[[["))
    with pytest.raises(SettingsError, match="`trunk5` is neither a robot preset"):
        find_robot("trunk5")


def test_the_file_beside_or_above_is_found_and_else_it_is_the_neck(tmp_path: Path) -> None:
    log = tmp_path / "project" / "logs" / "a.csv"
    log.parent.mkdir(parents=True)
    assert find_robot(beside=log).is_neck
    written(tmp_path / "project", CHAMBERS)
    assert find_robot(beside=log).name == "pneumatic arm"
    written(log.parent, 'extends = "finger"\n')
    assert find_robot(beside=log).name == "finger"
    assert find_robot("trunk4", beside=log).name == "trunk4"
    assert find_robot().is_neck


def test_angles_are_held_to_what_can_be_told_apart(tmp_path: Path) -> None:
    def robot(angle: float) -> Robot:
        directions = f'[directions]\nkind = "tendons"\nangles_deg = [0, {angle}]\n'
        text = f'extends = "antagonist"\n[outputs]\nnames = ["p", "q"]\n{directions}'
        return Robot.read(written(tmp_path, text))

    assert math.isclose(np.linalg.det(weights_of(robot(90.0))), 1.0)
    # Singular values of two unit vectors an angle a apart: sqrt(1 - cos a) is the smaller, 1e-3 at 0.081 deg.
    robot(0.1)
    with pytest.raises(SettingsError, match="cannot span"):
        robot(0.05)


def test_lists_and_arrays_make_the_same_robot() -> None:
    # Loops keep their wirings by the robot's content.
    whole = Robot.preset("neck")
    motors = replace(whole.motors, names=list(whole.motors.names))  # pyright: ignore[reportArgumentType]
    outputs = replace(whole.outputs, names=list(whole.outputs.names))  # pyright: ignore[reportArgumentType]
    same = replace(whole, motors=motors, outputs=outputs)
    assert same == whole
    assert hash(same) == hash(whole)
    assert same.set_points == SET_POINTS
    rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    made = [Directions(kind="matrix", matrix=matrix) for matrix in (rows, np.array(rows))]  # pyright: ignore[reportArgumentType]
    assert made[0] == made[1]
    assert hash(made[0]) == hash(made[1])
