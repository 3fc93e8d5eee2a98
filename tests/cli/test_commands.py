"""The commands at work: exit codes, JSON, files kept and replaced, and the real recordings."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import click
import pytest

from softneck.cli import _main
from softneck.core import CheckFailedError, load, write_certificate
from softneck.core._certificate import certificate_contents
from softneck.robot import Robot
from softneck.signals import read_recording

from ..browser import own_text
from ..data import LAYOUTS
from ..design.test_robots import plant
from .conftest import Call, Said

COMMANDS = tuple(_main._COMMANDS)


def one_object(said: Said) -> dict:
    """The JSON that is all of stdout; a second object or a stray line would not parse."""
    assert said.code == 0, said.err
    value = json.loads(said.out)
    assert isinstance(value, dict)
    return value


def test_python_runs_the_package_as_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "softneck", "nothing"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("softneck: no such command")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_helps_with_an_example(call: Call, command: str) -> None:
    said = call(command, "--help")
    assert said.code == 0
    assert "Example: softneck " + command in " ".join(said.out.split())
    assert "--json" in said.out


def test_help_lists_every_command_and_the_exit_codes(call: Call) -> None:
    said = call("--help")
    assert said.code == 0
    assert all(f"  {command} " in said.out for command in COMMANDS)
    assert "2 bad input" in said.out
    assert call("--version").out.startswith("softneck, version ")
    assert call().code == 2


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (CheckFailedError("pitch overshoots."), 1, "pitch overshoots."),
        (FileNotFoundError(2, "No such file or directory", "x.csv"), 2, "x.csv: No such file or directory"),
        (click.UsageError("odd"), 2, "odd"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (click.Abort(), 130, "interrupted"),
        (RuntimeError("two\nlines"), 3, "internal error in softneck: RuntimeError: two lines"),
    ],
)
def test_every_error_is_one_line_and_its_exit_code(
    call: Call, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, line: str
) -> None:
    def fail(*_args: object, **_more: object) -> None:
        raise error

    monkeypatch.delenv("SOFTNECK_TRACEBACK", raising=False)
    monkeypatch.setattr("softneck.cli._info._describe", fail)
    Path("a.csv").write_text("")
    said = call("info", "a.csv")
    assert (said.code, said.out) == (code, "")
    assert said.error.startswith(f"softneck: {line}")


def test_ctrl_c_during_identify_leaves_no_file(
    call: Call, tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_args: object, **_more: object) -> None:
        raise KeyboardInterrupt

    for where in ("softneck.identification.linear._rls.Rls._search", "numpy.savez_compressed"):
        with monkeypatch.context() as patch:
            patch.setattr(where, interrupted)
            said = call("identify", "rls", recording, "-o", "m.npz", "--json")
        assert said.code == 130
        assert said.error.startswith("softneck: interrupted")
        assert list(tmp_path.iterdir()) == []


def test_identify_and_validate_print_one_object(call: Call, recording: Path) -> None:
    facts = one_object(call("identify", "rls", recording, "-o", "m.npz", "--set", "delay=0.06", "--json"))
    assert (facts["kind"], facts["rows_trained"], facts["settings"]["delay"]) == ("rls", 420, 0.06)
    judged = one_object(call("validate", "m.npz", "--data", recording, "--json", "--horizon", "1,5,inf"))
    (entry,) = judged["models"]
    assert entry["fits"]["model"] == facts["hold_out"]["fits"]["model"] | {"5": entry["fits"]["model"]["5"]}
    assert set(entry["fits"]["persistence"]) == {"1", "5"}
    assert set(entry) >= {"model", "data", "rows_scored", "fits", "rmse_deg", "diverged", "residuals"}
    assert (entry["rows_scored"], entry["rows_left_out"]) == (180 - 25, 420)
    assert one_object(call("validate", "m.npz", "--data", recording, "--include-training", "--json"))


def test_what_stands_under_o_is_replaced_by_force_only(call: Call, recording: Path) -> None:
    arguments = ("identify", "rls", recording, "-o", "m.npz", "--set", "delay=0.06", "--json")
    one_object(call(*arguments))
    before = Path("m.npz").read_bytes()
    refused = call(*arguments)
    assert refused.code == 2
    assert "m.npz: exists already; use --force" in refused.error
    assert Path("m.npz").read_bytes() == before
    one_object(call(*arguments, "--force"))


def test_without_o_a_command_writes_under_build_and_may_replace(call: Call, recording: Path) -> None:
    for _ in range(2):
        facts = one_object(call("identify", "rls", recording, "--set", "delay=0.06", "--json"))
        assert facts["model"] == "build/models/rls.npz"
        assert load("build/models/rls.npz").kind == "rls"


def test_several_recordings_are_several_runs(call: Call, recording: Path) -> None:
    facts = one_object(
        call("identify", "rls", recording, recording, "-o", "m.npz", "--set", "delay=0.06", "--train", "0.5", "--json")
    )
    assert facts["rows_trained"] == 600


@pytest.mark.slow
def test_people_get_a_table_and_progress_stays_on_stderr(call: Call, recording: Path, rls_file: Path) -> None:
    said = call("identify", "rls", recording, "-o", "m.npz", "--set", "delay=0.06")
    assert said.code == 0
    assert said.out.startswith("m.npz\nrls:")
    assert "simulation" in said.out
    assert "identify rls ..." in said.err
    table = call("validate", rls_file, "--data", recording, "--html", "page.html")
    assert "best linear" in table.out
    assert "simulation" in table.out
    assert "rows judged, 0 left out as the model was trained on them" in table.out
    assert max(len(line) for line in table.out.splitlines() if line[:1] in "┏┃┡│└") <= 120
    page = own_text(Path("page.html").read_text(encoding="utf-8"))
    assert "<html" in page
    # Self-contained: nothing is fetched when the page is opened.
    assert 'src="http' not in page
    assert 'href="http' not in page
    assert call("validate", rls_file, "--data", recording, "--html", "page.html").code == 2


def test_info_knows_recordings_models_and_certificates(call: Call, recording: Path, rls_file: Path) -> None:
    facts = one_object(call("info", recording, "--json"))
    assert (facts["type"], facts["rows"], facts["sample_time_s"]) == ("recording", 600, 0.02)
    facts = one_object(call("info", rls_file, "--json"))
    assert (facts["type"], facts["kind"]) == ("model", "rls")
    row = {"metric": "pitch.rise_s", "limit": 0.4, "value": 0.3, "holds": True}
    contents = certificate_contents(
        "verify", holds=True, files={"controller": ("pi.npz", "0" * 64)}, more={"requirements": [row]}
    )
    write_certificate("c.json", contents)
    facts = one_object(call("info", "c.json", "--json"))
    assert (facts["type"], facts["of"], facts["seal"], facts["holds"]) == (
        "certificate", "softneck verify", "genuine", True,
    )  # fmt: skip
    assert facts["requirements"] == ["pitch.rise_s: 0.3, limit 0.4"]
    edited = Path("c.json").read_text().replace("0.3", "0.2")
    Path("c.json").write_text(edited)
    facts = one_object(call("info", "c.json", "--json"))
    assert (facts["type"], facts["seal"]) == (
        "certificate", "not genuine: was changed after it was written; verify again.",
    )  # fmt: skip
    assert "rows: 600" in call("info", recording).out


def test_info_refuses_the_loops_and_archives_that_simulate_refuses(call: Call) -> None:
    Path("loop.toml").write_text('duration_s = 1.0\n[plant]\nmodel = "absent.npz"\n')
    Path("x.ssp").write_bytes(b"no archive")
    for name in ("loop.toml", "x.ssp"):
        asked, run = call("info", name), call("simulate", name)
        assert (asked.code, asked.err) == (run.code, run.err)
        assert asked.code == 2


def test_a_report_takes_a_raw_log_whose_layout_lies_beside_it_for_what_it_is(call: Call, recording: Path) -> None:
    Path("project").mkdir()
    _, *rows = recording.read_text().splitlines()
    # As a logger titles its columns.
    Path("project/log.csv").write_text("\n".join(["t,m1,m2,m3,q1,q2,q3,x,y", *rows]))
    assert "log.csv" in one_object(call("report", "project", "--json", "-o", "before.html"))["problems"]
    motors = [f'motor_setpoint_{k} = {{ column = "m{k}", unit = "rad" }}' for k in (1, 2, 3)]
    angles = [f'{name} = {{ column = "{column}", unit = "deg" }}' for name, column in (("pitch", "x"), ("roll", "y"))]
    Path("neck.layout.toml").write_text("\n".join(['[time]\ncolumn = "t"\n[channels]', *motors, *angles]))
    assert call("import", "project/log.csv", "--layout", "neck.layout.toml", "-o", "project/neck.csv").code == 0
    Path("neck.layout.toml").rename("project/neck.layout.toml")
    told = one_object(call("report", "project", "--json", "-o", "after.html"))
    assert (told["recordings"], told["problems"]) == (1, {})


def test_a_run_of_the_project_s_own_loop_is_no_data_of_it(call: Call, recording: Path, rls_file: Path) -> None:
    Path("project").mkdir()
    assert call("design", "pi", rls_file, "-o", "project/pi.npz", "--any-fit").code == 0
    parts = '[plant]\nneck = "paper"\n[controller]\nfile = "pi.npz"\n[reference]\nkind = "step"\npitch_deg = 3\n'
    Path("project/loop.toml").write_text(f"duration_s = 1.0\n{parts}")
    assert call("simulate", "project/loop.toml", "-o", "project/run.csv").code == 0
    told = one_object(call("report", "project", "--json", "-o", "a.html"))
    assert (told["recordings"], told["loops"], told["problems"]) == (0, 1, {})
    Path("project/log.csv").write_text(recording.read_text())
    assert one_object(call("report", "project", "--json", "-o", "b.html"))["recordings"] == 1


def test_info_says_what_the_columns_of_a_log_seem_to_be(call: Call, recording: Path) -> None:
    rows = [line.split(",") for line in recording.read_text().splitlines()]
    titles = [
        cell.split(" [")[0].replace("motor_setpoint", "target").replace("motor_position", "enc") for cell in rows[0]
    ]
    Path("log.txt").write_text("\n".join(";".join(cells) for cells in [titles, *rows[1:]]))
    facts = one_object(call("info", "log.txt", "--json"))
    assert facts["type"] == "log"
    assert any(line.startswith("motor_setpoint_1 from column 'target_1' [rad]: because") for line in facts["columns"])
    assert facts["missing"] == "nothing that a recording needs"
    assert call(*facts["import"].split()[1:]).code == 0  # what it says to do is what to do
    assert "type: log" in call("info", "log.txt").out
    said = call("info", "log.txt", "--html", "page.html")
    assert said.code == 2
    assert "log.txt: `--html` shows the quality of a recording" in said.error


def test_info_of_a_recording_with_a_fault_says_the_fault(call: Call, recording: Path) -> None:
    lines = recording.read_text().splitlines()
    Path("gap.csv").write_text("\n".join([*lines[:50], *lines[80:]]))
    said = call("info", "gap.csv")
    assert said.code == 2
    assert "gap.csv: `time` jumps" in said.error
    Path("note.txt").write_text("a neck of soft material")
    assert "note.txt: by its ending not a file of softneck, nor is it a log" in call("info", "note.txt").error


def test_the_doctor_tells_of_every_dependency(call: Call) -> None:
    facts = one_object(call("doctor", "--json"))
    states = {check["name"]: check["state"] for check in facts["checks"]}
    assert facts["healthy"] is True
    asked = {re.match(r"[\w.-]+", line)[0] for line in requires("softneck") or [] if "extra ==" not in line}  # type: ignore[index]
    assert {"numpy", "numba", "scipy", "control", "pythonfmu"} <= asked
    assert all(states[name] == "ok" for name in ("python", *asked, "pythonfmu binary"))
    printed = call("doctor").out
    assert "extra dask" in printed


def test_the_doctor_fails_when_something_is_missing(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.cli._doctor._requirements", lambda: ["a-package-that-is-none"])
    said = call("doctor", "--json")
    assert said.code == 1
    assert json.loads(said.out)["healthy"] is False


def test_record_gives_what_its_seed_says(call: Call) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        facts = one_object(call("record", "eq22", "-o", f"{name}.csv", "--duration", "4", "--seed", seed, "--json"))
        assert (facts["rows"], facts["sample_time_s"]) == (200, 0.02)
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()
    assert Path("a.csv").read_bytes() != Path("c.csv").read_bytes()
    assert read_recording("a.csv").has_motor_positions


def test_observer_controller_and_fmu_from_one_model(call: Call, rls_file: Path) -> None:
    one_object(call("observer", rls_file, "-o", "o.npz", "--json"))
    one_object(call("design", "pi", rls_file, "-o", "c.npz", "--json"))
    assert load("o.npz", role="observer").summary()
    assert load("c.npz", role="controller").summary()
    one_object(call("fmu", rls_file, "-o", "Rls.fmu", "--json"))
    facts = one_object(call("info", "Rls.fmu", "--json"))
    assert (facts["type"], facts["model"]) == ("FMU", "Rls")
    assert facts["inputs"].startswith("motor_setpoint_1, motor_setpoint_2, motor_setpoint_3, pitch_measured")
    wrong = call("observer", "c.npz", "-o", "x.npz", "--json")
    assert wrong.code == 2
    assert "c.npz: is a controller (pi), not a model" in wrong.error


def test_the_installed_command_says_the_same() -> None:
    tool = Path(sys.executable).with_name("softneck")
    done = subprocess.run([tool, "info", "none.csv"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "softneck: none.csv: no such file.\n"


@pytest.mark.slow
def test_the_real_neck_from_log_to_free_run(call: Call, shared_data: Path) -> None:
    log = shared_data / "neck_openloop/spring_test_0gr.csv"
    facts = one_object(call("import", log, "--layout", LAYOUTS / "neck_openloop.toml", "-o", "n.csv", "--json"))
    assert (facts["rows"], facts["runs"], facts["missed_samples"]) == (7000, 1, 0)
    one_object(call("identify", "rls", "n.csv", "-o", "m.npz", "--train", "1", "--json"))
    judged = one_object(call("validate", "m.npz", "--data", "n.csv", "--include-training", "--json"))
    free = judged["models"][0]["fits"]["model"]["inf"]
    # Issue 2 asks for 92 and 88; the data's README reports 93.1 and 89.8 of such a model.
    assert free["pitch"] >= 92.0
    assert free["roll"] >= 88.0
    # Static gain 0.1177 deg of pitch per deg of theta_i there, by output error; least squares differs by its bias.
    gain = load("m.npz").tf("pitch").dcgain()
    assert gain == pytest.approx(0.1177, rel=0.03)


def test_the_arm_is_imported_to_its_first_13000_rows(call: Call, shared_data: Path) -> None:
    log = shared_data / "arm_multisine/arm_multisine_400s.csv"
    facts = one_object(call("import", log, "--layout", LAYOUTS / "arm_multisine.toml", "-o", "a.csv", "--json"))
    assert facts["rows"] == 13_000


def test_verify_says_once_why_something_was_not_computed(call: Call) -> None:
    bellows = Robot.from_dict({
        "name": "bellows", "time_constant_s": 0.2, "sensor": {"noise_std": 0.1},
        "motors": {"names": ["chamber"], "unit": "bar", "setpoint_min": 0, "setpoint_max": 3, "rate_limit": 20},
        "outputs": {"names": ["stroke"], "unit": "mm", "min": 0, "max": 60},
        "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip
    plant(bellows, gain=2e-7).save("m.npz")
    assert call("design", "pi", "m.npz", "-o", "pi.npz").code == 0
    said = call("verify", "pi.npz", "m.npz", "-o", "c.json")
    assert said.code in (0, 1), said.err
    assert "not computed: sim: no virtual plant stands for `bellows`" in said.out
    assert said.out.count("no virtual plant stands for") == 1
    # As wide as the longest name and value ask: it was 250 columns by a reason in each row.
    assert max(len(line) for line in said.out.splitlines() if line.startswith("│")) < 200
