"""Channels and ports have the names of the robot's motors; numbers, as older files have them, are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

import softneck
from softneck import build_fmu
from softneck.cosim import load_loop, make_loop, simulate
from softneck.design import design_controller
from softneck.robot import Robot
from softneck.robot._channels import motor_channels
from softneck.runtime import Block, Port
from softneck.signals import Recording, read_recording, write_recording
from tests.design.test_robots import plant

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

FINGER = Robot.from_dict({
    "name": "finger", "sample_time_s": 0.02,
    "motors": {"names": ["pressure"], "unit": "kPa", "setpoint_min": 0.0, "setpoint_max": 150.0, "rate_limit": 2000.0},
    "outputs": {"names": ["flexion"], "unit": "deg", "min": -5.0, "max": 70.0},
    "directions": {"kind": "matrix", "matrix": [[1.0]]},
})  # fmt: skip
# The same robot, its motor called otherwise: files fit each other.
RENAMED = replace(FINGER, motors=replace(FINGER.motors, names=("valve",)))
OLDER = {"pressure_setpoint": "motor_setpoint_1", "pressure_position": "motor_position_1"}
GAIN = 5e-6  # rad/Pa: 29 deg at 100 kPa


def numbered(block: Block) -> Block:
    """As an older softneck made it."""
    ports: dict[str, Any] = {
        side: tuple(replace(port, name=OLDER.get(port.name, port.name)) for port in getattr(block, side))
        for side in ("inputs", "outputs")
    }
    return replace(block, **ports)


@pytest.fixture(scope="module")
def parts() -> tuple[Any, Any]:
    model = plant(FINGER, gain=GAIN)
    return model, design_controller("pi", model)


def table(plant: Any, controller: Any, robot: Robot = FINGER, **more: Any) -> dict[str, Any]:
    reference = {"kind": "step", "at_s": 0.2, "flexion_deg": 20.0}
    return {"duration_s": 1.0, "plant": plant, "controller": controller, "robot": robot, "reference": reference} | more


def test_a_loop_has_the_names_of_its_robot(parts: tuple[Any, Any], tmp_path: Path) -> None:
    model, controller = parts
    result = simulate(table(model, controller))
    sent = result["pressure_setpoint"]
    assert sent.max() > 1e4  # Pa
    assert not [name for name in result.signals.signals if "motor_" in name]
    recording = result.recording()
    write_recording(tmp_path / "r.csv", recording)
    assert "pressure_setpoint [kPa]" in (tmp_path / "r.csv").read_text(encoding="utf-8")
    np.testing.assert_allclose(
        read_recording(tmp_path / "r.csv").channels["pressure_setpoint"], recording.set_points[:, 0], rtol=1e-9
    )
    np.testing.assert_array_equal(result["motor_setpoint_1"], sent)


@pytest.mark.parametrize("robot", [FINGER, RENAMED], ids=["its own", "renamed"])
def test_parts_with_numbers_or_other_names_do_the_same(parts: tuple[Any, Any], robot: Robot) -> None:
    model, controller = parts
    expected = simulate(table(model, controller))["pressure_setpoint"]
    older = table(numbered(model.block()), numbered(controller.block()), robot)
    mixed = table(model, numbered(controller.block()), FINGER)
    linked = older | {"connections": {"plant.motor_setpoint_1": "controller.motor_setpoint_1"}}
    for loop in (older, linked, mixed):
        found = simulate(loop)
        np.testing.assert_array_equal(found[found.robot.set_points[0]], expected)


def test_files_of_one_robot_with_two_names_for_a_motor(parts: tuple[Any, Any], tmp_path: Path) -> None:
    model, controller = parts
    replace(model, robot=RENAMED).save(tmp_path / "m.npz")
    controller.save(tmp_path / "c.npz")
    (tmp_path / "loop.toml").write_text(
        'duration_s = 1.0\nplant = { model = "m.npz" }\ncontroller = { file = "c.npz" }\n'
        '[reference]\nkind = "step"\nat_s = 0.2\nflexion_deg = 20.0\n'
    )
    loop = load_loop(tmp_path / "loop.toml").loop
    assert loop.plant.inputs[0].name == loop.controller.outputs[0].name == "valve_setpoint"


def test_fmus_have_them_too(parts: tuple[Any, Any], tmp_path: Path) -> None:
    model, controller = parts
    build_fmu(model, tmp_path / "New.fmu")
    build_fmu(numbered(model.block()), tmp_path / "Old.fmu")
    names = [[v.name for v in fmpy.read_model_description(str(tmp_path / f"{name}.fmu")).modelVariables]
             for name in ("New", "Old")]  # fmt: skip
    assert [found[0] for found in names] == ["pressure_setpoint", "motor_setpoint_1"]
    assert "pressure_position_measured" in names[0]
    new, old = (make_loop(table({"fmu": str(tmp_path / f"{name}.fmu")}, controller)) for name in ("New", "Old"))
    found, other = (simulate(setup)["pressure_setpoint"] for setup in (new, old))
    np.testing.assert_array_equal(found, other)


@pytest.mark.slow
def test_linear_systems_take_both(parts: tuple[Any, Any]) -> None:
    model, _ = parts
    one, other = (model.linearize(at={name: 5e4}) for name in ("pressure_setpoint", "motor_setpoint_1"))
    np.testing.assert_array_equal(one.A, other.A)
    at = [softneck.linearize(model, at=0.1, values={n: 5e4}) for n in ("pressure_setpoint", "motor_setpoint_1")]
    np.testing.assert_array_equal(at[0].B, at[1].B)


def test_recordings_take_numbers() -> None:
    t = 0.02 * np.arange(4)
    channels = {"motor_setpoint_1": 1e3 * t, "motor_velocity_1": t, "flexion": t}
    recording = Recording(t, 0.02, channels, robot=FINGER)
    assert set(recording.channels) == {"pressure_setpoint", "pressure_velocity", "flexion"}
    again = recording.with_channels(motor_setpoint_1=2e3 * t)
    np.testing.assert_array_equal(again.set_points[:, 0], 2e3 * t)


def test_a_name_that_is_taken_falls_back_to_the_number() -> None:
    assert motor_channels(("motor_1", "left"), ("x",), "setpoint") == ("motor_setpoint_1", "left_setpoint")
    assert motor_channels(("motor_2", "motor_1"), ("x",), "position") == ("motor_2_position", "motor_1_position")
    assert motor_channels(("a", "a_setpoint"), ("x",), "setpoint") == ("motor_setpoint_1", "motor_setpoint_2")
    assert motor_channels(("stage",), ("stage_position",), "position") == ("motor_position_1",)
    assert motor_channels(("stage",), ("stage_position",), "position_measured") == ("motor_position_measured_1",)
    assert Port(name=Robot.preset().set_points[2]).name == "motor_setpoint_3"
