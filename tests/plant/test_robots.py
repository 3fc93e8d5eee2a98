"""The virtual plant of other robots: the laws of the neck's hold for 1, 2, 4 and 8 tendons, in one plane or two."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, Matrix, SettingsError
from softneck.plant import NeckParameters, VirtualNeck, record, tendons_of
from softneck.robot import Robot
from softneck.runtime import Block, State, load_runtime
from softneck.signals import Excitation, signal, signal_names

from ..oracles.neck_energy import body, neck_energy

SIZES = [(1, 1), (2, 1), (4, 2), (8, 2)]


def robot(count: int, seen: int, /, *, turn: float = 0.0, **tables: Any) -> Robot:
    """So many tendons evenly around, turned by `turn` [deg], and outputs."""
    table = Robot.preset("trunk4").as_dict()
    angles = [turn + 360.0 * j / count for j in range(count)]
    return Robot.from_dict(
        {
            **table,
            "name": f"robot {count}",
            "motors": {**table["motors"], "names": [f"motor_{j + 1}" for j in range(count)]},
            "outputs": {**table["outputs"], "names": ["bend", "sway"][:seen]},
            "directions": {"kind": "tendons", "angles_deg": angles},
            **tables,
        }
    )


def quiet(**changes: float) -> NeckParameters:
    """The same link all around, a perfect sensor; pretension such that eight tendons leave it off its wall."""
    straight = {"stiffness_asymmetry": 0.0, "rest_pitch": 0.0, "rest_roll": 0.0, "encoder_counts": 0.0}
    return NeckParameters.paper().without_noise().replace(**{**straight, "pretension": 1.0, **changes})


def plain_run(block: Block, state: State, U: Matrix) -> tuple[State, Matrix]:
    """Step in plain Python: nobody waits for a compiler of four sizes."""
    runtime = load_runtime(block.runtime, compiled=False)
    x, Y = state.values.copy(), np.zeros((len(U), len(block.outputs)))
    for u, y in zip(U, Y, strict=True):
        runtime.step(block.arrays, state.parameters, x, u, y)
    return State(x, state.parameters, Y[-1].copy()), Y


def started(block: Block) -> State:
    runtime = load_runtime(block.runtime, compiled=False)
    q = np.array([port.start for port in block.parameters])
    x, y = np.zeros(runtime.state_size(block.arrays)), np.zeros(len(block.outputs))
    runtime.initialise(block.arrays, q, x, y)
    return State(x, q, y)


def inputs(block: Block, rows: int, **values: Any) -> Matrix:
    names = [port.name for port in block.inputs]
    U = np.zeros((rows, len(names)))
    for name, value in values.items():
        U[:, names.index(name)] = value
    return U


def column(block: Block, Y: Matrix, name: str) -> Matrix:
    return Y[:, [port.name for port in block.outputs].index(name)]


@pytest.mark.parametrize(("motors", "outputs"), SIZES)
def test_at_rest_each_tendon_has_its_pretension_and_nothing_moves(motors: int, outputs: int) -> None:
    block = VirtualNeck(quiet(), robot(motors, outputs)).block()
    state, Y = plain_run(block, started(block), inputs(block, 20))
    for j in range(motors):
        np.testing.assert_allclose(column(block, Y, f"tension_{j + 1}"), 1.0, rtol=1e-9)
    # The fixed point's rounding, 1e-12 rad, and what 0.4 s make of it.
    np.testing.assert_allclose(Y[:, :outputs], np.broadcast_to(Y[0, :outputs], (20, outputs)), atol=1e-9)
    assert np.abs(body(state)["w"]).max() < 1e-9
    if motors > 1:
        assert np.abs(Y[:, :outputs]).max() < 1e-9
    else:
        assert Y[0, 0] > 0.05  # one tendon alone bends the link


@pytest.mark.parametrize("motors", [4, 8])
def test_turning_the_tendons_by_one_turns_the_answer(motors: int) -> None:
    turn = 360.0 / motors
    block = VirtualNeck(quiet(), robot(motors, 2)).block(internal_step=0.002)
    turned = VirtualNeck(quiet(), robot(motors, 2, turn=turn)).block(internal_step=0.002)
    t = 0.02 * np.arange(25)
    moves = {f"motor_setpoint_{j + 1}": 1.5 * np.sin((2 + j) * t) for j in range(motors)}
    _, here = plain_run(block, started(block), inputs(block, 25, **moves))
    _, there = plain_run(turned, started(turned), inputs(turned, 25, **moves))
    a = np.radians(turn)
    R = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    # Normals: pitch and roll are projections. Rounding, grown by tendons between slack and taut.
    np.testing.assert_allclose(_normals(here[:, :2]) @ R.T, _normals(there[:, :2]), atol=1e-9)
    assert np.ptp(here[:, 0]) > 0.02
    np.testing.assert_allclose(column(block, here, "tension_2"), column(turned, there, "tension_2"), atol=1e-7)


def _normals(angles: Matrix) -> Matrix:
    n = np.column_stack([np.tan(angles), np.ones(len(angles))])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def test_the_antagonist_mirrors() -> None:
    block = VirtualNeck(quiet(), robot(2, 1)).block(internal_step=0.002)
    t = 0.02 * np.arange(25)
    P1, P2 = 2.0 * np.sin(4 * t), 1.5 * np.sin(6 * t)
    _, one = plain_run(block, started(block), inputs(block, 25, motor_setpoint_1=P1, motor_setpoint_2=P2))
    _, other = plain_run(block, started(block), inputs(block, 25, motor_setpoint_1=P2, motor_setpoint_2=P1))
    np.testing.assert_allclose(one[:, 0], -other[:, 0], atol=1e-12)
    assert np.ptp(one[:, 0]) > 0.02


def test_one_axis_stays_in_its_plane() -> None:
    lean = NeckParameters.paper()  # whose link rests bent across, too
    block = VirtualNeck(lean.without_noise(), robot(2, 1, turn=30.0)).block()
    state, Y = plain_run(block, started(block), inputs(block, 30, motor_setpoint_1=2.0, push_x=1.0, base_tilt_bend=0.1))
    assert body(state)["b"][1] == body(state)["w"][1] == body(state)["z"][1] == 0.0
    assert np.ptp(Y[:, 0]) > 0.02
    assert [port.name for port in block.outputs[:4]] == [
        "bend", "bend_measured", "bend_rate_measured", "measurement_valid",
    ]  # fmt: skip


@pytest.mark.parametrize("names", [("roll",), ("roll", "pitch"), ("pitch",), ("pitch", "roll")])
def test_the_plant_s_tendons_stand_where_the_robot_has_its_directions(names: tuple[str, ...]) -> None:
    one = robot(3, len(names), turn=10.0, outputs={**Robot.preset().as_dict()["outputs"], "names": names})
    angles = np.array(tendons_of(one, quiet()))
    # The plant bends its first output by cosines and its second by sines, which weights round at 1e-15.
    weights = one.weights()
    assert weights is not None
    np.testing.assert_allclose(np.array([np.cos(angles), np.sin(angles)])[: len(names)], weights, atol=1e-14)


@pytest.mark.parametrize(("motors", "outputs"), SIZES)
def test_slack_tendons_pull_nothing_and_energy_falls_where_nothing_drives(motors: int, outputs: int) -> None:
    block = VirtualNeck(quiet(), robot(motors, outputs)).block(sample_time=0.01, internal_step=0.0005)
    paid_out = {f"motor_setpoint_{j + 1}": -6.0 for j in range(motors)}
    state, _ = plain_run(block, started(block), inputs(block, 60, **paid_out, push_x=4.0))
    energies = [neck_energy(state).total]
    for _ in range(15):
        state, Y = plain_run(block, state, inputs(block, 1, **paid_out))
        for j in range(motors):
            assert column(block, Y, f"tension_{j + 1}") == 0.0
        energies.append(neck_energy(state).total)
    # Rounding of sums of about 1 J.
    assert np.diff(energies).max() < 1e-13
    assert energies[0] - energies[-1] > 1e-3


def test_three_tendons_where_the_neck_has_them_are_the_neck_to_the_bit() -> None:
    same = robot(3, 2, directions={"kind": "tendons", "angles_deg": [0.0, 120.0, 240.0]})
    assert not same.is_neck
    blocks = [VirtualNeck(NeckParameters.paper(), one).block(noise_seed=4) for one in (Robot.preset(), same)]
    U = np.column_stack([signal("eq22", duration=4.0).set_points, *np.full((5, 200), 0.1)])
    states = [block.initial_state() for block in blocks]
    runs = [block.run(state, U) for block, state in zip(blocks, states, strict=True)]
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    np.testing.assert_array_equal(runs[0][0].values, runs[1][0].values)
    assert blocks[0].runtime == blocks[1].runtime


def test_a_robot_s_own_numbers_stand_and_the_preset_neck_gives_none() -> None:
    lab = NeckParameters.lab()
    assert VirtualNeck.of(Robot.preset(), lab) == VirtualNeck(lab)
    given = robot(4, 2, winch={"radius_m": 0.02}, sensor={"noise_std": 0.003, "delay_s": 0.1})
    neck = VirtualNeck.of(given, lab).parameters
    assert (neck.winch_radius, neck.noise_std, neck.sensor_delay) == (0.02, 0.003, 0.1)
    assert neck.replace(winch_radius=0.01, noise_std=lab.noise_std, sensor_delay=lab.sensor_delay) == lab
    motors = {**given.as_dict()["motors"], "setpoint_min": [0, -1, -2, -3], "setpoint_max": 9.0}
    ports = VirtualNeck.of(robot(4, 2, motors=motors)).block().inputs[:4]
    assert [(port.minimum, port.maximum) for port in ports] == [(0, 9), (-1, 9), (-2, 9), (-3, 9)]


def test_a_neck_file_goes_by_the_folder_of_the_robot_s(tmp_path: Path) -> None:
    import tomli_w

    (tmp_path / "mine.toml").write_text("bending_damping = 0.2\n", encoding="utf-8")
    path = tmp_path / "robot.toml"
    path.write_text(tomli_w.dumps(robot(4, 2, plant={"neck": "mine.toml"}).as_dict()), encoding="utf-8")
    assert VirtualNeck.of(Robot.read(path)).parameters.bending_damping == 0.2


@pytest.mark.parametrize(
    ("tables", "what"),
    [
        ({"motors": {"names": ["a", "b"], "unit": "bar"}}, r"motors in rad or deg, and `motors.unit` .* is bar"),
        ({"outputs": {"names": ["x"], "unit": "m"}}, r"outputs in rad or deg, and `outputs.unit` .* is m"),
        ({"directions": {"kind": "identified"}}, r"where tendons stand, and `directions` .* are \"identified\""),
        ({"plant": {}}, r"gives no `plant.neck`, which the virtual plant needs"),
        ({"winch": {"radius_m": 1.0}}, r"`winch_radius` must be between"),
    ],
)
def test_robots_that_are_not_of_tendons_are_refused(tables: dict[str, Any], what: str) -> None:
    with pytest.raises(SettingsError, match=what):
        VirtualNeck.of(robot(2, 1, **tables))


def test_a_link_that_eight_tendons_would_buckle_is_refused() -> None:
    soft = NeckParameters.paper().replace(bending_stiffness=0.4)
    VirtualNeck(soft, robot(4, 2))
    with pytest.raises(SettingsError, match="without buckling"):
        VirtualNeck(soft, robot(8, 2))


@pytest.mark.parametrize(("motors", "outputs"), SIZES)
@pytest.mark.parametrize("name", signal_names())
def test_signals_stay_in_the_robot_s_range_and_move_every_motor(name: str, motors: int, outputs: int) -> None:
    table = robot(motors, outputs).as_dict()["motors"]
    limited = robot(motors, outputs, motors={**table, "setpoint_min": 0.0, "setpoint_max": 4.0}, sample_time_s=0.05)
    P = signal(name, robot=limited).set_points
    assert P.shape[1] == motors
    assert P.min() >= 0.0
    assert P.max() <= 4.0
    assert np.ptp(P, axis=0).min() > 0.5
    if name in ("eq22", "multisine", "mixed", "steps"):
        # Each motor for itself, or what it does alone could not be told.
        values = np.linalg.svd(P - P.mean(axis=0), compute_uv=False)
        assert values[-1] > 0.005 * values[0]


def test_signals_of_the_neck_are_those_of_its_preset() -> None:
    for name in signal_names():
        plain, given = signal(name, duration=4.0), signal(name, duration=4.0, robot=Robot.preset())
        np.testing.assert_array_equal(plain.set_points, given.set_points)


def test_a_slow_sensor_leaves_rows_out() -> None:
    slow = robot(3, 2, sensor={"noise_std": 0.0, "rate_hz": 10.0})
    found = record(signal("steps", robot=slow, duration=1.0), VirtualNeck.of(slow))
    assert found.robot == slow
    rows = np.flatnonzero(np.isfinite(found.outputs).all(axis=1))
    np.testing.assert_array_equal(rows, np.arange(0, 50, 5))
    assert np.isfinite(found.motor_positions).all()


def test_set_points_beyond_the_robot_s_range_are_refused() -> None:
    pulls = VirtualNeck.of(robot(2, 1, motors={"names": ["a", "b"], "unit": "rad", "setpoint_min": 0.0,
                                               "setpoint_max": 3.0}))  # fmt: skip
    P = np.array([[0.0, 0.0], [1.0, -0.1]])
    with pytest.raises(DataError, match=r"`b_setpoint` of mine is -0.1 rad .* from 0 to 3 rad"):
        record(Excitation("mine", np.array([0.0, 0.02]), P), pulls)
    with pytest.raises(DataError, match=r"shape \(time, 2\)"):
        record(Excitation("mine", np.array([0.0, 0.02]), np.zeros((2, 3))), pulls)


def test_the_trunk_bends_as_necks_worth_having_do() -> None:
    """3 rad on one tendon bend it by 12 to 18 deg (docs/theory/foreign_necks.md), and its winch gets there."""
    robot = Robot.preset("trunk4")
    block = VirtualNeck.of(robot).block()
    inputs, outputs = ([port.name for port in ports] for ports in (block.inputs, block.outputs))
    # Damped motions end within a second; the loop of the winch needs another.
    rows = np.tile([np.nan if port.missing else port.start for port in block.inputs], (150, 1))
    rows[:, [inputs.index(name) for name in robot.set_points]] = [3.0, 0.0, 0.0, 0.0]
    y = block.run(block.initial_state(), rows)[1]
    assert 12.0 < np.degrees(y[-1, outputs.index("pitch")] - y[0, outputs.index("pitch")]) < 18.0
    assert y[-1, outputs.index("motor_position_1")] == pytest.approx(3.0, abs=0.01)
