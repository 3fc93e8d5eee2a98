"""Every kind of bad input: one clear line on stderr, exit code 2, nothing on stdout and no half-written file."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from softneck.core import read_archive, write_archive

from ..data import LAYOUTS, changed, csv_lines, neck_recording
from .conftest import Call, Said

Edit = Callable[[list[str]], list[str]]
RECORDINGS: dict[str, tuple[Edit, str]] = {
    "missing column": (lambda s: [line.rsplit(",", 1)[0] for line in s], "missing: roll"),
    "unknown column": (lambda s: changed(s, -1, 5, "yaw [deg]"), "column `yaw` is no channel of a recording"),
    "unit that is none": (lambda s: changed(s, -1, 5, "roll [grad]"), "`grad` is no unit that softneck knows"),
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


def test_a_model_that_is_none(call: Call, tmp_path: Path, recording: Path) -> None:
    (tmp_path / "m.npz").write_bytes(b"PK\x03\x04 a zip that is none")
    said = call("validate", "m.npz", "--data", recording, "--json")
    refused(said, "m.npz: is no softneck file or is damaged", tmp_path, {"m.npz"})
    (tmp_path / "m.npz").write_text(recording.read_text())
    refused(call("info", "m.npz"), "m.npz: is no softneck file", tmp_path, {"m.npz"})


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
        ("speed=3", "there is no setting `speed`; this kind has covariance_bound, dead_zone, delay"),
        ("na", "--set takes KEY=VALUE; got `na`"),
        ("na=0", "`na` must be a whole number between 1 and 100; got 0"),
        ("na=1.5", "`na` must be a whole number between 1 and 100; got 1.5"),
        ("na=two", "`na` must be a whole number between 1 and 100; got 'two'"),
        ("na=true", "`na` must be a whole number"),
        ("forgetting=nan", "`forgetting` must be a finite number; got nan"),
        ("delay=5", "`delay` must be between 0 and 2 [s]; got 5"),
        ("delay=late", "a setting has a value of the wrong type"),
        ("delay_by=luck", "`delay_by` must be one of free_run, one_step; got 'luck'"),
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
        (("identify", "magic", "REC", "-o", "m.npz"), "`magic` is no kind of model; use one of rls, oe"),
        (("identify", "pi", "REC", "-o", "m.npz"), "`pi` is no kind of model"),
        (("identify", "rls", "REC", "-o", "m.npz", "--train", "0"), "the part to train on must be in (0, 1]; got 0"),
        (("identify", "rls", "REC", "-o", "m.npz", "--train", "all"), "'all' is not a valid float"),
        (("identify", "rls"), "Missing argument"),
        (("validate", "MODEL", "--data", "REC", "--horizon", "0"), "--horizon takes numbers of samples and `inf`"),
        (("validate", "MODEL", "--data", "REC", "--horizon", "1,,inf"), "--horizon takes numbers of samples"),
        (("validate", "MODEL", "--data", "REC", "--motors", "felt"), "'felt' is not one of 'simulated', 'measured'"),
        (("validate", "MODEL"), "Missing option '--data'"),
        (("import", "REC"), "Missing option '--layout'"),
        (("import", "REC", "--layout", "none.toml"), "none.toml: no such file"),
        (("info", "neck.xyz"), "neck.xyz: no such file"),
        (("record", "song", "-o", "r.csv"), "`signal` must be one of eq22"),
        (("record", "steps", "-o", "r.csv", "--neck", "giraffe"), "`giraffe` is neither a neck preset"),
        (("record", "steps", "-o", "r.csv", "--payload", "-1"), "`--payload` must be between 0 and 1 [kg]"),
        (("record", "steps", "-o", "r.csv", "--duration", "0"), "`duration` must be positive [s]"),
        (("record", "eq22", "-o", "r.csv", "--duration", "0.001"), "r"),
        (("record", "steps", "-o", "r.xlsx", "--duration", "1"), "a recording is a `.csv` or a `.parquet` file"),
        (("design", "lqg", "MODEL", "-o", "c.npz"), "`lqg` is no kind of controller; use one of pi"),
        (("design", "pi", "MODEL", "-o", "c.npz", "--set", "luck=1"), "there is no setting `luck`"),
        (("observer", "MODEL", "-o", "o.npz", "--sensor", "nose"), "nose"),
        (("simulate", "none.toml"), "none.toml: no such file"),
        (("fmu", "none.npz", "-o", "M.fmu"), "none.npz: no such file"),
        (("fmu",), ""),
        (("dance",), "No such command 'dance'"),
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


def test_a_model_that_knows_all_rows_has_nothing_to_show(call: Call, tmp_path: Path, recording: Path) -> None:
    done = call("identify", "rls", recording, "-o", "m.npz", "--train", "1", "--set", "delay=0.06", "--json")
    assert json.loads(done.out)["hold_out"] is None
    said = call("validate", "m.npz", "--data", recording, "--json")
    refused(said, "nothing is left to judge: all 600 rows were used to train the model", tmp_path, {"m.npz"})
