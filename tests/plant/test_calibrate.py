"""A neck calibrated to recordings follows what it was not fitted to; one that does not is not written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.cli._main import run
from softneck.core import DataError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.plant._calibration import _Run, calibrate
from softneck.signals import Recording, read_recording, signal, write_recording
from softneck.signals.recording._conditions import conditions

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
def test_the_command_writes_a_neck_that_loads_and_refuses_one_that_does_not_follow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = recorded()
    write_recording(tmp_path / "good.csv", good)
    neck = tmp_path / "neck.toml"
    assert run(["calibrate", str(tmp_path / "good.csv"), "-o", str(neck), "--evaluations", "5"]) == 0
    again = NeckParameters.preset(str(neck))
    assert (_Run.of(good, 0.0).fits(again) > 85.0).all()
    assert run(["calibrate", str(tmp_path / "good.csv"), "-o", str(neck)]) == 2
    # A recording that no neck answers so: its roll is noise.
    noise = 0.1 * np.random.default_rng(0).standard_normal(len(good))
    write_recording(tmp_path / "bad.csv", good.with_channels(roll=noise))
    capsys.readouterr()
    assert run(["calibrate", str(tmp_path / "bad.csv"), "-o", str(tmp_path / "bad.toml"), "--evaluations", "1"]) == 1
    assert "less than 85: not written" in capsys.readouterr().err
    assert not (tmp_path / "bad.toml").exists()


@pytest.mark.slow
def test_the_command_takes_a_grey_box_and_the_payload_that_a_recording_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    golden, neck = Path(__file__).parents[1] / "golden" / "greybox.npz", tmp_path / "neck.toml"
    assert run(["calibrate", str(golden), "-o", str(neck), "--evaluations", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["worst"] == min(fit for pair in told["fits"] for fit in pair) >= 85.0
    assert NeckParameters.preset(str(neck)) != NeckParameters.preset(told["start"])
    assert run(["calibrate", str(golden.with_name("oe.npz")), "-o", str(tmp_path / "no.toml")]) == 2
    assert "is of kind oe; a neck is calibrated to recordings or to a `greybox`" in capsys.readouterr().err
    assert conditions(recorded(0.5))["payload_kg"] == [0.5, 0.5]
    write_recording(tmp_path / "half.csv", recorded(0.5))
    assert conditions(read_recording(tmp_path / "half.csv"))["payload_kg"] == [0.5, 0.5]
    assert conditions(recorded())["payload_kg"] == [0.0, 0.0]
