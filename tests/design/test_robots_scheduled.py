"""Gain scheduling over the inclination of other robots than the neck: one or two angles."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck import load
from softneck.core import SettingsError
from softneck.cosim.parts._free_run import drive_fmu
from softneck.design import PiSettings, ScheduledSettings
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.identification import Family, FamilySettings
from softneck.robot import Robot
from softneck.runtime import load_runtime
from softneck.signals import Recording, signal

from ..data import slow_but
from .test_robots import BELLOWS, DELAY, POLE, TS, closed, plant

NAMES = ["antagonist", "trunk4"]
WEAK = ScheduledSettings(inclinations=(0.0, 0.3))


def bent(name: str, *, duration: float = 60.0) -> Recording:
    """Angles whose gain falls with the inclination, by 0.15 rad/rad for each radian."""
    robot = Robot.preset(name)
    P = signal("aprbs", duration=duration, robot=robot, seed=4).set_points.copy()
    P[:15] = 0.0
    U = P @ np.asarray(robot.weights()).T
    Y = np.zeros((len(P), U.shape[1]))
    for k in range(len(P) - 1):
        tilt = math.atan(float(np.linalg.norm(np.tan(Y[k]))))
        Y[k + 1] = POLE * Y[k] + (1.0 - POLE) * (0.1 - 0.15 * tilt) * U[max(k - DELAY, 0)]
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*P.T, *Y.T), strict=True))
    return Recording(np.arange(len(P)) * TS, TS, channels, robot=robot)


@pytest.mark.parametrize("name", slow_but(NAMES, ["antagonist"]))
def test_gains_are_those_of_the_inclination(name: str, tmp_path: Path) -> None:
    """Designed at two inclinations for gains of 0.08 and 0.04: the loop at each is that of its own model."""
    robot = Robot.preset(name)
    models = [plant(robot, gain=gain) for gain in (0.08, 0.04)]
    WEAK.design(models).save(tmp_path / "c.npz")
    controller = load(tmp_path / "c.npz")
    assert controller.robot.hash == robot.hash
    assert controller.design["inclinations_deg"] == pytest.approx([0.0, math.degrees(0.3)])
    one, other = ([axis["gain"] for axis in point] for point in controller.design["gains"])
    np.testing.assert_allclose(other, 2.0 * np.array(one), rtol=1e-6)
    block = controller.block()
    runtime = load_runtime(block.runtime, compiled=False)
    m, n = len(robot.outputs.names), len(robot.motors.names)
    state = block.initial_state()
    # An error of 0.01 rad moves the motors twice as far where the plant is half as strong.
    moved = []
    for angle in (0.0, 0.3):
        values, out = state.values.copy(), np.zeros(n)
        for error in (0.0, -0.01):
            y = [angle + error, *[0.0] * (m - 1)]
            given = np.array([angle, *[0.0] * (m - 1), 0.0, *y, *out, 1.0, 1.0])
            before = out.copy()
            runtime.step(block.arrays, state.parameters, values, given, out)
        moved.append(float(np.abs(out - before).max()))
    # The inclination that is seen lags, and its lag starts from where it is.
    assert moved[1] == pytest.approx(2.0 * moved[0], rel=0.1)


@pytest.mark.slow
@pytest.mark.nightly
def test_an_antagonist_follows_at_all_inclinations() -> None:
    robot = Robot.preset("antagonist")
    models = [plant(robot, gain=gain) for gain in (0.08, 0.05)]
    controller = WEAK.design(models)
    assert "set-points -6 to 6 rad, slew 15.6 rad/s" in controller.summary()
    result: Any = closed(models[0], controller, pitch_deg=4.0)
    assert float(result.metrics["pitch"]["overshoot_pct"] or 0.0) < 5.0
    assert result.metrics["pitch"]["steady_rms_deg"] < 0.02


def test_times_are_stretched_by_the_slowest_pole() -> None:
    slow = [replace(plant(Robot.preset("antagonist"), gain=gain), sample_time=4.0) for gain in (0.08, 0.04)]
    found = WEAK.design(slow).design["settings"]
    stretch = -4.0 / math.log(POLE) / 0.2
    for name, seconds in (("schedule_time", 0.3), ("reference_time", 0.06), ("leak_time", 3.0)):
        assert found[name] == pytest.approx(stretch * seconds)
    assert WEAK.design([plant(Robot.preset("trunk4"))] * 2).limits.lead_limit == 12.0


@pytest.mark.parametrize("name", slow_but(NAMES, [], nightly=NAMES))
def test_a_family_with_knots_over_the_inclination_is_scheduled(name: str, tmp_path: Path) -> None:
    recording = bent(name)
    FamilySettings(directions=1, lpv_knots=3).fit(recording).save(tmp_path / "f.npz")
    family = load(tmp_path / "f.npz")
    assert isinstance(family, Family)
    assert family.lpv is not None
    fits = family.findings["free_run_fit"]
    # It contains the truth but for the knots; one gain for all inclinations does not.
    assert min(fits["lpv"]) > 95.0
    assert max(fits["invariant"]) < min(fits["lpv"])
    assert (np.diff(family.lpv.gains, axis=1) < 0).all()
    np.testing.assert_array_equal(family.lpv.simulate(recording).shape, recording.outputs.shape)
    controller = ScheduledSettings().design(family)
    np.testing.assert_allclose(controller.design["inclinations_deg"], np.degrees(family.lpv.knots))
    with pytest.raises(SettingsError, match="knows no inclinations: make it with `--set lpv_knots=3`"):
        ScheduledSettings().design(replace(family, lpv=None))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("backend", ["python", "compiled"])
def test_its_fmu_does_the_same(name: str, backend: str, tmp_path: Path) -> None:
    robot = Robot.preset(name)
    block = WEAK.design([plant(robot, gain=gain) for gain in (0.08, 0.04)]).block()
    build: Any = build_fmu if backend == "python" else partial(build_compiled_fmu, fmi=3)
    build(block, tmp_path / "Scheduled.fmu")
    rng, rows = np.random.default_rng(1), 60
    inputs = {port.name: np.full(rows, port.start) for port in block.inputs} | {"pitch_reference": np.full(rows, 0.2)}
    inputs |= {name: 0.1 * rng.standard_normal(rows) for name in robot.outputs.names}
    inputs |= {name: 0.1 * rng.standard_normal(rows) for name in robot.motor_positions}
    found = drive_fmu(tmp_path / "Scheduled.fmu", inputs, parameters={"use_motor_positions": 1.0})
    state, expected = block.initial_state(), []
    for k in range(rows):
        state, motors = block.step(state, [inputs[port.name][k] for port in block.inputs])
        expected.append(motors)
    # A controller answers at once; the same operations, compiled by another compiler.
    np.testing.assert_allclose(found[:-1], np.array(expected)[:-1], rtol=1e-9, atol=1e-12)


def test_lengths_have_no_inclination() -> None:
    with pytest.raises(SettingsError, match=r"for robots with one or two angles; robot `bellows` .* has x, y, z in mm"):
        WEAK.design([plant(BELLOWS)] * 2)
    assert PiSettings(slew_limit=3.0).design(plant(BELLOWS)).robot.hash == BELLOWS.hash
