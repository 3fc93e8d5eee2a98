"""`softneck drives` for robots that are no neck: from the check to a recording that identifies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .conftest import Call

ROBOT = """name = "bench"
extends = "antagonist"
[motors]
names = ["front", "back"]
setpoint_max = [4.0, 8.0]
sign = [1, -1]
[drives]
file = "drives.toml"
"""
DRIVES = """profile = "ds402"
[[drive]]
node = 11
peak_current_A = 10.0
[[drive]]
node = 12
peak_current_A = 10.0
reversed = true
[watch]
gain = 0.07
pole_per_s = 5.0
"""


TRUNK = """name = "trunk bench"
extends = "trunk4"
[drives]
file = "drives.toml"
"""
TRUNK_DRIVES = (
    'profile = "ds402"\n'
    + "".join(f"[[drive]]\nnode = {node}\npeak_current_A = 10.0\n" for node in (11, 12, 13, 14))
    + "[watch]\ngain = 0.07\npole_per_s = 5.0\n"
)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "robot.toml").write_text(ROBOT, encoding="utf-8")
    (tmp_path / "drives.toml").write_text(DRIVES, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("files")
def test_check_says_which_limits_hold_for_the_robot_beside_the_drives_file(call: Call) -> None:
    said = call("drives", "check", "--simulated", "--drives", "drives.toml", "--json")
    assert said.code == 0, said
    found = {(row["node"], row["check"]): row["found"] for row in json.loads(said.out)["rows"]}
    assert found[0, "robot"].startswith("`bench` (")
    assert found[11, "set-points"] == "-6 rad (drives file) to 4 rad (robot), 15.6 rad/s (drives file)"
    assert found[0, "bus load"] == "7 % of 1e+06 bit/s at worst"


@pytest.mark.usefixtures("files")
def test_without_a_drives_file_the_robot_is_that_of_the_working_folder(call: Call) -> None:
    said = call("drives", "check", "--simulated", "--json")
    assert said.code == 0, said
    assert "robot: bench, from robot.toml" in said.err
    # Its drives file, with two nodes.
    assert {row["node"] for row in json.loads(said.out)["rows"]} == {0, 11, 12}
    Path("robot.toml").write_text(ROBOT.replace("[motors]", '[motors]\nunit = "psi"'), encoding="utf-8")
    said = call("drives", "commission", "--simulated")
    assert said.code == 2
    assert "has motors in psi; drives turn winches" in said.err


@pytest.mark.parametrize(("old", "new", "line"), [
    ("reversed = true", "reversed = false", "[[drive]] 2 has reversed = false, but `motors.sign` of motor 2 is -1"),
    ("[[drive]]\nnode = 12\npeak_current_A = 10.0\nreversed = true\n", "", "two [[drive]] tables are needed for robot"),
    ("gain = 0.07\n", "", "[watch] `gain` is missing"),
])  # fmt: skip
def test_a_drives_file_that_does_not_fit_the_robot_is_one_line(
    files: Path, call: Call, old: str, new: str, line: str
) -> None:
    (files / "drives.toml").write_text(DRIVES.replace(old, new), encoding="utf-8")
    said = call("drives", "check", "--simulated", "--robot", "robot.toml")
    assert said.code == 2
    assert line in said.err
    assert said.err.startswith("softneck: drives.toml: ")


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_two_motors_are_zeroed_jogged_recorded_replayed_and_identified(call: Call) -> None:
    drives = ("--simulated", "--drives", "drives.toml")
    zeroed = call("drives", "commission", "--only", "zero", *drives, "--json")
    assert zeroed.code == 0, zeroed
    assert set(json.loads(zeroed.out)) == {"zeroed", "motors", "pitch_deg"}
    assert call("drives", "commission", "--only", "jog", "--motor", "2", *drives).code == 0
    said = call("drives", "record", "aprbs", "-o", "rec.csv", "--duration", "16", "--log", "rec.mcap", *drives)
    assert said.code == 0, said
    assert Path("rec.csv").read_text(encoding="utf-8").startswith('# robot {"name": "bench"')
    assert call("simulate", "rec.mcap").code == 0
    assert call("import", "rec.mcap", "-o", "again.csv").code == 0
    assert Path("again.csv").read_bytes() == Path("rec.csv").read_bytes()
    assert call("identify", "oe", "rec.csv", "-o", "m.npz").code == 0
    other = call("drives", "record", "rec.csv", "-o", "x.csv", "--simulated", "--robot", "trunk4")
    assert other.code == 2
    assert "`bench`" in other.err
    assert "`trunk4`" in other.err


REQUIREMENTS = """version = 1
[sampling]
plants = 12
search_generations = 0
[sim]
decides = true  # here the neck is the preset
necks = 1
payloads_kg = [0.0]
[require]
"stability.searched_radius" = false
"""
LOOP = """duration_s = 2.0
drives = "drives.toml"
plant = { neck = "NECK" }
observer = { file = "observer.npz" }
controller = { file = "pi.npz" }
reference = { kind = "step", pitch_deg = 5, at_s = 0.5 }
limits = { "pitch.overshoot_pct" = 15.0 }
"""


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["bench", "trunk bench"])
def test_a_robot_runs_what_was_identified_designed_verified_and_simulated(name: str, files: Path, call: Call) -> None:
    """From a recording of the virtual robot to the simulated drives, without an override."""
    asked, neck = REQUIREMENTS, "paper"
    if name != "bench":
        (files / "robot.toml").write_text(TRUNK, encoding="utf-8")
        (files / "drives.toml").write_text(TRUNK_DRIVES, encoding="utf-8")
        # Its slower axis has a dead time of seven samples, and settles later than a neck of its time constant.
        asked, neck = asked + '"step.settling_s" = { max = 1.5 }\n', "trunk"
    (files / "requirements.toml").write_text(asked, encoding="utf-8")
    (files / "loop.toml").write_text(LOOP.replace("NECK", neck), encoding="utf-8")
    steps = (
        ("record", "aprbs", "-o", "rec.csv", "--duration", "20"),
        ("identify", "oe", "rec.csv", "-o", "m.npz"),
        ("observer", "m.npz", "-o", "observer.npz"),
        ("design", "pi", "m.npz", "-o", "pi.npz"),
        ("verify", "pi.npz", "m.npz", "--observer", "observer.npz", "--requirements", "requirements.toml", "-o",
         "pi.certificate.json", "--html", "verify.html"),
        ("simulate", "loop.toml", "--certificate", "loop.certificate.json"),
        ("drives", "commission", "--only", "zero", "--simulated", "--drives", "drives.toml"),
    )  # fmt: skip
    for step in steps:
        said = call(*step)
        assert said.code == 0, said
    certificate = json.loads((files / "pi.certificate.json").read_text(encoding="utf-8"))
    assert certificate["robot"]["name"] == name
    run = ("drives", "run", "pi.npz", "--loop", "loop.toml", "--simulated", "--drives", "drives.toml")
    given = ("--certificate", "pi.certificate.json", "--certificate", "loop.certificate.json")
    said = call(*run, *given, "--json")
    assert said.code == 0, said


def test_a_motor_that_the_robot_does_not_have(call: Call) -> None:
    said = call("drives", "commission", "--only", "jog", "--motor", "3", "--simulated", "--robot", "antagonist")
    assert said.code == 2
    assert "3 is not in the range 1<=x<=2" in said.err
