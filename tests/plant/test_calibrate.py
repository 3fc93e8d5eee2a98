"""A neck calibrated to recordings follows what it was not fitted to; one that does not is not written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import softneck
from softneck.core import CheckFailedError, DataError, OutputFileError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.plant._calibration import _Run, calibrate
from softneck.signals import Recording, read_recording, signal, write_recording
from softneck.signals.recording._recording import conditions

TRUE = NeckParameters.paper().replace(bending_stiffness=0.75, drive_latency=0.03, pretension=2.5)


def recorded(payload: float = 0.0) -> Recording:
    return record(signal("eq22", duration=12.0), VirtualNeck(TRUE.without_noise()), seed=1, payload=payload)


def test_the_true_neck_follows_its_own_recording() -> None:
    part = _Run.of(recorded(0.5), 0.5)
    # The recording began at rest and was ramped in; three seconds at its first set-points forget that to a percent.
    assert (part.fits(TRUE) > 98.0).all()
    assert (_Run.of(recorded(0.5), 0.0).fits(TRUE) < part.fits(TRUE)).all()


@pytest.mark.slow
def test_numbers_that_are_wrong_are_found_and_what_is_known_stays() -> None:
    first = _Run.of(recorded(), 0.0).fits(NeckParameters.paper())
    found = calibrate([recorded()], [0.0], known={"winch_radius": 0.0075}, evaluations=4)
    assert found.start == "paper"
    assert found.worst > 95.0 > first.min()
    assert found.neck.winch_radius == 0.0075
    assert "winch_radius" not in found.fitted
    assert NeckParameters.paper().link_length == found.neck.link_length


def test_payloads_must_be_one_for_each() -> None:
    with pytest.raises(DataError, match="2 recordings and 1 payloads"):
        calibrate([recorded(), recorded()], [0.0])


@pytest.mark.slow
def test_a_neck_is_written_that_loads_and_none_that_does_not_follow(tmp_path: Path) -> None:
    good = recorded()
    write_recording(tmp_path / "good.csv", good)
    neck = tmp_path / "neck.toml"
    found = softneck.calibrate(tmp_path / "good.csv", evaluations=5)
    found.save(neck)
    again = NeckParameters.preset(str(neck))
    assert (_Run.of(good, 0.0).fits(again) > 85.0).all()
    with pytest.raises(OutputFileError, match="exists already"):
        found.save(neck)
    # A recording that no neck answers so: its roll is noise.
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(good))
    bad = softneck.calibrate(good.with_channels(roll=noise), evaluations=1)
    with pytest.raises(CheckFailedError, match="less than 85: not written"):
        bad.save(tmp_path / "bad.toml")
    assert not (tmp_path / "bad.toml").exists()


@pytest.mark.slow
def test_a_grey_box_is_taken_and_the_payload_that_a_recording_says(tmp_path: Path) -> None:
    golden, neck = Path(__file__).parents[1] / "golden" / "greybox.npz", tmp_path / "neck.toml"
    found = softneck.calibrate(golden, evaluations=3)
    assert found.worst == found.fits.min() >= 85.0
    found.save(neck)
    assert NeckParameters.preset(str(neck)) != NeckParameters.preset(found.start)
    assert conditions(recorded(0.5))["payload_kg"] == [0.5, 0.5]
    write_recording(tmp_path / "half.csv", recorded(0.5))
    assert conditions(read_recording(tmp_path / "half.csv"))["payload_kg"] == [0.5, 0.5]
    assert conditions(recorded())["payload_kg"] == [0.0, 0.0]


def test_a_model_of_another_kind_is_refused() -> None:
    with pytest.raises(DataError, match="is of kind oe; a neck is calibrated to recordings or to a `greybox`"):
        softneck.calibrate(Path(__file__).parents[1] / "golden" / "oe.npz")
