"""Loops around a model: the metric `validity.min`, its limit, and the one warning."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.cosim.loops._simulate import validity_remarks
from softneck.identification import Model
from softneck.identification.models._validity import with_validity_region
from softneck.loop import BlockPart, LoopResult, check_limits, metrics
from softneck.robot import Robot
from softneck.runtime import load_runtime
from softneck.signals import Recording, signal

TS, ROWS = 0.02, 400


def model() -> Model:
    """A static line that was trained within 1 rad, without a fit; plain text, nothing to compile."""
    arrays = {
        "history": np.ones(1), "drive": np.zeros((3, 2)), "redefinition": np.eye(3), "a": np.zeros((2, 0)),
        "b": np.full((2, 1), 0.05), "delay": np.zeros(2),
    }  # fmt: skip
    findings = {"set_points_rad": {"min": [-1.0] * 3, "max": [1.0] * 3}}
    return Model(kind="rls", sample_time=TS, arrays=arrays, findings=findings)


def trained() -> Model:
    P = np.clip(signal("eq22", duration=20.0).set_points, -1.0, 1.0)
    rows = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)} | {"pitch": 0.05 * P[:, 0], "roll": 0.05 * P[:, 1]}
    return with_validity_region(model(), Recording(np.arange(len(P)) * TS, TS, rows))


def run(plant: Model, height: float) -> LoopResult:
    """What a loop leaves whose motors go to `height` after 2 s: the plain text of the model steps."""
    block = plant.block()
    U = np.full((ROWS, len(block.inputs)), np.nan)
    U[:, :3] = np.where(np.arange(ROWS)[:, None] * TS < 2.0, 0.0, [0.0, height, 0.0])
    start = block.initial_state(use_measurement=0.0)
    Y = np.zeros((ROWS, len(block.outputs)))
    runtime = load_runtime(block.runtime, compiled=False)
    runtime.run_steps(block.arrays, start.parameters, start.values.copy(), U, Y)
    Y = np.vstack([start.outputs, Y[:-1]])
    signals = {port.name: Y[:, i] for i, port in enumerate(block.outputs)}
    signals |= {f"motor_setpoint_{j}": U[:, j - 1] for j in (1, 2, 3)}
    signals |= {f"{axis}_reference": np.zeros(ROWS) for axis in ("pitch", "roll")}
    return LoopResult(np.arange(ROWS) * TS, signals, {}, TS, Robot.preset())


@pytest.fixture(scope="module")
def plant() -> Model:
    return trained()


def test_within_its_training_a_model_says_nothing(plant: Model) -> None:
    assert validity_remarks(run(plant, 0.3), BlockPart(plant.block())) == ()


def test_beyond_the_range_the_set_point_the_time_and_how_far_are_told(plant: Model) -> None:
    result = run(plant, 60.0)
    (remark,) = validity_remarks(result, BlockPart(plant.block()))
    assert "`motor_setpoint_2` was 59 rad beyond the 1 rad that it was trained on" in remark
    first = np.flatnonzero(result["validity"] < 0.5)[0] * TS
    assert f"at t = {first:.2f} s" in remark
    assert first == pytest.approx(2.0, abs=0.1)


def test_a_place_that_was_never_held_is_told_too(plant: Model) -> None:
    """Within the range, but Eq. 22 never stays there."""
    worse = replace(plant, arrays={**plant.arrays, "doubt": plant.arrays["doubt"] + np.array([0.0, 1.0, 0.0])})
    (remark,) = validity_remarks(run(worse, 0.95), BlockPart(worse.block()))
    assert "`motor_position_2` has been held around" in remark or "`motor_position_2` is at" in remark


def test_an_fmu_tells_what_its_ports_know(plant: Model) -> None:
    """Of an FMU only the range of its set-points is known."""
    worse = replace(plant, arrays={**plant.arrays, "doubt": plant.arrays["doubt"] + np.array([0.0, 1.0, 0.0])})
    block = worse.block()
    fmu = SimpleNamespace(inputs=block.inputs, outputs=block.outputs)
    (remark,) = validity_remarks(run(worse, 0.95), fmu)  # pyright: ignore[reportArgumentType]
    assert "a combination of values that was not in training" in remark
    (remark,) = validity_remarks(run(worse, 60.0), fmu)  # pyright: ignore[reportArgumentType]
    assert "`motor_setpoint_2` was 59 rad beyond the 1 rad" in remark


def test_a_model_without_it_says_that_once(plant: Model) -> None:
    bare = model()
    (remark,) = validity_remarks(run(bare, 0.3), BlockPart(bare.block()))
    assert remark.startswith("no validity in this file: identify it again")


def test_the_metric_is_the_least_and_its_limit_a_lower_one(plant: Model) -> None:
    result = run(plant, 60.0)
    table = metrics(result)
    assert table["validity"]["min"] == result["validity"].min()
    rows = check_limits(table, {"validity.min": 0.5})
    assert (rows[0]["metric"], rows[0]["holds"]) == ("validity.min", False)
    assert check_limits(metrics(run(plant, 0.3)), {"validity.min": 0.5})[0]["holds"]


def test_a_limit_on_what_a_plant_does_not_say_is_refused(plant: Model) -> None:
    result = run(plant, 0.3)
    signals = {name: values for name, values in result.signals.items() if name != "validity"}
    other = LoopResult(result.time, signals, {}, TS, result.robot)
    assert "validity" not in metrics(other)
    with pytest.raises(SettingsError, match="the plant has no output `validity`"):
        check_limits(metrics(other), {"validity.min": 0.5})
