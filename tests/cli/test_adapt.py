"""`softneck identify --from`: files, JSON, one line for what cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.core import load
from softneck.design import PiSettings
from softneck.identification import OutputError, Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import read_recording, signal, write_recording

from .conftest import Call


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A linear model of the virtual neck, motion of it under a payload, and a neck that stands."""
    made, neck = tmp_path_factory.mktemp("adapt"), VirtualNeck(NeckParameters.paper())
    model = OutputError().fit(record(signal("eq22", duration=30.0), neck, seed=1))
    model.save(made / "oe.npz")
    Rls().fit(record(signal("eq22", duration=10.0), neck, seed=1)).save(made / "rls.npz")
    PiSettings().design(model).save(made / "pi.npz")
    loaded = record(signal("rotation"), neck, seed=5, payload=1.0)
    write_recording(made / "today.csv", loaded)
    still = {name: np.full(500, 0.5) for name in loaded.robot.set_points}
    write_recording(made / "still.csv", loaded.rows(0, 500).with_channels(**still))
    return made


def test_the_model_that_is_written_is_that_of_python(call: Call, folder: Path) -> None:
    said = call("identify", "oe", folder / "today.csv", "--from", folder / "oe.npz", "-o", "new.npz", "--json")
    assert said.code == 0, said.err
    told = json.loads(said.out)
    assert told["adapted"]
    assert told["fit_after"][0] >= told["fit_before"][0]
    expected = load(folder / "oe.npz").adapt(read_recording(folder / "today.csv"))
    for name, array in load("new.npz").arrays.items():
        np.testing.assert_array_equal(array, expected.arrays[name])


def test_a_model_that_is_kept_is_said_to_be(call: Call, folder: Path) -> None:
    said = call("identify", "oe", folder / "still.csv", "--from", folder / "oe.npz", "-o", "new.npz")
    assert said.code == 0, said.err
    assert "the old model, kept: the window hardly moves the neck" in said.out
    for name, array in load("new.npz").arrays.items():
        np.testing.assert_array_equal(array, load(folder / "oe.npz").arrays[name])


def test_what_cannot_be_adapted_is_one_line_and_no_file(call: Call, folder: Path) -> None:
    said = call("identify", "rls", folder / "today.csv", "--from", folder / "rls.npz", "-o", "new.npz")
    assert said.code == 2
    assert "`rls` cannot adapt" in said.error
    assert (
        call(
            "identify", "oe", folder / "today.csv", "--from", folder / "oe.npz", "-o", "new.npz", "--set", "window=0"
        ).code
        == 2
    )
    of_another_kind = call("identify", "rls", folder / "today.csv", "--from", folder / "oe.npz", "-o", "new.npz")
    assert (of_another_kind.code, "is of kind oe, not rls" in of_another_kind.error) == (2, True)
    assert call("identify", "pi", folder / "today.csv", "--from", folder / "pi.npz", "-o", "new.npz").code == 2
    assert not Path("new.npz").exists()
