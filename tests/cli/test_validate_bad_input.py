"""What `softneck validate` takes and refuses: one clear line each, exit code 2, nothing on stdout."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softneck.signals import Recording, concatenate, write_recording

from ..data import neck_recording
from .conftest import Call, Said

WHOLE = neck_recording(300, seed=8)


def slower(recording: Recording) -> Recording:
    return Recording(recording.time * 2, recording.sample_time * 2, recording.channels)


def without_positions(recording: Recording) -> Recording:
    kept = {name: c for name, c in recording.channels.items() if not name.startswith("motor_position")}
    return Recording(recording.time, recording.sample_time, kept)


CASES: dict[str, tuple[Recording, tuple[str, ...], str]] = {
    "runs shorter than the warm-up": (
        concatenate([WHOLE.rows(0, 20), WHOLE.rows(50, 75)]),
        (),
        "25 rows are too few, as the first 25 of each run set the initial state and are not scored; record longer",
    ),
    "no motor positions to measure": (
        without_positions(WHOLE),
        ("--motors", "measured"),
        "motors=measured needs logged motor positions and the recording has none; judge it with --motors simulated",
    ),
    "another sample time": (
        slower(WHOLE),
        (),
        "on bad.csv: the model was identified at 0.02 s and the recording is at 0.04 s; resample it "
        "(`softneck import --resample`) or identify again",
    ),
    "a horizon longer than the run": (
        WHOLE,
        ("--horizon", "1,300,inf"),
        "a horizon of 300 samples is longer than what is judged: the longest segment of rows that the model was not "
        "trained on has 300",
    ),
}


def refused(said: Said, message: str) -> None:
    assert said.code == 2, said
    assert said.out == ""
    assert said.error.startswith("softneck: ")
    assert message in said.error


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("how", [("--json",), ()], ids=["json", "table"])
def test_data_that_cannot_be_judged(call: Call, rls_file: Path, case: str, how: tuple[str, ...]) -> None:
    recording, options, message = CASES[case]
    write_recording("bad.csv", recording)
    refused(call("validate", rls_file, "--data", "bad.csv", *options, *how), message)


def test_one_data_takes_several_recordings(call: Call, rls_file: Path) -> None:
    write_recording("a.csv", WHOLE.rows(0, 200))
    write_recording("b.csv", WHOLE.rows(200, 300))
    together = call("validate", rls_file, "--data", "a.csv", "b.csv", "--json")
    apart = call("validate", rls_file, "--data", "a.csv", "--data", "b.csv", "--json")
    assert together.code == 0
    assert together.out == apart.out
    assert len(json.loads(together.out)["models"]) == 2


@pytest.mark.parametrize("name", ["pitch", "roll"])
def test_an_angle_that_was_never_measured_is_named(call: Call, rls_file: Path, name: str) -> None:
    write_recording("good.csv", WHOLE)
    lines = [line.split(",") for line in Path("good.csv").read_text().splitlines()]
    column = lines[0].index(f"{name} [deg]")
    for line in lines[1:]:
        line[column] = ""
    Path("bad.csv").write_text("\n".join(map(",".join, lines)))
    refused(call("validate", rls_file, "--data", "bad.csv", "--json"), f"channel `{name}` has no sample")


def test_missing_columns_are_named(call: Call, rls_file: Path) -> None:
    write_recording("good.csv", WHOLE)
    lines = Path("good.csv").read_text().splitlines()
    column = lines[0].split(",").index("roll [deg]")
    cut = [",".join(c for i, c in enumerate(line.split(",")) if i != column) for line in lines]
    Path("bad.csv").write_text("\n".join(cut))
    refused(call("validate", rls_file, "--data", "bad.csv", "--json"), "missing: roll")


@pytest.mark.slow
def test_what_too_few_rows_cannot_tell_is_not_told(call: Call, rls_file: Path) -> None:
    write_recording("short.csv", WHOLE.rows(0, 70))  # 45 errors; a correlation at lag 25 needs more than 50
    said = call("validate", rls_file, "--data", "short.csv", "--html", "page.html")
    assert said.code == 0
    assert "too few residuals for a test of whiteness" in said.out
    assert "nan" not in said.out
    page = Path("page.html").read_text(encoding="utf-8")
    assert "Too few residuals for a test of whiteness." in page
