"""From a log of another robot to a judged model on the command line, and the commands that take necks only."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from softneck.robot import Robot
from softneck.signals import read_recording
from tests.design.test_robots import BELLOWS, plant

from ..browser import charts_of
from .conftest import Call

HEAD = "time [s];pump voltage [V];valve_2 [V];level [mm];run\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two tanks' runs with a lag of 20 samples behind both motors, titled as a lab would."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(1.0, 5.0, (60, 2)), 10, axis=0)
    y = np.zeros(600)
    for k in range(599):
        y[k + 1] = 0.95 * y[k] + 0.05 * (30.0 * u[k, 0] - 10.0 * u[k, 1])
    rows = [f"{4 * (k % 300)};{u[k, 0]};{u[k, 1]};{y[k] + 0.1 * rng.standard_normal()};{k // 300}" for k in range(600)]
    path = tmp_path / "plant.txt"
    path.write_text(HEAD + "\n".join(rows) + "\n")
    return path


def test_a_log_becomes_a_robot_a_recording_and_a_model(call: Call, log: Path) -> None:
    said = call("import", log, "--robot-out", "robot.toml", "-o", "rec.csv", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert (facts["rows"], facts["runs"], facts["sample_time_s"]) == (600, 2, 4.0)
    robot = Robot.read("robot.toml")
    assert (robot.motors.names, robot.motors.unit) == (("pump_voltage", "valve_2"), "V")
    assert (robot.outputs.names, robot.outputs.unit) == (("level",), "mm")
    assert read_recording("rec.csv").robot.hash == robot.hash
    # Again, by the layout that was written and the robot file beside the log.
    assert call("import", log, "--layout", "rec.layout.toml", "-o", "again.csv").code == 0
    np.testing.assert_array_equal(read_recording("again.csv").outputs, read_recording("rec.csv").outputs)
    info = json.loads(call("info", "rec.csv", "--json").out)
    assert info["robot"] == robot.label()
    # In the folder of another robot it is refused, not described as some logger's table.
    Path("elsewhere").mkdir()
    assert call("robot", "new", "--preset", "finger", "elsewhere/robot.toml").code == 0
    Path("elsewhere/rec.csv").write_bytes(Path("rec.csv").read_bytes())
    refused = call("info", "elsewhere/rec.csv")
    assert (refused.code, "is a recording of robot" in refused.error) == (2, True), refused.error
    said = call("identify", "rls", "rec.csv", "-o", "m.npz", "--set", "delay=0.0", "--json")
    assert said.code == 0, said.err
    directions = np.array(json.loads(said.out)["findings"]["directions"])[0]
    # Noise of 0.1 mm in a motion of tens; weights are of length 1.
    np.testing.assert_allclose(directions, np.array([3.0, -1.0]) / np.sqrt(10.0), atol=0.02)
    entry = json.loads(call("validate", "m.npz", "--data", "rec.csv", "--json").out)["models"][0]
    assert entry["unit"] == "mm"
    assert entry["fits"]["model"]["inf"]["level"] > 97.0
    assert "level" in call("validate", "m.npz", "--data", "rec.csv").out


def test_a_log_titled_as_the_robot_s_file_says_needs_no_layout(call: Call, log: Path, tmp_path: Path) -> None:
    tank = 'name = "tank"\n[motors]\nnames = ["pump voltage", "valve_2"]\nunit = "V"\n[outputs]\nnames = ["level"]\n'
    (tmp_path / "robot.toml").write_text(tank.replace("pump voltage", "pump_voltage") + 'unit = "mm"\n'
                                         '[directions]\nkind = "matrix"\nmatrix = [[3.0, -1.0]]\n')  # fmt: skip
    assert call("import", log, "--guess", "-o", "rec.csv").code == 0
    assert read_recording("rec.csv").robot.name == "tank"


def test_bad_imports_are_one_line(call: Call, log: Path, tmp_path: Path) -> None:
    said = call("import", log, "--robot", "trunk4", "--guess", "-o", "rec.csv")
    assert (said.code, "no column is titled `motor_1`" in said.err) == (2, True)
    said = call("import", log, "--robot-out", "r.toml", "--guess", "-o", "rec.csv")
    assert (said.code, "leave out --guess" in said.error) == (2, True)
    (tmp_path / "b.csv").write_text("time,a,b\n0,1,2\n1,2,3\n2,4,1\n")
    said = call("import", "b.csv", "--robot-out", "r.toml", "-o", "rec.csv")
    line = "no column was recognised as motor. Name them: `softneck import b.csv --motor a --output b -o rec.csv`"
    assert (said.code, line in said.err) == (2, True), said.err
    titles = ",".join(f"motor_{j}" for j in range(9))
    rows = "\n".join(",".join(str(k * (j + 1) % 13) for j in range(11)) for k in range(9))
    (tmp_path / "d.csv").write_text(f"time,{titles},x\n{rows}\n")
    said = call("import", "d.csv", "--robot-out", "r.toml", "-o", "rec.csv")
    assert (said.code, "d.csv: `motors.names` must hold 1 to 8 names; got 9." in said.err) == (2, True)
    said = call("import", log, "--robot-out", "r.txt", "-o", "rec.csv")
    assert (said.code, "r.txt: must end in `.toml`" in said.err) == (2, True)
    assert not (tmp_path / "r.toml").exists()
    assert not (tmp_path / "rec.csv").exists()
    assert call("import", log, "--robot-out", "r.toml", "-o", "rec.csv").code == 0
    said = call("import", "rec.csv", "--robot-out", "s.toml", "-o", "t.csv")
    assert (said.code, "is a recording of robot" in said.err) == (2, True)


def test_commands_that_take_necks_only_say_so_in_a_line(call: Call, log: Path) -> None:
    assert call("import", log, "--robot-out", "robot.toml", "-o", "rec.csv").code == 0
    assert call("identify", "rls", "rec.csv", "-o", "m.npz", "--set", "delay=0.0").code == 0
    for arguments, why in (
        (
            ("observer", "m.npz", "-o", "o.npz"),
            ", from robot.toml) gives no `motors.setpoint_min` and `setpoint_max`, which an observer needs",
        ),
    ):
        said = call(*arguments)
        assert said.code == 2, (arguments, said)
        assert why in said.error, (arguments, said)
        assert not {"f.npz", "c.npz", "o.npz"} & {p.name for p in Path().glob("*.npz")}


def test_fmus_and_pages_of_a_tank(call: Call, log: Path, tmp_path: Path) -> None:
    assert call("import", log, "--robot-out", "robot.toml", "-o", "rec.csv").code == 0
    assert call("identify", "rls", "rec.csv", "-o", "m.npz", "--set", "delay=0.0").code == 0
    assert call("fmu", "m.npz", "-o", "M.fmu", "--data", "rec.csv").code == 0
    assert call("info", "rec.csv", "--html", "q.html").code == 0
    assert call("validate", "m.npz", "--data", "rec.csv", "--html", "v.html").code == 0
    assert "valve_2_setpoint" in (tmp_path / "q.html").read_text(encoding="utf-8")
    page = (tmp_path / "v.html").read_text(encoding="utf-8")
    assert "errors in mm" in page
    assert "level" in page


@pytest.mark.slow
def test_the_page_of_a_loop_has_a_panel_for_each_output_in_its_unit(call: Call, tmp_path: Path) -> None:
    plant(BELLOWS, gain=1e-7, rest=0.03).save(tmp_path / "m.npz")
    assert call("design", "pi", "m.npz", "-o", "c.npz", "--any-fit").code == 0
    (tmp_path / "loop.toml").write_text(
        'duration_s = 2.0\nplant = { model = "m.npz" }\ncontroller = { file = "c.npz" }\n'
        '[reference]\nkind = "step"\nx = 41.0\ny = 43.0\nz = 49.0\n'
    )
    said = call("simulate", "loop.toml", "--html", "loop.html")
    assert said.code == 0, said.err
    page = (tmp_path / "loop.html").read_text(encoding="utf-8")
    for label in ("x [mm]", "y [mm]", "z [mm]", "motor [bar]", "set-point d", "z.rms_error_mm", "the true output"):
        assert label in page + charts_of(page), label


@pytest.mark.slow
@pytest.mark.nightly
def test_the_page_of_a_choice_for_a_tank(call: Call, log: Path, tmp_path: Path) -> None:
    assert call("import", log, "--robot-out", "robot.toml", "-o", "rec.csv").code == 0
    assert call("identify", "auto", "rec.csv", "-o", "auto.npz", "--html", "a.html").code == 0
    assert "mean of level" in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_record_takes_a_robot_s_tendons_and_range(call: Call) -> None:
    assert call("record", "multisine", "-o", "arm.csv", "--robot", "arm", "--neck", "lab", "--duration", "2").code == 0
    rec = read_recording("arm.csv")
    assert rec.robot.hash == Robot.preset("arm").hash
    # Multisine is 3.2 of the neck's 6 rad, of the arm's 4.
    assert 1.5 < np.abs(rec.set_points).max() < 3.2 * 4.0 / 6.0 + 1e-9


def test_record_takes_the_robot_beside_the_recording_and_says_what_it_lacks(call: Call, tmp_path: Path) -> None:
    assert call("robot", "new", "--preset", "arm").code == 0
    said = call("record", "steps", "-o", "rec.csv")
    assert (said.code, len(said.error.splitlines())) == (2, 1)
    assert ", from robot.toml) gives no `plant.neck`, which the virtual plant needs; add it." in said.error
    (tmp_path / "robot.toml").write_text('extends = "antagonist"\nname = "muscles"\n[motors]\nunit = "bar"\n')
    said = call("record", "steps", "-o", "rec.csv")
    assert said.code == 2
    assert "the virtual plant has motors in rad or deg, and `motors.unit` of robot `muscles`" in said.error
    assert not (tmp_path / "rec.csv").exists()


def test_a_robot_is_an_fmu_by_its_preset_or_file(call: Call) -> None:
    assert call("fmu", "antagonist", "-o", "A.fmu").code == 0
    assert call("robot", "new", "mine.toml", "--preset", "antagonist").code == 0
    assert call("fmu", "mine.toml", "-o", "B.fmu").code == 0


# -- columns that are named -------------------------------------------------------------------------------------------


def pneumatic_log(rows: int = 200) -> str:
    """Return a log whose titles speak of nothing: two commands, what became of them, an answer, a counter."""
    rng = np.random.default_rng(0)
    lines = ["t_s,a [kPa],b [kPa],am [kPa],bm [kPa],flexion(deg),n"]
    a, b = rng.uniform(0.0, 80.0, (2, rows))
    for k in range(rows):
        lines.append(
            f"{0.02 * k:.2f},{a[k]:.6f},{b[k]:.6f},{0.9 * a[k]:.6f},{0.9 * b[k]:.6f},{a[k] - b[k]:.6f},{k % 7}"
        )
    return "\n".join(lines) + "\n"


NAMED = ("--motor", "a [kPa]", "--motor", "b [kPa]", "--position", "am [kPa]", "--position", "bm [kPa]",
         "--output", "flexion(deg)")  # fmt: skip


def test_named_columns_are_a_layout_and_a_robot(call: Call, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(pneumatic_log())
    said = call("import", "log.csv", *NAMED, "-o", "rec.csv", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert (facts["rows"], facts["sample_time_s"], facts["robot_file"]) == (200, 0.02, "rec.robot.toml")
    recording = read_recording("rec.csv")
    assert (recording.robot.motors.unit, recording.robot.outputs.display_unit) == ("kPa", "deg")
    table = np.genfromtxt("log.csv", delimiter=",", skip_header=1)
    # Files of ours keep all digits; the robot's own unit is Pa inside.
    np.testing.assert_allclose(recording.set_points, 1e3 * table[:, 1:3], rtol=1e-12)
    np.testing.assert_allclose(recording.motor_positions[:, 1], 1e3 * table[:, 4], rtol=1e-12)
    np.testing.assert_allclose(np.degrees(recording.outputs[:, 0]), table[:, 5], rtol=1e-9, atol=1e-9)
    # The layout and the robot that were written do the same again; and so does the robot alone.
    again = ("import", "log.csv", "--layout", "rec.layout.toml", "--robot", "rec.robot.toml", "-o", "again.csv")
    assert call(*again).code == 0
    assert Path("again.csv").read_bytes() == Path("rec.csv").read_bytes()


def test_named_columns_of_a_neck_are_the_neck_s(call: Call, tmp_path: Path) -> None:
    rows = "\n".join(f"{0.1 * k % 1},{0.2 * k % 1},{0.3 * k % 1},{k % 5},{k % 3}" for k in range(60))
    (tmp_path / "log.csv").write_text(f"m1,m2,m3,pitch [deg],roll [deg]\n{rows}\n")
    named = ("--motor", "m1", "--motor", "m2", "--motor", "m3", "--output", "pitch [deg]", "--output", "roll [deg]")
    said = call("import", "log.csv", *named, "--sample-time", "0.02", "-o", "rec.csv")
    assert said.code == 0, said.err
    assert read_recording("rec.csv").robot.is_neck
    assert not Path("rec.robot.toml").exists()


def test_a_recording_of_ours_keeps_all_its_channels(call: Call) -> None:
    assert call("record", "steps", "--robot", "finger", "-o", "rec.csv").code == 0
    said = call("import", "rec.csv", "--guess", "--yes", "-o", "again.csv")
    assert said.code == 0, said.err
    before, after = read_recording("rec.csv"), read_recording("again.csv")
    assert "motor_position_1" in before.channels
    assert list(after.channels) == list(before.channels)
    assert after.robot.hash == before.robot.hash
    for name, values in before.channels.items():
        np.testing.assert_array_equal(after.channels[name], values)


@pytest.mark.parametrize(
    ("missed", "motor", "why"),
    [(None, "bb", "there is no column `bb`"), ("-999", "b [kPa]", "times as far as all others")],
)
def test_a_refused_import_of_named_columns_leaves_the_page_of_raw_columns(
    call: Call, tmp_path: Path, missed: str | None, motor: str, why: str
) -> None:
    (tmp_path / "log.csv").write_text(pneumatic_log())
    table = pd.read_csv("log.csv", dtype=str)
    table.loc[100:140, "flexion(deg)"] = missed or table["flexion(deg)"]
    table.to_csv("log.csv", index=False)
    named = ("--motor", "a [kPa]", "--motor", motor, "--output", "flexion(deg)")
    said = call("import", "log.csv", *named, "-o", "rec.csv", "--html", "p.html")
    assert (said.code, why in said.err.splitlines()[-1]) == (2, True), said.err
    assert {path.name for path in tmp_path.iterdir()} == {"log.csv", "p.html"}
    page = Path("p.html").read_text()
    assert page.count(why) == 1
    rows = re.findall(r'<td class="text"[^>]*>([^<]+)</td>' + 4 * r"<td[^>]*>([^<]*)</td>", page)
    table = pd.read_csv("log.csv")
    assert [row[0] for row in rows] == list(table.columns)
    for title, unit, least, largest, _ in rows:
        assert (least, largest) == (f"{table[title].min():.4g}", f"{table[title].max():.4g}")
        assert (unit == "kPa") == ("[kPa]" in title)
    seem = {row[0]: row[4] for row in rows}
    titles = ["t_s", "a [kPa]", "b [kPa]", "flexion(deg)"]
    assert [seem[title] for title in titles] == ["time", "set-point of motor 1", "set-point of motor 2", "output 1"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--position", "am [kPa]", "--output", "am [kPa]"), "column `am [kPa]` is named twice"),
        (("--motor", "a [kPa]", "--output", "flexon(deg)"), "there is no column `flexon(deg)`; did you mean"),
        (("--motor", "a [kPa]", "--output", "a [kPa]"), "column `a [kPa]` is named twice"),
        ((*NAMED, "--sample-time", "0.1"), "has a clock, `t_s`; leave out --sample-time"),
        ((*NAMED, "--guess"), "--motor, --position and --output are the layout"),
        ((*NAMED[:6], *NAMED[-2:]), "needs 2 --position; 1 were given"),
        ((*NAMED, "--robot", "neck"), "needs 3 --motor; 2 were given"),
    ],
)
def test_columns_that_cannot_be_are_one_line(call: Call, tmp_path: Path, words: tuple[str, ...], line: str) -> None:
    (tmp_path / "log.csv").write_text(pneumatic_log())
    said = call("import", "log.csv", *words, "-o", "rec.csv")
    assert (said.code, said.out) == (2, "")
    assert line in said.error
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]
