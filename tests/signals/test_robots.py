"""Recordings of other robots than the neck: channels, units, files, and whose a file is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError
from softneck.robot import Robot
from softneck.signals import Recording, concatenate, read_recording, resampled, write_recording

TANK = {
    "name": "tank",
    "motors": {"names": ["pump"], "unit": "V"},
    "outputs": {"names": ["level"], "unit": "V"},
    "directions": {"kind": "identified"},
}
BELLOWS = {
    "name": "bellows",
    "motors": {"names": [f"chamber_{j}" for j in range(8)], "unit": "bar"},
    "outputs": {"names": ["x", "y", "z", "twist"], "unit": "mm"},
    "directions": {"kind": "identified"},
}
ROBOTS = {name: Robot.preset(name) for name in ("antagonist", "finger", "trunk4", "arm")}
ROBOTS |= {content["name"]: Robot.from_dict(content) for content in (TANK, BELLOWS)}


def recorded(robot: Robot, rows: int = 40) -> Recording:
    rng = np.random.default_rng(1)
    names = (*robot.set_points, *robot.outputs.names, *robot.motor_positions)
    channels = {name: 0.3 * rng.standard_normal(rows) for name in names}
    channels[robot.outputs.names[0]][5] = np.nan
    return Recording(0.1 * np.arange(rows), 0.1, channels, robot=robot)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_recording_of_any_robot_reads_back_as_it_was(name: str, ending: str, tmp_path: Path) -> None:
    recording = recorded(ROBOTS[name])
    write_recording(tmp_path / f"a.{ending}", recording)
    again = read_recording(tmp_path / f"a.{ending}")
    assert again.robot.hash == recording.robot.hash
    assert again.set_points.shape == (40, len(ROBOTS[name].motors.names))
    # The unit of the file and back: two roundings.
    np.testing.assert_allclose(again.set_points, recording.set_points, rtol=1e-15)
    np.testing.assert_allclose(again.outputs, recording.outputs, rtol=1e-15)
    np.testing.assert_allclose(again.motor_positions, recording.motor_positions, rtol=1e-15)
    assert np.isnan(again.outputs[5, 0])
    if ending == "csv":  # of another writer, with blanks that the plain reader leaves to pandas
        head, body = (tmp_path / "a.csv").read_text().split("\n", 1)
        (tmp_path / "b.csv").write_text("\n".join([head, body.replace(",", ", ")]))
        np.testing.assert_array_equal(read_recording(tmp_path / "b.csv").outputs, again.outputs)
    parts = (*again.split(0.5), resampled(again, 0.2), *again.runs())
    assert {part.robot.hash for part in parts} == {again.robot.hash}


def test_files_carry_the_robot_s_names_and_units(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_recording(path, recorded(ROBOTS["bellows"]))
    robot, titles = path.read_text().splitlines()[:2]
    assert robot.startswith('# robot {"name": "bellows"')
    assert titles.startswith("time [s],chamber_0_setpoint [bar],")
    assert titles.endswith("x [mm],y [mm],z [mm],twist [mm]")
    assert read_recording(path).outputs.mean() == pytest.approx(recorded(ROBOTS["bellows"]).outputs.mean(), nan_ok=True)


def test_a_neck_s_file_says_nothing_of_a_robot(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_recording(path, recorded(Robot.preset("neck")))
    assert path.read_text().startswith("time [s],motor_setpoint_1 [rad],motor_setpoint_2 [rad],motor_setpoint_3 [rad]")


def test_a_robot_file_beside_tells_whose_a_plain_table_is(tmp_path: Path) -> None:
    table = "time [s],motor_setpoint_1 [V],level [V]\n0,1,2\n4,1,2.5\n8,1.5,2.25\n"
    (tmp_path / "log.csv").write_text(table)
    with pytest.raises(DataError, match=r"column `motor_setpoint_1` cannot be in `V`"):
        read_recording(tmp_path / "log.csv")
    toml = 'name = "tank"\n[motors]\nnames = ["pump"]\nunit = "V"\n[outputs]\nnames = ["level"]\nunit = "V"\n'
    (tmp_path / "robot.toml").write_text(toml + '[directions]\nkind = "identified"\n')
    recording = read_recording(tmp_path / "log.csv")
    assert (recording.robot.name, recording.sample_time) == ("tank", 4.0)
    np.testing.assert_array_equal(recording.outputs[:, 0], [2.0, 2.5, 2.25])


def test_a_file_of_one_robot_is_not_read_as_another_s(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_recording(path, recorded(ROBOTS["finger"]))
    with pytest.raises(DataError, match=r"is a recording of robot `finger` \(\w{8}\), not of `trunk4` \(\w{8}\)"):
        read_recording(path, robot="trunk4")
    (tmp_path / "robot.toml").write_text('extends = "antagonist"\n')
    with pytest.raises(DataError, match="of robot `finger`"):
        read_recording(path)
    path.write_text(path.read_text().replace("# robot {", "# robot {{"))
    with pytest.raises(DataError, match="does not name its robot"):
        read_recording(path)


def test_recordings_of_two_robots_are_not_put_together() -> None:
    finger = recorded(ROBOTS["finger"])
    with pytest.raises(DataError, match=r"of two robots cannot be used together: `finger` \(\w+\) and `antagonist`"):
        concatenate([finger, recorded(ROBOTS["antagonist"])])
    with pytest.raises(DataError, match=r"of robot `antagonist` \(\w+\) needs the channels motor_setpoint_1, motor_s"):
        Recording(finger.time, 0.1, finger.channels, robot=ROBOTS["antagonist"])
