"""`softneck observer`: forms, noise from data, and one line for what cannot be."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import load
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import Recording, signal, write_recording

from .conftest import Call


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A linear model and a recording of the virtual neck with its gyro."""
    folder = tmp_path_factory.mktemp("observer")
    recording = record(signal("eq22", duration=20.0), VirtualNeck(NeckParameters.paper()), seed=5)
    Rls().fit([recording]).save(folder / "rls.npz")
    write_recording(folder / "rec.csv", recording)
    return folder / "rls.npz", folder / "rec.csv"


def test_the_noise_of_a_robot_that_gives_none_is_that_of_its_recording(call: Call) -> None:
    tank = Robot.from_dict({
        "name": "tank", "motors": {"names": ["pump"], "unit": "V", "setpoint_min": 0.0, "setpoint_max": 5.0},
        "outputs": {"names": ["level"], "unit": "mm"}, "directions": {"kind": "identified"},
    })  # fmt: skip
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.0, 5.0, 60), 25)
    level = 1e-3 * (20.0 * np.asarray(lfilter([0.0, 0.1], [1.0, -0.9], u)) + 0.3 * rng.standard_normal(u.size))
    time, channels = 0.02 * np.arange(u.size), {"motor_setpoint_1": u, "level": level}
    write_recording("rec.csv", Recording(time, 0.02, channels, robot=tank))
    assert call("identify", "rls", "rec.csv", "-o", "rls.npz").code == 0
    assert "gives no `sensor.noise_std`" in call("observer", "rls.npz", "-o", "o.npz").err
    said = call("observer", "rls.npz", "-o", "o.npz", "--data", "rec.csv")
    assert said.code == 0, said.err
    found = re.search(r"starts from a sensor noise of ([\d.]+) mm, white noise of the recordings", said.out)
    assert found is not None
    # The median of 1,500 differences, of which 60 are jerks.
    assert float(found[1]) == pytest.approx(0.3, rel=0.1)
    assert load("o.npz").noise[0] == pytest.approx(3e-4, rel=0.1)


def test_every_form_becomes_a_file(call: Call, files: tuple[Path, Path]) -> None:
    for name, arguments in (
        ("model", ()),
        ("gyro", ("--set", "form=gyro", "--set", "sample_time=0.01")),
    ):
        said = call("observer", files[0], "-o", f"{name}.npz", *arguments, "--json")
        assert said.code == 0, said.err
        assert json.loads(said.out)["form"] == name
        assert load(f"{name}.npz", role="observer").form == name


@pytest.mark.slow
def test_noise_from_data_finds_that_of_the_sensor_by_its_gyro(call: Call, files: tuple[Path, Path]) -> None:
    said = call("observer", files[0], "-o", "g.npz", "--set", "form=gyro", "--data", files[1], "--json")
    assert said.code == 0, said.err
    told = json.loads(said.out)
    # The paper preset has 0.05 deg; 650 pairs know it to 3 %, and what the gyro misses of the motion takes some.
    assert told["noise"]["measurement_noise_std"] == pytest.approx(0.05 * 3.14159265 / 180.0, rel=0.25)
    # The first 70 % of 1,000 rows, less the 50 in which the filter settles; the rest judges, and speaks for them.
    assert told["fit"]["rows"] > 600
    assert told["fit"]["kept"]


@pytest.mark.slow
def test_nothing_is_kept_that_rows_held_out_do_not_speak_for(call: Call) -> None:
    recording = record(signal("eq22", duration=60.0), VirtualNeck(NeckParameters.paper()), seed=5)
    Rls().fit([recording.split(0.7)[0]]).save("rls.npz")
    write_recording("rec.csv", recording)
    assert call("observer", "rls.npz", "-o", "default.npz").code == 0
    said = call("observer", "rls.npz", "-o", "o.npz", "--data", "rec.csv")
    assert said.code == 0, said.err
    # Whichever it takes, none that it tried is better on the rows held out.
    found = json.loads(call("observer", "rls.npz", "-o", "j.npz", "--data", "rec.csv", "--json").out)["fit"]
    assert found["held_out"][found["what"]] == min(found["held_out"].values())
    if not found["kept"]:
        assert "no better, so the defaults are kept" in said.out
        assert load("o.npz").noise == load("default.npz").noise


@pytest.mark.slow
def test_a_named_sensor_keeps_its_noise(call: Call, files: tuple[Path, Path]) -> None:
    said = call("observer", files[0], "-o", "o.npz", "--set", "sensor=mpu9250", "--data", files[1])
    assert said.code == 0, said.err
    assert "measurement 0.29 deg" in said.out
    assert "NIS:" in said.out
    assert "log likelihood of each" in said.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--set", "sample_time=0.03"), "must divide that of the model"),
        (("--set", "measurement_noise_std=-1"), "must be positive"),
        (("--data", "none.csv"), "none.csv"),
        (("--data", "REC", "--set", "sample_time=0.01"), "sample time"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    call: Call, files: tuple[Path, Path], arguments: tuple[str, ...], message: str
) -> None:
    said = call("observer", files[0], "-o", "o.npz", *(files[1] if part == "REC" else part for part in arguments))
    assert said.code == 2
    assert message in said.error
    assert not Path("o.npz").exists()
