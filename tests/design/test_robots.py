"""Controllers of other robots than the neck: loops that close, limits of their files, units, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck import identify, load, record
from softneck.core import DataError, SettingsError
from softneck.cosim import make_loop, simulate
from softneck.cosim.loops._loop_table import check_key
from softneck.design import PiSettings, design_controller
from softneck.design.plants._uncertain import uncertain_plant
from softneck.design.predictive._plant import scaled_plant
from softneck.design.predictive._settings import MpcNumbers
from softneck.identification import Model
from softneck.identification.models._linear_systems import lss_arrays
from softneck.loop._faults import make_fault
from softneck.loop._references import AheadReference, make_reference
from softneck.plant import VirtualNeck
from softneck.robot import Robot
from softneck.signals import signal

TS, POLE, DELAY = 0.02, 0.9, 3
# Three lengths that four chambers move; nobody told their directions, and they are 50 mm long at rest.
BELLOWS = Robot.from_dict({
    "name": "bellows",
    "motors": {"names": ["a", "b", "c", "d"], "unit": "bar", "setpoint_min": 0, "setpoint_max": 3, "rate_limit": 20},
    "outputs": {"names": ["x", "y", "z"], "unit": "mm", "min": 40, "max": 60},
    "directions": {"kind": "identified"},
})  # fmt: skip
SLOW = replace(BELLOWS, motors=replace(BELLOWS.motors, rate_limit=(10.0,) * 4))
LEARNED = np.array([[0.8, -0.6, 0.0, 0.0], [0.0, 0.6, 0.8, 0.0], [0.5, 0.5, 0.5, 0.5]])
KINDS = ("pi", "pid", "fopi", "hinf", "lqg")


def plant(robot: Robot, *, gain: float = 0.08, rest: float = 0.0) -> Model:
    """Each output a lag behind its direction, as `oe` finds it."""
    given = robot.weights()
    W = LEARNED if given is None else given
    m = len(W)
    system = (POLE * np.eye(m), (1.0 - POLE) * gain * W, np.eye(m), 0.1 * np.eye(m))
    drive = np.zeros((W.shape[1], 2))
    entry = {"a": [-POLE], "b": [(1.0 - POLE) * gain], "delay": DELAY}
    return Model(
        kind="oe",
        sample_time=TS,
        arrays={**lss_arrays(system, delay=DELAY, drive=drive), "offset": np.full(m, rest)},
        findings={"transfer_functions": dict.fromkeys(robot.outputs.names, entry), "directions": W.tolist()},
        robot=robot,
    )


def closed(model: Model, controller: Any, *, duration: float = 4.0, **reference: Any) -> Any:
    return simulate({
        "duration_s": duration, "plant": model, "controller": controller,
        "reference": {"kind": "step", "at_s": 0.5, **reference},
    })  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_linear_kind_is_designed_for_other_robots(kind: str, tmp_path: Path) -> None:
    """The margins asked for hold on the loop itself, whatever the units: gains scale, times stay."""
    few, many = (plant(Robot.preset("antagonist"), gain=gain) for gain in (0.08, 8e-6))
    one, other = design_controller(kind, few), design_controller(kind, many)
    K, scaled = (one.ss(), other.ss())
    z = np.exp(1j * np.geomspace(0.5, 100.0, 30) * TS)
    if kind != "pid":  # whose simplex ends elsewhere from another start, within the same bounds
        # Bisections end within 3 % of the same speed.
        np.testing.assert_allclose(1e-4 * scaled(z)[0], K(z)[0], rtol=0.05)
    for found in (one, other):
        assert found.design["pitch"]["margins"]["sensitivity"] < 2.01
        assert found.design["pitch"].get("samples_unstable", 0) == 0
    assert list(K.input_labels) == ["pitch_reference", "pitch"]
    assert list(K.output_labels) == ["pitch_input"]
    one.save(tmp_path / "c.npz")
    again = load(tmp_path / "c.npz")
    assert again.robot.hash == one.robot.hash
    assert [port.name for port in again.block().outputs] == ["motor_setpoint_1", "motor_setpoint_2"]
    for a, b in zip(one.arrays, again.arrays, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("plain_steps_of_blocks")
def test_an_antagonist_follows_a_step_and_its_tendons_share_the_pull() -> None:
    model = plant(Robot.preset("antagonist"))
    result = closed(model, design_controller("pi", model), pitch_deg=6.0, cocontraction_rad=0.3)
    found = result.metrics
    assert set(found) == {"pitch", "motors", "validity"}
    assert found["pitch"]["overshoot_pct"] < 2.0
    assert found["pitch"]["settling_s"] < 1.0
    P = np.column_stack([result[f"motor_setpoint_{j}"] for j in (1, 2)])
    # 6 deg by a gain of 0.08 rad/rad of P1 - P2, around the co-contraction asked for.
    tilt = math.radians(6.0) / 0.08
    np.testing.assert_allclose(P[-1], [0.3 + tilt / 2.0, 0.3 - tilt / 2.0], rtol=1e-3)
    recording = result.recording()
    assert recording.robot.hash == model.robot.hash
    assert recording.set_points.shape[1] == 2


def test_a_reference_is_known_ahead_by_the_outputs_of_its_robot() -> None:
    model = plant(Robot.preset("antagonist"))
    result = closed(model, design_controller("pi", model), duration=1.0, pitch_deg=6.0, ahead_s=0.3)
    known = np.degrees(result["pitch_reference_ahead"])
    # The step at 0.5 s, fifteen samples earlier.
    np.testing.assert_allclose(known[:-15], np.degrees(result["pitch_reference"])[15:], atol=1e-12)
    assert (known[9], known[10]) == pytest.approx((0.0, 6.0))
    assert "roll_reference_ahead" not in result.signals.signals
    told = make_reference("ramp", {"x": 41.0, "z_mm": 45.0, "rise_s": 1.0}, BELLOWS)
    part = AheadReference(told, 0.5, robot=BELLOWS)
    names = [port.name for port in part.outputs]
    assert names[:5] == ["x_reference", "y_reference", "z_reference", "cocontraction_reference", "enabled"]
    assert [(port.name, port.unit) for port in part.outputs[5:]] == [(f"{n}_reference_ahead", "m") for n in "xyz"]
    assert part.start(0.25, {}).tolist() == pytest.approx(
        [0.25 * 0.041, 0.0, 0.25 * 0.045, 0.0, 1.0, 0.75 * 0.041, 0.0, 0.75 * 0.045]
    )


@pytest.mark.slow
def test_three_lengths_of_four_chambers_in_bar_and_mm() -> None:
    model = plant(BELLOWS, gain=1e-7, rest=0.03)
    controller = design_controller("pi", model, robot=SLOW)
    assert "set-points 0 to 3 bar, slew 10 bar/s" in controller.summary()
    result = closed(model, controller, duration=6.0, x=41.0, y_mm=43.0, z=49.0, at_s=0.0, cocontraction=1.0)
    for name in ("x", "y", "z"):
        assert result.metrics[name]["steady_rms_mm"] < 0.01
    P = np.column_stack([result[f"motor_setpoint_{j}"] for j in range(1, 5)])
    assert P.min() >= 0.0
    assert P.max() <= 3e5
    assert np.abs(np.diff(P, axis=0)).max() <= 1e6 * TS * (1.0 + 1e-9)
    assert result.metrics["motors"]["max_bar"] == pytest.approx(P.max() / 1e5)


def test_limits_come_from_the_robot_file_and_what_is_missing_is_asked_for() -> None:
    table = Robot.preset("antagonist").as_dict()
    del table["motors"]["rate_limit"]
    model = plant(Robot.from_dict(table))
    with pytest.raises(
        SettingsError, match=r"robot `antagonist` .* gives no `motors.rate_limit`.* add it to its robot"
    ):
        PiSettings().design(model)
    table["motors"] |= {"rate_limit": [3.0, 3.0], "setpoint_min": [-4.0, -4.0], "setpoint_max": [4.0, 4.0]}
    limits = PiSettings().design(model, robot=Robot.from_dict(table)).limits
    assert (limits.slew_limit, limits.position_limit, limits.lead_limit) == (3.0, 4.0, 8.0)
    # The neck's own numbers given on purpose are given: only its defaults say nothing of others.
    assert PiSettings(lead_limit=0.4).design(model, robot=Robot.from_dict(table)).limits.lead_limit == 0.4
    with pytest.raises(DataError, match="the plant and `robot` of two robots"):
        PiSettings().design(model, robot="finger")


def test_a_loop_is_of_one_robot() -> None:
    model, other = plant(Robot.preset("antagonist")), plant(Robot.preset("finger"))
    controller = PiSettings().design(model)
    with pytest.raises(SettingsError, match=r"\[controller\] is of robot `antagonist` .* \[plant\] of robot `finger`"):
        closed(other, controller, pitch_deg=5.0)
    # A neck's virtual plant becomes that of the loop's robot, and says so by its channels.
    loop = make_loop(
        {"duration_s": 1.0, "plant": "paper", "controller": controller, "reference": {"kind": "step"}}
    ).loop
    assert [port.name for port in loop.plant.inputs][:3] == ["motor_setpoint_1", "motor_setpoint_2", "payload"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["antagonist", "trunk4"])
def test_the_whole_way_over_the_virtual_plant(name: str) -> None:
    """Recorded, identified, designed and closed over the physics that stands for the robot."""
    robot = Robot.preset(name)
    recording = record(signal("aprbs", duration=40.0, robot=robot), VirtualNeck.of(robot), seed=1)
    controller = design_controller("pi", identify("oe", recording, train=1.0))
    result = simulate({"duration_s": 6.0, "plant": "paper", "controller": controller,
                       "reference": {"kind": "step", "at_s": 1.0, "pitch_deg": 8.0}})  # fmt: skip
    assert result.robot.hash == robot.hash
    # The gain of a line through large moves is some 20 % off for small ones.
    found = result.metrics["pitch"]
    assert float(found["overshoot_pct"] or 0.0) < 25.0
    assert found["steady_rms_deg"] == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ({"roll_deg": 3.0}, "unknown key `roll_deg` of a step reference"),
        ({"pitch_mm": 3.0}, "unknown key `pitch_mm` of a step reference"),
        ({"pitch_deg": 80.0}, r"`pitch` must be within -0.8 to 0.8 rad, the range of robot `antagonist`"),
        ({"kind": "rotation", "inclination_deg": 3.0}, 'kind = "rotation" needs two angles'),
        ({"pitch_deg": "far"}, "`pitch_deg` must be a number"),
    ],
)
def test_references_that_a_robot_cannot_follow_are_refused(reference: dict[str, Any], said: str) -> None:
    model = plant(Robot.preset("antagonist"))
    with pytest.raises(SettingsError, match=said):
        closed(model, PiSettings().design(model), **reference)


def test_keys_of_studies_and_faults_know_the_robot() -> None:
    model = plant(Robot.preset("antagonist"))
    table = {"reference": {"kind": "step"}, "duration_s": 1.0}
    check_key(table, "reference.pitch_deg", {}, model.robot)
    with pytest.raises(SettingsError, match="`roll_deg` is not part of a step reference"):
        check_key(table, "reference.roll_deg", {}, model.robot)
    with pytest.raises(SettingsError, match="`motor` must be a whole number between 0 and 2"):
        make_fault("motor_stuck", {"motor": 3}, model.robot)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"tendon_angles": (0.0, 2.0, 4.0)}, r"`tendon_angles` is the robot's: set .* in robot.toml"),
        ({"minimum_tautness": 0.1}, r"`minimum_tautness` is for tendons at known angles; `bellows` .* has none"),
        ({"angle_limit": 0.1}, r"`angle_limit` is for outputs that are angles; those of `bellows` .* are in mm"),
    ],
)
def test_what_predictive_control_has_for_tendons_and_angles_only_is_refused(setting: dict[str, Any], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        design_controller("mpc", plant(BELLOWS, gain=1e-7), **setting)


@pytest.mark.parametrize("sample_time", [TS, 4.0])
def test_a_predictive_controller_looks_as_far_as_its_robot_is_slow(sample_time: float) -> None:
    """The same rows are the same problem, however long a sample takes."""
    slow = scaled_plant(uncertain_plant(replace(plant(BELLOWS), sample_time=sample_time)))
    asked = MpcNumbers().fill_defaults(slow)
    # Three time constants of -1 / log(0.9) = 9.5 samples.
    assert (asked.horizon, asked.moves) == (28, 10)
    assert asked.reference_time == pytest.approx(-sample_time / math.log(POLE))
    given = MpcNumbers(horizon=20, moves=5).fill_defaults(slow)
    assert (given.horizon, given.moves) == (20, 5)


@pytest.mark.usefixtures("plain_steps_of_blocks")
def test_a_predictive_controller_does_the_same_in_all_units(tmp_path: Path) -> None:
    """It settles within the motors' range and rate, after a file as before, and so do gains ten thousand times less."""
    wide = Robot.from_dict({
        **Robot.preset("antagonist").as_dict(),
        "motors": {"names": ["a", "b"], "unit": "rad", "setpoint_min": -6e4, "setpoint_max": 6e4, "rate_limit": 15e4},
    })  # fmt: skip
    near = Robot.from_dict({
        **Robot.preset("antagonist").as_dict(),
        "motors": {"names": ["a", "b"], "unit": "rad", "setpoint_min": -6, "setpoint_max": 6, "rate_limit": 15},
    })  # fmt: skip
    results: list[Any] = []
    for robot, gain in ((near, 0.08), (wide, 8e-6)):
        model = plant(robot, gain=gain)
        controller = design_controller("mpc", model, bandwidth=6.0)
        controller.save(tmp_path / f"{gain}.npz")
        results.append(closed(model, load(tmp_path / f"{gain}.npz"), pitch_deg=6.0))
    few, many = results
    # The solver ends at 1e-10 of a motor's range.
    np.testing.assert_allclose(many["pitch"], few["pitch"], atol=1e-8)
    np.testing.assert_allclose(many["motor_setpoint_1"], 1e4 * few["motor_setpoint_1"], atol=1e-3)
    assert few.metrics["pitch"]["overshoot_pct"] < 2.0
    assert few.metrics["pitch"]["settling_s"] < 1.5
    assert abs(few["pitch"][-1] - math.radians(6.0)) < math.radians(0.01)
    assert np.abs(np.diff(few["motor_setpoint_1"])).max() <= 15.0 * TS * (1.0 + 1e-9)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_predictive_controller_of_four_chambers_keeps_their_pressures() -> None:
    """Three lengths around 30 mm, from the edge of the range on: no pressure below zero."""
    model = plant(SLOW, gain=1e-7, rest=0.03)
    controller = design_controller("mpc", model, bandwidth=6.0)
    assert "set-points 0 to 3 bar, slew 10 bar/s" in controller.summary()
    result = closed(model, controller, duration=6.0, x=41.0, y_mm=43.0, z=49.0, at_s=0.0, cocontraction=1.0)
    for name in ("x", "y", "z"):
        assert result.metrics[name]["steady_rms_mm"] < 0.05
    P = np.column_stack([result[f"motor_setpoint_{j}"] for j in range(1, 5)])
    assert P.min() >= 0.0
    assert P.max() <= 3e5
    assert np.abs(np.diff(P, axis=0)).max() <= 1e6 * TS * (1.0 + 1e-9)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["antagonist", "trunk4"])
def test_a_predictive_controller_over_the_virtual_plant(name: str) -> None:
    """Recorded, identified, designed and closed over the physics that stands for the robot."""
    robot = Robot.preset(name)
    recording = record(signal("aprbs", duration=40.0, robot=robot), VirtualNeck.of(robot), seed=1)
    # A wish for tautness would be met by one tendon alone where there are four.
    model = identify("oe", recording, train=1.0)
    controller = design_controller("mpc", model, bandwidth=5.0, minimum_tautness=None)
    result: Any = simulate({"duration_s": 6.0, "plant": "paper", "controller": controller,
                            "reference": {"kind": "step", "at_s": 1.0, "pitch_deg": 8.0}})  # fmt: skip
    found = result.metrics["pitch"]
    # The gain of a line through large moves is some 20 % off for small ones.
    assert float(found["overshoot_pct"] or 0.0) < 25.0
    assert found["steady_rms_deg"] == pytest.approx(0.0, abs=0.3)
    P = np.column_stack([result[channel] for channel in robot.set_points])
    assert np.abs(P).max() <= 6.0
    if name == "trunk4":
        # The pattern that neither tilts nor co-contracts is held at zero.
        assert np.abs(P @ np.array([1.0, -1.0, 1.0, -1.0])).max() < 0.05


@pytest.mark.usefixtures("plain_steps_of_blocks")
def test_an_adaptive_controller_does_the_same_in_all_units() -> None:
    """Gains ten thousand times smaller and motors that go further by as much: the same loop, learning included."""
    wide = Robot.from_dict({
        **Robot.preset("antagonist").as_dict(),
        "motors": {"names": ["a", "b"], "unit": "rad", "setpoint_min": -6e4, "setpoint_max": 6e4, "rate_limit": 156e3},
    })  # fmt: skip
    results: list[Any] = []
    for robot, gain in ((Robot.preset("antagonist"), 0.08), (wide, 8e-6)):
        controller = design_controller("adaptive", plant(robot, gain=gain))
        # The plant is 1.4 times as strong as the one that it starts from.
        results.append(closed(plant(robot, gain=1.4 * gain), controller, pitch_deg=6.0))
    few, many = results
    np.testing.assert_allclose(many["pitch"], few["pitch"], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(many["motor_setpoint_1"], 1e4 * few["motor_setpoint_1"], rtol=1e-6, atol=1e-4)
    assert few.metrics["pitch"]["overshoot_pct"] < 15.0
    assert abs(few["pitch"][-1] - math.radians(6.0)) < math.radians(0.05)


@pytest.mark.usefixtures("plain_steps_of_blocks")
def test_an_adaptive_controller_learns_what_its_robot_is() -> None:
    robot = Robot.preset("trunk4")
    controller = design_controller("adaptive", plant(robot))
    result: Any = simulate({
        "duration_s": 20.0, "plant": plant(robot, gain=0.1), "controller": controller,
        "reference": {"kind": "rotation", "inclination_deg": 10, "rise_s": 2.0},
    })  # fmt: skip
    assert result.metrics["pitch"]["rms_error_deg"] < 10.0
    assert "rad, pole" in controller.summary()


def test_a_controller_of_ones_own_is_named_by_the_robots_outputs() -> None:
    import control

    model = plant(BELLOWS, gain=1e-7)
    K = control.ss(control.tf([2e6, -1.9e6], [1.0, -1.0], TS))
    given = K.copy()
    given.update_names(inputs=["x_error"], outputs=["x_input"])
    made: Any = design_controller("custom", model, controller={"x": given, "y": K, "z": K}, robot=SLOW)
    assert made.robot.hash == BELLOWS.hash
    pi = design_controller("pi", model, robot=SLOW)
    assert list(made.ss().input_labels) == list(pi.ss().input_labels)
    z = np.exp(1j * np.geomspace(0.5, 100.0, 10) * TS)
    for i in range(3):
        np.testing.assert_allclose(made.ss()(z)[i, 3 + i], -np.asarray(K(z)), rtol=1e-9)
    with pytest.raises(SettingsError, match="`controller` must be given for x and y and z; got pitch, roll"):
        design_controller("custom", model, controller={"pitch": K, "roll": K}, robot=SLOW)
