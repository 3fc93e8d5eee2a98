"""The front door takes a path wherever it takes what the file holds: the same bits come out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import softneck
from softneck.core import FileFormatError
from softneck.identification import Model
from softneck.signals import Recording, write_recording
from softneck.verification import make_requirements

from .necks import QUICK, family, pi


@pytest.fixture
def rec(tmp_path: Path, neck: Recording) -> Path:
    write_recording(tmp_path / "rec.csv", neck)
    return tmp_path / "rec.csv"


def test_a_recording_s_path_is_identified_and_judged_as_the_recording(rec: Path, models: dict[str, Model]) -> None:
    read = softneck.read_recording(rec)
    ours, theirs = (softneck.identify("rls", given, train=1.0, delay=0.06) for given in (read, str(rec)))
    assert all(np.array_equal(ours.arrays[name], theirs.arrays[name]) for name in ours.arrays)
    models["rls"].save(rec.with_suffix(".npz"))
    found = softneck.validate(rec.with_suffix(".npz"), rec)
    assert found.fits == softneck.validate(softneck.load(rec.with_suffix(".npz")), read).fits
    # A report names the files.
    assert (found.model, found.data) == (str(rec.with_suffix(".npz")), str(rec))


def test_a_plant_s_path_is_designed_on_and_verified_as_the_plant(tmp_path: Path) -> None:
    plant, controller = tmp_path / "family.npz", tmp_path / "pi.npz"
    family().save(plant)
    pi().save(controller)
    held = softneck.load(plant)
    one, several = (softneck.design_controller("pi", given) for given in (plant, [str(plant), held]))
    assert one.summary() == softneck.design_controller("pi", held).summary()
    assert several.summary() == softneck.design_controller("pi", [held, held]).summary()
    few = make_requirements({key: QUICK[key] for key in ("sampling", "sim")})
    rows = [
        [(v.requirement.metric, v.value) for v in softneck.verify(c, plants, few).verdicts]
        for c, plants in ((controller, str(plant)), (softneck.load(controller), held), (controller, {"plant": plant}))
    ]
    # Equal, and where nothing was computed None: no NaN is among them.
    assert rows[0] == rows[1] == rows[2]


def test_a_path_to_another_thing_says_what_it_is(tmp_path: Path, rec: Path) -> None:
    family().save(tmp_path / "family.npz")
    with pytest.raises(FileFormatError, match=r"family\.npz: is a family \(family\), not a model"):
        softneck.validate(tmp_path / "family.npz", rec)
    with pytest.raises(FileFormatError, match=r"family\.npz: is a family \(family\), not a controller"):
        softneck.verify(tmp_path / "family.npz", family())
    with pytest.raises(FileFormatError, match=r"absent\.csv"):
        softneck.identify("rls", tmp_path / "absent.csv", train=1.0)
