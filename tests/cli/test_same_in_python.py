"""The same name does the same by default in Python as on the command line: the same bits, the same held-out fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import softneck
from softneck.core import read_archive
from softneck.signals import write_recording

from ..data import neck_recording
from .conftest import Call

# Of the header: what may differ is who wrote the file and when.
_WHAT = ("kind", "sample_time", "settings", "findings")


def same_file(one: Path, other: Path) -> None:
    """Assert that two files hold the same bits, and the same words on how they came about."""
    (head, arrays), (head_too, arrays_too) = read_archive(one), read_archive(other)
    assert {key: head.get(key) for key in _WHAT} == {key: head_too.get(key) for key in _WHAT}
    assert arrays.keys() == arrays_too.keys()
    assert all(np.array_equal(arrays[name], arrays_too[name], equal_nan=True) for name in arrays)


@pytest.mark.parametrize("kind", ["rls", "oe", "play"])
def test_identify_holds_out_the_same_rows_and_tells_the_same_fit(call: Call, recording: Path, kind: str) -> None:
    said = json.loads(call("identify", kind, recording, "-o", "cli.npz", "--json").out)
    model = softneck.identify(kind, recording)
    model.save("python.npz")
    same_file(Path("cli.npz"), Path("python.npz"))
    assert model.findings["hold_out"]["fit"] == said["hold_out"]["fits"]["model"]["inf"]
    assert model.findings["hold_out"]["rows"] == said["hold_out"]["rows_scored"]
    # People read the same lines.
    assert model.summary() == said["summary"]
    assert "hold-out of 155 rows, fit [%] pitch/roll:" in model.summary()


def test_all_rows_to_train_on_hold_nothing_out(recording: Path) -> None:
    model = softneck.identify("rls", recording, train=1.0)
    assert "hold_out" not in model.findings
    assert model.training_rows.size == len(softneck.read_recording(recording))


def test_several_recordings_are_runs_of_one(call: Call, recording: Path) -> None:
    call("identify", "rls", recording, recording, "-o", "cli.npz")
    softneck.identify("rls", [recording, softneck.read_recording(recording)]).save("python.npz")
    same_file(Path("cli.npz"), Path("python.npz"))


def test_observer_controller_fmu_and_fits_are_the_same(call: Call, recording: Path, rls_file: Path) -> None:
    call("observer", rls_file, "-o", "observer.npz")
    softneck.observer(rls_file).save("observer_too.npz")
    same_file(Path("observer.npz"), Path("observer_too.npz"))
    call("design", "pi", rls_file, "-o", "pi.npz")
    softneck.design_controller("pi", rls_file).save("pi_too.npz")
    same_file(Path("pi.npz"), Path("pi_too.npz"))
    call("fmu", rls_file, "-o", "Rls.fmu")
    first = Path("Rls.fmu").read_bytes()
    assert softneck.build_fmu(softneck.load(rls_file), "Rls.fmu", force=True).read_bytes() == first
    judged = json.loads(call("validate", rls_file, "--data", recording, "--json").out)["models"][0]
    assert judged["fits"]["model"] == softneck.validate(rls_file, recording).fits


@pytest.mark.slow
def test_family_is_the_same(call: Call) -> None:
    write_recording("long.csv", neck_recording(2400))
    assert call("family", "long.csv", "-o", "cli.npz", "--draws", "0").code == 0
    softneck.family("long.csv").save("python.npz")
    same_file(Path("cli.npz"), Path("python.npz"))
