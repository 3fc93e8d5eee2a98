"""What a run looks at before its first step, and what it proposes of a sensor."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from softneck.cli.start import _possible, _start
from softneck.cli.start._possible import propose_missing
from softneck.core import OutputFileError
from softneck.fmu.compiled import _library
from softneck.robot import Robot
from softneck.signals import Recording
from softneck.signals.importing._layout import doubts_in

from ..conftest import Call

ROBOT = """# An arm.
name = "arm of three"
sample_time_s = 0.05
[motors]
names = ["pressure"]
unit = "bar"
[outputs]
names = ["x"]
unit = "mm"
[directions]
kind = "identified"
"""
NOISE = 0.05  # mm


def recorded(file: Path) -> Recording:
    """Steps through a lag, with white noise of 0.05 mm."""
    rng = np.random.default_rng(0)
    time = 0.05 * np.arange(2000)
    channels = {"motor_setpoint_1": 1e5 * np.sin(time), "x": 1e-3 * (np.sin(time) + NOISE * rng.standard_normal(2000))}
    return Recording(time, 0.05, channels, np.zeros(2000, dtype=int), Robot.read(file))


@pytest.mark.parametrize("said", ["", "\n[sensor]\ndelay_s = 0.1\n", "\n[sensor]\ndelay_s = 0.1\n[plant]\n",
                                  "\nsensor.delay_s = 0.1\n"])  # fmt: skip
def test_what_a_file_does_not_say_of_the_sensor_is_proposed_and_marked(tmp_path: Path, said: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(said + ROBOT if said.startswith("\nsensor.") else ROBOT + said, encoding="utf-8")
    keys = propose_missing(file, [recorded(file)], motors=False)
    assert keys == [key for key in ("noise_std", "delay_s", "rate_hz") if key not in said]
    robot = Robot.read(file)
    # The median of 2,000 fourth differences: 3 % is two of its standard errors.
    assert robot.noise_std == pytest.approx(NOISE, rel=0.06)
    assert (robot.delay_s, robot.rate_hz) == (0.1 if said else 0.0, 20.0)
    if not said.startswith("\nsensor."):  # rewritten, without remarks
        assert len(doubts_in(file)) == len(keys)
        assert "# An arm." in file.read_text(encoding="utf-8")
    before = file.read_text(encoding="utf-8")
    assert propose_missing(file, [recorded(file)], motors=False) == []
    assert file.read_text(encoding="utf-8") == before


def test_a_sensor_without_noise_is_as_uncertain_as_its_steps(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(ROBOT, encoding="utf-8")
    clean = recorded(file)
    channels = {**clean.channels, "x": 1e-4 * np.round(10.0 * np.sin(clean.time))}
    propose_missing(file, [Recording(clean.time, 0.05, channels, clean.run, clean.robot)], motors=False)
    noise = Robot.read(file).noise_std
    assert noise is not None
    assert noise >= 0.1 / math.sqrt(12.0) * 0.99  # steps of 0.1 mm; three digits are written


def test_without_a_compiler_and_without_pytest_it_goes_on_and_says_so(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_library, "local_compiler", lambda: None)
    monkeypatch.setattr(_library, "packaged_library", lambda *_: None)
    monkeypatch.setattr(_library, "have_zig", lambda: False)
    monkeypatch.setattr(_start, "has_pytest", lambda: False)
    asked = []

    def plan(given):
        asked.append(given)
        yield from ()

    monkeypatch.setattr(_start, "steps", plan)
    said = call("start", short, "-o", "p", "--yes")
    assert said.code == 0, said.err
    assert (asked[0].backend, asked[0].tested) == ("python", False)
    assert "no C compiler was found: the FMUs are written with the Python backend" in said.err
    assert "pytest" not in said.err  # where the input is bad, its absence is not the first line
    assert "not run: pytest is not installed" in said.out


def test_a_disk_that_is_nearly_full_is_said_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 12_000_000})
    monkeypatch.setattr(_possible.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(OutputFileError, match="only 12 MB are free there, a project takes up to 50 MB"):
        _possible.require_disk(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("second", "least", "most"), [(1.05, 0.0, 105.0), (1.5, [0.0, 0.0], [100.0, 150.0])])
def test_each_motor_has_the_range_that_it_was_recorded_in(second: float, least: object, most: object) -> None:
    """One range where they differ by less than a tenth of it: a chamber of 1 bar is not sent to 1.5 bar."""
    robot = Robot.from_dict({
        "name": "arm", "motors": {"names": ["a", "b"], "unit": "kPa"}, "outputs": {"names": ["x"], "unit": "mm"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    u = np.linspace(0.0, 1e5, 200)[:, None] * [1.0, second]
    limits = _possible._limits(robot, [Recording.from_arrays(u, u[:, :1], sample_time=0.02, robot=robot)])
    assert (limits["setpoint_min"][0], limits["setpoint_max"][0]) == (least, most)
