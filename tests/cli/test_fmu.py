"""softneck fmu: a folder with every kind, scores inside the FMU, and what it refuses."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from softneck.cli._fmu import open_buildable
from softneck.core import FileFormatError, load, read_archive, write_archive
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.identification.models._validity import with_tolerance

from .conftest import Call


@pytest.fixture
def folder(tmp_path: Path, models: dict) -> Path:
    """One file of each role and each kind of model, a neck, and files that are none."""
    place = tmp_path / "things"
    place.mkdir()
    for name, model in models.items():
        model.save(place / f"{name}-model.npz")
    linear = models["rls"]
    KalmanSettings().design(linear).save(place / "kalman.npz")
    PiSettings().design(linear).save(place / "3pi.npz")
    (place / "neck.toml").write_text('preset = "lab"\n')
    (place / "loop.toml").write_text("duration_s = 1.0\n")
    (place / "notes.txt").write_text("mine")
    return place


@pytest.mark.slow
def test_all_builds_every_file_of_a_folder(call: Call, folder: Path, models: dict) -> None:
    said = call("fmu", folder, "-o", "out", "--json")
    assert said.code == 0, said.err
    built = json.loads(said.out)["fmus"]
    names = {Path(entry["fmu"]).name for entry in built}
    assert names == {f"{name}_model.fmu" for name in models} | {"kalman.fmu", "m_3pi.fmu", "neck.fmu"}
    for entry in built:
        assert validate_fmu(entry["fmu"]) == []


def test_a_damaged_file_stops_all_before_anything_is_written(call: Call, folder: Path) -> None:
    (folder / "zz.npz").write_bytes((folder / "kalman.npz").read_bytes()[:-300])
    said = call("fmu", folder, "-o", "out")
    assert said.code == 2
    assert "zz.npz" in said.error
    assert not Path("out").exists()


def test_two_files_of_one_name_are_refused(call: Call, folder: Path) -> None:
    (folder / "rls_model.npz").write_bytes((folder / "rls-model.npz").read_bytes())
    said = call("fmu", folder, "-o", "out")
    assert said.code == 2
    assert "would both become out/rls_model.fmu" in said.error


def test_scores_on_data_go_into_the_fmu(call: Call, rls_file: Path, recording: Path) -> None:
    said = call("fmu", rls_file, "-o", "Rls.fmu", "--data", recording)
    assert said.code == 0, said.err
    judged = json.loads(call("validate", rls_file, "--data", recording, "--json").out)["models"][0]
    with zipfile.ZipFile("Rls.fmu") as archive:
        page = archive.read("documentation/index.html").decode()
    assert f"on {judged['rows_scored']} rows of neck.csv" in page
    assert f"<td>simulation (free run)</td><td>{judged['fits']['model']['inf']['pitch']:.2f}</td>" in page


def test_the_tolerance_that_identify_was_given_is_that_of_the_fmu(call: Call, recording: Path) -> None:
    held = {"motor_setpoint_1": 1.5, "motor_setpoint_2": -0.5, "motor_setpoint_3": -1.0}
    call("identify", "rls", recording, "-o", "rls.npz", "--tolerance", 5)
    assert call("fmu", "rls.npz", "-o", "Rls.fmu").code == 0
    played: Any = fmpy.simulate_fmu("Rls.fmu", stop_time=0.5, start_values=held, output=["validity"])
    five = load("rls.npz", role="model")
    validity = []
    for model in (five, with_tolerance(five, 2.0)):
        block = model.block()
        row = [held.get(port.name, port.start) for port in block.inputs]
        validity.append(block.run(block.initial_state(), np.tile(row, (25, 1)))[1][:, -1])
    # The same scalar code, compiled here and not in the FMU: only the last digits may differ.
    np.testing.assert_allclose(played["validity"][1:], validity[0], rtol=1e-9)
    assert (validity[0] > validity[1]).all()


def test_what_cannot_become_an_fmu_is_said(call: Call, rls_file: Path, tmp_path: Path) -> None:
    header, kept = {"kind": "rls", "sample_time": 0.02}, rls_file.read_bytes()
    cases: list[tuple[tuple[object, ...], str]] = [
        (("fmu", "none.npz", "-o", "M.fmu"), "no such file"),
        (("fmu", rls_file, "-o", "1st.fmu"), "cannot be the model name of an FMU"),
        (("fmu", rls_file, "-o", "my model.fmu"), "cannot be the model name of an FMU"),
        (("fmu", rls_file, "-o", "M.zip"), "must end in `.fmu`"),
        (("fmu", rls_file, "-o", rls_file / "M.fmu"), "cannot be written"),
        (("fmu", "cut.npz", "-o", "M.fmu"), "cut.npz"),
        (("fmu", "empty.npz", "-o", "M.fmu"), "empty.npz"),
        (("fmu", "other.npz", "-o", "M.fmu"), "unknown kind `horse`"),
        (("fmu", "neck.txt", "-o", "M.fmu"), "neck.txt"),
        (("fmu", "nowhere"), "nowhere"),
        (("fmu", "."), ""),
    ]
    Path("cut.npz").write_bytes(kept[: len(kept) // 2])
    write_archive("empty.npz", header, {})
    write_archive("other.npz", header | {"kind": "horse"}, {"a": np.zeros(2)})
    for arguments, text in cases:
        said = call(*arguments)
        assert said.code == 2, arguments
        assert text in said.error, arguments
    assert not list(tmp_path.glob("*.fmu"))


def test_the_name_of_the_file_is_that_of_the_model(call: Call, rls_file: Path) -> None:
    for name, text in (("a-b", "`a-b` cannot be the model name"), ("class", "`class` cannot be")):
        said = call("fmu", rls_file, "-o", f"{name}.fmu")
        assert (said.code, text in said.error) == (2, True)


def test_a_model_of_another_version_is_refused(call: Call, rls_file: Path) -> None:
    header, arrays = read_archive(rls_file)
    write_archive("new.npz", header | {"format_version": 999}, arrays)
    said = call("fmu", "new.npz", "-o", "M.fmu")
    assert said.code == 2
    assert "new.npz: has format version 999; this softneck reads 1." in said.error


def test_what_has_no_block_is_no_fmu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.fmu.describe._describe.load_for_robot", lambda _path, **_: object())
    with pytest.raises(FileFormatError, match="is not a model, observer or controller"):
        open_buildable(tmp_path / "family.npz")


def test_a_recording_is_no_fmu_and_what_is_one_is_said(call: Call, recording: Path) -> None:
    said = call("fmu", recording, "-o", "Recording.fmu")
    assert said.code == 2
    assert "no FMU can be built from a `.csv` file; give a model" in said.error
    assert not Path("Recording.fmu").exists()
