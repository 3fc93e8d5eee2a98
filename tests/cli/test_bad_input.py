"""Every kind of bad input: one clear line on stderr, exit code 2, nothing on stdout and no half-written file."""

from __future__ import annotations

import errno
import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from softneck.core import read_archive, write_archive
from softneck.signals import Recording, write_recording

from ..data import LAYOUTS, changed, csv_lines, neck_recording
from .conftest import Call, Said

Edit = Callable[[list[str]], list[str]]
RECORDINGS: dict[str, tuple[Edit, str]] = {
    "missing column": (lambda s: [line.rsplit(",", 1)[0] for line in s], "missing: roll"),
    "unknown column": (lambda s: changed(s, -1, 5, "yaw [deg]"), "column `yaw` is not a channel of a recording"),
    "unit that is none": (lambda s: changed(s, -1, 5, "roll [grad]"), "unknown unit `grad`"),
    "NaN": (lambda s: changed(s, 9, 1, "NaN"), "column `motor_setpoint_1` holds `NaN` at row 9"),
    "gap": (lambda s: [*s[:50], *s[80:]], "`time` jumps by 0.62 s at row 49"),
    "time backwards": (lambda s: changed(s, 9, 0, "0.01"), "`time` runs backwards or stands still at row 9"),
    "too short": (lambda s: s[:60], "rows are too few to identify from; at least 100 are needed"),
    "constant input": (
        lambda s: [s[0], *[",".join([c.split(",")[0], "1", "1", "1", *c.split(",")[4:]]) for c in s[1:]]],
        "the motor set-points are constant; nothing can be identified",
    ),
    "constant output": (
        lambda s: [s[0], *[",".join([*c.split(",")[:4], "3", c.split(",")[5]]) for c in s[1:]]],
        "`pitch` is constant; is its sensor connected?",
    ),
    "no recording": (lambda _: ["a picture", "of a neck"], "column `a picture` names no unit"),
    "empty": (lambda _: [], "cannot be read as a table"),
}


def refused(said: Said, message: str, folder: Path, left: set[str]) -> None:
    assert said.code == 2, said
    assert said.out == ""
    assert said.error.startswith("softneck: ")
    assert message in said.error
    assert {path.name for path in folder.rglob("*") if path.is_file()} == left


@pytest.mark.parametrize("case", RECORDINGS)
def test_a_bad_recording_makes_no_model(call: Call, tmp_path: Path, case: str) -> None:
    edit, message = RECORDINGS[case]
    (tmp_path / "bad.csv").write_text("\n".join(edit(csv_lines(neck_recording(300), 300))))
    refused(call("identify", "rls", "bad.csv", "-o", "m.npz", "--json"), message, tmp_path, {"bad.csv"})


@pytest.mark.parametrize("command", ["identify", "validate", "info"])
def test_a_file_that_is_not_there_is_named(call: Call, tmp_path: Path, rls_file: Path, command: str) -> None:
    arguments = {
        "identify": ("identify", "rls", "none.csv", "-o", "m.npz", "--json"),
        "validate": ("validate", rls_file, "--data", "none.csv", "--json"),
        "info": ("info", "none.csv"),
    }[command]
    refused(call(*arguments), "none.csv: no such file", tmp_path, set())


def test_recordings_of_two_sample_times_are_named(call: Call, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\n".join(csv_lines(neck_recording(300), 300)))
    slow = neck_recording(300)
    write_recording("b.csv", Recording(2 * slow.time, 2 * slow.sample_time, slow.channels))
    message = "different sample times cannot be used together: 0.02 s and 0.04 s (a.csv and b.csv)"
    left = {"a.csv", "b.csv"}
    refused(call("identify", "rls", "a.csv", "b.csv", "-o", "m.npz", "--json"), message, tmp_path, left)


def test_a_model_under_another_ending_is_refused_before_any_work(call: Call, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("never read")
    makers = (("identify", "rls"), ("identify", "auto"), ("family",))
    for maker, name in itertools.product(makers, ("m.csv", "m")):
        said = call(*maker, "a.csv", "-o", name, "--json")
        refused(said, f"{name}: must end in `.npz`, by which softneck recognises the file", tmp_path, {"a.csv"})


def test_a_model_that_is_none(call: Call, tmp_path: Path, recording: Path) -> None:
    (tmp_path / "m.npz").write_bytes(b"PK\x03\x04 a zip that is none")
    said = call("validate", "m.npz", "--data", recording, "--json")
    refused(said, "m.npz: is not a softneck file or is damaged", tmp_path, {"m.npz"})
    (tmp_path / "m.npz").write_text(recording.read_text())
    refused(call("info", "m.npz"), "m.npz: is not a softneck file", tmp_path, {"m.npz"})
    said = call("validate", recording, "--data", recording, "--json")
    refused(said, "recordings only; expected a model before them", tmp_path, {"m.npz"})


def test_a_model_of_another_version(call: Call, tmp_path: Path, recording: Path, rls_file: Path) -> None:
    header, arrays = read_archive(rls_file)
    write_archive(tmp_path / "m.npz", {**header, "format_version": 2}, arrays)
    for arguments in (("validate", "m.npz", "--data", recording, "--json"), ("info", "m.npz"),
                      ("fmu", "m.npz", "-o", "M.fmu", "--json"), ("observer", "m.npz", "-o", "o.npz", "--json"),
                      ("design", "pi", "m.npz", "-o", "c.npz", "--json")):  # fmt: skip
        refused(call(*arguments), "has format version 2; this softneck reads 1", tmp_path, {"m.npz"})


def test_a_full_disk(call: Call, tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_args: object, **_more: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez_compressed", full)
    said = call("identify", "rls", recording, "-o", "m.npz", "--set", "delay=0.06", "--json")
    refused(said, "m.npz: cannot be written: No space left on device. Nothing was left behind", tmp_path, set())


def test_a_folder_that_cannot_be_written(call: Call, tmp_path: Path, recording: Path) -> None:
    (tmp_path / "file").write_text("")
    said = call("identify", "rls", recording, "-o", "file/m.npz", "--set", "delay=0.06", "--json")
    refused(said, "m.npz: cannot be written", tmp_path, {"file"})


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("speed=3", "unknown setting `speed`; this kind has covariance_bound, delay"),
        ("na", "--set takes KEY=VALUE; got `na`"),
        ("na=0", "`na` must be a whole number between 1 and 100; got 0"),
        ("na=1.5", "`na` must be a whole number between 1 and 100; got 1.5"),
        ("na=two", "`na` must be a whole number between 1 and 100; got 'two'"),
        ("na=true", "`na` must be a whole number"),
        ("forgetting=nan", "`forgetting` must be a finite number; got nan"),
        ("delay=-5", "`delay` must be between 0 and 1e+06 [s]; got -5"),
        ("delay=late", "`delay` must be a finite number [s]; got late"),
        ("structure=luck", "`structure` must be one of siso, miso, mimo; got 'luck'"),
    ],
)
def test_a_wrong_setting(call: Call, tmp_path: Path, recording: Path, setting: str, message: str) -> None:
    refused(call("identify", "rls", recording, "-o", "m.npz", "--set", setting, "--json"), message, tmp_path, set())


@pytest.mark.parametrize("setting", ["hidden=3", "hidden=[2.5, 3]", "hidden=[1,2,3]", "hidden=[0, 3]", "iterations=0.5",
                                     "hidden=[1000000, 1000000]", "decay=-1", "seed=-1"])  # fmt: skip
def test_a_wrong_setting_of_a_network(call: Call, tmp_path: Path, recording: Path, setting: str) -> None:
    key = setting.split("=")[0]
    said = call("identify", "nn", recording, "-o", "m.npz", "--set", setting, "--json")
    refused(said, "wrong type" if setting == "hidden=3" else f"`{key}` must be", tmp_path, set())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("identify", "magic", "REC", "-o", "m.npz"), "unknown kind of model `magic`; use one of rls, "),
        (("identify", "pi", "REC", "-o", "m.npz"), "unknown kind of model `pi`"),
        (("identify", "rls", "REC", "-o", "m.npz", "--train", "0"), "the part to train on must be in (0, 1]; got 0"),
        (("identify", "rls", "REC", "-o", "m.npz", "--train", "all"), "'all' is not a valid float"),
        (("identify", "oe", "REC", "--set", "intervals=maybe"), "`intervals` is true or false; got 'maybe'"),
        (("identify", "rls"), "Missing argument"),
        (("validate", "MODEL", "--data", "REC", "--horizon", "0"), "--horizon takes numbers of samples and `inf`"),
        (("validate", "MODEL", "--data", "REC", "--horizon", "1,,inf"), "--horizon takes numbers of samples"),
        (("validate", "MODEL", "--data", "REC", "--motors", "felt"), "'felt' is not one of 'simulated', 'measured'"),
        (("validate", "MODEL"), "Missing option '--data'"),
        (("import", "REC"), "import needs either --layout LAYOUT.toml or --guess; neither was given"),
        (("import", "REC", "--guess", "--layout", "a.toml"), "either --layout LAYOUT.toml or --guess; both were given"),
        (("import", "none.csv", "--guess"), "none.csv: no such file"),
        (("import", "REC", "--guess", "-o", "r.xlsx"), "a recording is a `.csv` or a `.parquet` file"),
        (("import", "REC", "--layout", "none.toml"), "none.toml: no such file"),
        (("info", "neck.xyz"), "neck.xyz: no such file"),
        (("record", "song", "-o", "r.csv"), "`signal` must be one of eq22"),
        (("record", "steps", "-o", "r.csv", "--neck", "giraffe"), "giraffe: no such file"),
        (("record", "steps", "-o", "r.csv", "--payload", "-1"), "`--payload` must be between 0 and 1 [kg]"),
        (("record", "steps", "-o", "r.csv", "--duration", "0"), "`duration` must be between 0.02 and 86400 [s]"),
        (("record", "eq22", "-o", "r.csv", "--duration", "0.001"), "r"),
        (("record", "steps", "-o", "r.xlsx", "--duration", "1"), "a recording is a `.csv` or a `.parquet` file"),
        (
            ("design", "lqr", "MODEL", "-o", "c.npz"),
            "unknown kind of controller `lqr`; did you mean `lqg`? use one of pi",
        ),
        (("design", "pi", "MODEL", "-o", "c.npz", "--set", "luck=1"), "unknown setting `luck`"),
        (("observer", "MODEL", "-o", "o.npz", "--set", "sensor=nose"), "nose"),
        (("simulate", "none.toml"), "none.toml: no such file"),
        (("fmu", "none.npz", "-o", "M.fmu"), "none.npz: no such file"),
        (("fmu",), ""),
        (("dance",), "no such command `dance`; the commands are start, "),
        (("info", "--fast"), "No such option"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_wrong_arguments(
    call: Call, tmp_path: Path, recording: Path, rls_file: Path, arguments: tuple[str, ...], message: str
) -> None:
    files = {"REC": recording, "MODEL": rls_file}
    said = call(*[files.get(word, word) for word in arguments])
    refused(said, message, tmp_path, set())


@pytest.mark.parametrize(
    "arguments",
    [
        ("identify", "rls", "D.csv", "-o", "m.npz"), ("validate", "MODEL", "--data", "D.csv"), ("simulate", "D.toml"),
        ("simulate", "D.ssp"), ("info", "D.csv"),
        ("import", "REC", "--layout", "D.toml"), ("start", "D.csv"), ("start", "REC", "--requirements", "D.toml"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_a_folder_in_the_place_of_a_file_is_called_one(
    call: Call, tmp_path: Path, recording: Path, rls_file: Path, arguments: tuple[str, ...]
) -> None:
    folder = next(word for word in arguments if word.startswith("D."))
    (tmp_path / folder).mkdir()
    files = {"REC": recording, "MODEL": rls_file}
    refused(
        call(*[files.get(word, word) for word in arguments]), f"{folder}: is a folder; name a file", tmp_path, set()
    )


@pytest.mark.parametrize("content", ["[1, 2]", "5", "{", "null", "\xff"])
def test_info_of_json_that_is_not_ours(call: Call, tmp_path: Path, content: str) -> None:
    (tmp_path / "a.json").write_bytes(content.encode("latin-1"))
    refused(call("info", "a.json"), "a.json: ", tmp_path, {"a.json"})


@pytest.mark.parametrize("name", ["a.fmu", "a.csv", "a.parquet", "a.npz", "a.xyz", "a.toml"])
def test_info_of_noise(call: Call, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(bytes(range(256)))
    refused(call("info", name), f"{name}: ", tmp_path, {name})


def test_an_import_of_a_log_without_its_columns(call: Call, tmp_path: Path, recording: Path) -> None:
    said = call("import", recording, "--layout", LAYOUTS / "neck_openloop.toml", "-o", "r.csv", "--json")
    refused(said, "column `target_motor1` for `motor_setpoint_1` is not in the file", tmp_path, set())


LOG_LAYOUT = """
[time]
column = "t"
[channels]
motor_setpoint_1 = { column = "a", unit = "rad" }
motor_setpoint_2 = { column = "b", unit = "rad" }
motor_setpoint_3 = { column = "c", unit = "rad" }
pitch = { column = "p", unit = "rad" }
roll = { column = "r", unit = "rad" }
"""
LOG = ["t,a,b,c,p,r", *[f"{k / 50},{k},{k % 3},{k % 5},{k / 100},{-k / 100}" for k in range(40)]]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (changed(LOG, 9, 0, "0.16"), "`time` stands still at row 9: 0.16 s occurs twice (1 such row(s))"),
        (changed(LOG, 9, 0, "0.1"), "`time` runs backwards or stands still at row 9 (0.16 to 0.1 s)"),
        (changed(LOG, 9, 0, "soon"), "column `t` holds `soon` at row 9"),
        (changed(LOG, 9, 0, "inf"), "`time` is not finite at row 9"),
        ([LOG[0], *[",".join([*line.split(",")[:4], "", line.split(",")[5]]) for line in LOG[1:]]],
         "column `p` for `pitch` holds no number in any of its 40 rows; is its sensor connected?"),
        (LOG[:2], "a recording needs at least 2 rows; got 1"),
        (LOG[:1], "a recording needs at least 2 rows; got 0"),
    ],
    ids=["duplicate", "backwards", "word", "infinite", "all NaN", "one row", "no row"],
)  # fmt: skip
def test_a_log_that_does_not_fit_its_layout(call: Call, tmp_path: Path, lines: list[str], message: str) -> None:
    (tmp_path / "log.csv").write_text("\n".join(lines))
    (tmp_path / "l.toml").write_text(LOG_LAYOUT)
    said = call("import", "log.csv", "--layout", "l.toml", "-o", "r.csv", "--json")
    refused(said, message, tmp_path, {"log.csv", "l.toml"})


@pytest.mark.parametrize(
    ("variable", "message"),
    [("lag", "there is no variable `lag` with numbers; the file has log (40 x 6)"),
     (None, "has no vectors of numbers; name the matrix by `[file] variable`; it has log (40 x 6)")],
)  # fmt: skip
def test_a_mat_file_without_the_named_variable(call: Call, tmp_path: Path, variable: str | None, message: str) -> None:
    table = np.array([[float(cell) for cell in line.split(",")] for line in LOG[1:]])
    savemat(tmp_path / "log.mat", {"log": table})
    head = f'[file]\nvariable = "{variable}"\n' if variable else ""
    (tmp_path / "l.toml").write_text(head + LOG_LAYOUT)
    said = call("import", "log.mat", "--layout", "l.toml", "-o", "r.csv", "--json")
    refused(said, message, tmp_path, {"log.mat", "l.toml"})


def test_a_guess_proposes_imports_and_says_why(call: Call, tmp_path: Path, recording: Path) -> None:
    said = call("import", recording, "--guess", "-o", "r.csv", "--json")
    facts = json.loads(said.out)
    assert (said.code, facts["rows"], facts["layout_file"]) == (0, 600, "r.layout.toml")
    assert facts["layout"]["channels"]["pitch"] == {"column": "pitch [deg]", "unit": "deg"}
    assert "pitch from column 'pitch [deg]' [deg]: because it is titled as in a recording" in said.err
    again = call("import", recording, "--layout", "r.layout.toml", "-o", "again.csv")
    assert again.code == 0, again.err
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "r.csv").read_bytes()
    kept = call("import", recording, "--guess", "-o", "r.csv")
    assert (kept.code, kept.error.split(": ")[1]) == (2, "r.csv")
    (tmp_path / "r.csv").unlink()
    (tmp_path / "r.layout.toml").write_text("# edited")
    kept = call("import", recording, "--guess", "-o", "r.csv")
    assert "r.layout.toml: exists already; use --force" in kept.error
    assert (tmp_path / "r.layout.toml").read_text() == "# edited"


def test_a_guess_that_lacks_something_is_written_as_far_as_it_goes(call: Call, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("\n".join(["time,target1,target2,target3,pitch,wind", *LOG[1:]]))
    said = call("import", "log.csv", "--guess", "-o", "r.csv", "--json")
    assert (said.code, said.out) == (2, "")
    last = said.err.splitlines()[-1]
    assert last.startswith("softneck: log.csv: not found: roll: is it 'wind'? Write `roll = { column = 'wind'")
    # Above it stand both ways on: the layout, and the columns by their names.
    assert "fill in what is MISSING, and use --layout r.layout.toml" in said.err
    assert "or name the columns: `softneck import log.csv --motor target1" in said.err.splitlines()[-2]
    assert {path.name for path in tmp_path.iterdir()} == {"log.csv", "r.layout.toml"}
    text = (tmp_path / "r.layout.toml").read_text()
    assert "# MISSING roll: is it 'wind'?" in text
    filled = text.replace("[channels]", '[channels]\nroll = { column = "wind", unit = "rad" }')
    (tmp_path / "r.layout.toml").write_text(filled)
    assert call("import", "log.csv", "--layout", "r.layout.toml", "-o", "r.csv").code == 0


def test_a_model_that_knows_all_rows_has_nothing_to_show(call: Call, tmp_path: Path, recording: Path) -> None:
    done = call("identify", "rls", recording, "-o", "m.npz", "--train", "1", "--set", "delay=0.06", "--json")
    assert json.loads(done.out)["hold_out"] is None
    said = call("validate", "m.npz", "--data", recording, "--json")
    refused(said, "nothing is left to judge: all 600 rows were used to train the model", tmp_path, {"m.npz"})
