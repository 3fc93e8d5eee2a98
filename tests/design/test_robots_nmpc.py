"""Nonlinear predictive control of other robots than the neck: units, limits, time scales, files, and its optimum."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck import load, record
from softneck.core import Matrix, SettingsError
from softneck.cosim import simulate
from softneck.cosim.parts._fmu_part import drive_fmu
from softneck.design import NmpcController, NmpcSettings
from softneck.design.predictive._nmpc import NmpcNumbers, near_rest
from softneck.fmu import build_fmu
from softneck.identification import GreyBox, Model, Network, Play
from softneck.plant import VirtualNeck
from softneck.robot import Robot
from softneck.runtime import load_runtime
from softneck.signals import Recording, signal

from ..data import ROOT

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

TS = 0.02
# A length that two chambers move; nobody told their directions, and it is 50 mm at one bar.
PUSHER = Robot.from_dict({
    "name": "pusher",
    "motors": {"names": ["a", "b"], "unit": "bar", "setpoint_min": 0, "setpoint_max": 3, "rate_limit": 20},
    "outputs": {"names": ["x"], "unit": "mm", "min": 40, "max": 60},
    "directions": {"kind": "identified"},
})  # fmt: skip
# Motors that pull and give way, and what both do at rest, in SI.
LAGS = {"antagonist": ([0.08, -0.08], 0.0, (-3.0, 3.0)), "pusher": ([1e-7, -0.6e-7], 0.046, (0.0, 3e5))}


@cache
def lag(robot: Robot) -> Model:
    """A lag of 0.2 s behind two samples, as `play` finds it."""
    gains, rest, (low, high) = LAGS[robot.name]
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(low, high, (40, 2)), 25, axis=0)
    y = np.full(len(u), rest)
    for k in range(len(u) - 1):
        y[k + 1] = rest + 0.9 * (y[k] - rest) + 0.1 * np.dot(gains, u[max(k - 2, 0)])
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*u.T, y), strict=True))
    recording = Recording(np.arange(len(u)) * TS, TS, channels, robot=robot)
    return Play(rate=15.0, widths=(0.2,), degree=1).fit(recording)


def plainly(controller: NmpcController, reference: list[float], rows: int, *, start: float) -> tuple[Matrix, Matrix]:
    """Outputs and motors of the controller on its own model, both in plain Python: nothing is compiled."""
    blocks = controller.block(), controller.model.block()
    control, plant = (load_runtime(block.runtime, compiled=False) for block in blocks)
    m, n = len(controller.robot.outputs.names), len(controller.robot.motors.names)
    first, second = (block.initial_state() for block in blocks)
    x, z = first.values.copy(), second.values.copy()
    u, y, out = np.full(n, start), second.outputs[:m].copy(), np.zeros(len(blocks[1].outputs))
    rest = blocks[1].initial_state(use_measurement=0.0).parameters
    seen, given = [], []
    for k in range(rows + 100):
        if k >= 100:  # the model has come to rest
            control.step(blocks[0].arrays, first.parameters, x, np.array([*reference, *y, *u, 1.0, 1.0]), u)
        plant.step(blocks[1].arrays, rest, z, np.array([*u, *[math.nan] * (m + n)]), out)
        y = out[:m].copy()
        seen.append(y)
        given.append(u.copy())
    return np.array(seen[100:]), np.array(given[100:])


def test_the_limits_of_a_necks_own_file_hold_where_they_are_stricter(tmp_path: Path) -> None:
    preset = Robot.preset("neck")
    own = replace(preset, motors=replace(preset.motors, setpoint_max=(4.0,) * 3, rate_limit=(5.0,) * 3))
    model = replace(load(ROOT / "tests" / "golden" / "play.npz"), robot=own)
    controller = NmpcSettings().design(model)
    assert controller.block().initial_state().parameters[:2].tolist() == [4.0, 5.0]
    controller.save(tmp_path / "c.npz")
    again = load(tmp_path / "c.npz")
    assert again.block().initial_state().parameters[:2].tolist() == [4.0, 5.0]
    assert again.robot.motors.setpoint_max == (4.0,) * 3


def test_an_antagonist_follows_within_the_limits_that_are_given() -> None:
    preset = Robot.preset("antagonist")
    motors = replace(preset.motors, setpoint_min=(-1.0, -1.0), setpoint_max=(1.0, 1.0), rate_limit=(8.0, 8.0))
    controller = NmpcSettings(horizon=8, moves=3).design(lag(replace(preset, motors=motors)))
    y, P = plainly(controller, [0.12, 0.2], 60, start=0.0)
    assert y[-1, 0] == pytest.approx(0.12, abs=1e-3)
    # 0.12 rad by 0.08 rad/rad of P1 - P2, around the co-contraction asked for.
    np.testing.assert_allclose(P[-1], [0.2 + 0.75, 0.2 - 0.75], atol=0.02)
    assert np.abs(P).max() <= 1.0 + 1e-9
    assert np.abs(np.diff(P, axis=0)).max() <= 8.0 * TS * (1.0 + 1e-9)


def test_a_length_of_two_chambers_in_bar_and_mm(tmp_path: Path) -> None:
    """Directions that nobody told are the model's; pressures stay in their range."""
    controller = NmpcSettings(horizon=8, moves=3).design(lag(PUSHER))
    assert "set-points 0 to 3 bar, slew 20 bar/s" in controller.summary()
    controller.save(tmp_path / "c.npz")
    again = load(tmp_path / "c.npz")
    assert again.robot.hash == PUSHER.hash
    for one, other in zip(controller.block().arrays, again.block().arrays, strict=True):
        np.testing.assert_array_equal(one, other)
    y, P = plainly(again, [0.056, 1e5], 60, start=1e5)
    assert y[-1, 0] == pytest.approx(0.056, abs=1e-4)
    assert P.min() >= 0.0
    assert P.max() <= 3e5
    assert np.abs(np.diff(P, axis=0)).max() <= 20e5 * TS * (1.0 + 1e-9)


@pytest.mark.parametrize("sample_time", [TS, 4.0])
def test_it_looks_as_far_as_its_robot_is_slow(sample_time: float) -> None:
    """The same rows are the same problem, however long a sample takes."""
    found = {"pitch": {"static_gain": 0.16, "pole": 0.1 / sample_time, "delay": 3}}
    model: Any = replace(lag(Robot.preset("antagonist")), sample_time=sample_time)
    plant = near_rest(model, found)
    asked = NmpcNumbers().fill_defaults(plant)
    # 10 samples to the pole, as of a neck at 20 ms.
    assert (asked.horizon, asked.moves, asked.window) == (20, 10, 8)
    assert asked.reference_time == pytest.approx(10.0 * sample_time)
    assert asked.bandwidth == pytest.approx(8.0 * 0.2 / (10.0 * sample_time))
    given = NmpcNumbers(horizon=12, bandwidth=3.0).fill_defaults(plant)
    assert (given.horizon, given.bandwidth) == (12, 3.0)


def test_what_is_of_necks_is_refused() -> None:
    with pytest.raises(
        SettingsError, match=r"`angle_limit` is for outputs that are angles; those of `pusher` .* are in mm"
    ):
        NmpcSettings(angle_limit=0.1).design(lag(PUSHER))


KINDS: dict[str, Any] = {
    "nn": Network(hidden=(6, 6), iterations=30),
    "play": Play(rate=15.0, widths=(0.2,), degree=1),
    "greybox": GreyBox(evaluations=20),
}


@cache
def identified(name: str, kind: str) -> Model:
    robot = Robot.preset(name)
    return KINDS[kind].fit(record(signal("aprbs", duration=30.0, robot=robot), VirtualNeck.of(robot), seed=1))


@pytest.mark.slow
@pytest.mark.nightly
# Where so small a model knows little it says so; here it is the plant.
@pytest.mark.filterwarnings("ignore:the plant's validity falls")
@pytest.mark.parametrize("name", ["antagonist", "trunk4"])
@pytest.mark.parametrize("kind", KINDS)
def test_it_settles_on_its_own_model(name: str, kind: str) -> None:
    model = identified(name, kind)
    controller = NmpcSettings(horizon=15, moves=5).design(model)
    result: Any = simulate({"duration_s": 5.0, "plant": model, "controller": controller,
                            "reference": {"kind": "step", "at_s": 0.5, "pitch_deg": 6.0}})  # fmt: skip
    found = result.metrics["pitch"]
    assert float(found["overshoot_pct"] or 0.0) < 10.0
    assert found["steady_rms_deg"] == pytest.approx(0.0, abs=0.2)
    P = np.column_stack([result[channel] for channel in model.robot.set_points])
    assert np.abs(P).max() <= 6.0
    if name == "trunk4":
        # The pattern that neither tilts nor co-contracts is brought back to zero: with `nn`, whose gains differ from
        # motor to motor, 0.4 rad at the step and 0.003 rad at the end.
        assert np.abs(P[-50:] @ np.array([1.0, -1.0, 1.0, -1.0])).max() < 0.02


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["antagonist", "trunk4"])
def test_its_fmu_does_the_same(name: str, tmp_path: Path) -> None:
    controller = NmpcSettings(horizon=8, moves=3, preview=0.1).design(identified(name, "play"))
    block = controller.block()
    build_fmu(block, tmp_path / "Nmpc.fmu")
    rng, rows = np.random.default_rng(1), 40
    inputs = {port.name: np.full(rows, port.start) for port in block.inputs}
    inputs |= {"pitch_reference": np.full(rows, 0.1), "pitch_reference_ahead": np.full(rows, 0.1)}
    inputs |= {name: 0.02 * rng.standard_normal(rows) for name in controller.robot.outputs.names}
    inputs |= {name: 0.1 * rng.standard_normal(rows) for name in controller.robot.motor_positions}
    found = drive_fmu(tmp_path / "Nmpc.fmu", inputs, parameters={"use_motor_positions": 1.0})
    state, expected = controller.initial_state(), []
    for k in range(rows):
        state, motors = controller.step(state, [inputs[port.name][k] for port in block.inputs])
        expected.append(motors)
    # A controller answers at once, a plant a sample later.
    np.testing.assert_allclose(found[:-1], np.array(expected)[:-1], rtol=1e-9, atol=1e-12)
