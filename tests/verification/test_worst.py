"""The worst plant is the one that is judged: of every metric, in every list, and with the width the data leave open."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import OutputFileError, SettingsError
from softneck.cosim import load_loop
from softneck.robot import Robot
from softneck.runtime import Block
from softneck.signals import read_recording
from softneck.verification import linear_plant, make_requirements, verify
from softneck.verification._evidence import Values, worst_row
from softneck.verification._linear import LinearLaw, margins
from softneck.verification._steps import middle_motors, middle_of
from softneck.verification._worst import write_linear, write_neck

from .necks import QUICK, TS, family, pi


def _values(*numbers: float) -> dict[str, Values]:
    return {"m": Values(np.array(numbers), lambda row: {"row": row})}


@pytest.mark.parametrize(
    ("numbers", "least", "largest"),
    [
        ((3.0, 1.0, 2.0), 1, 0),
        ((-1.0, 5.0, -2.0), 2, 1),
        ((1.0, math.inf, 0.5), 2, 1),
        # A number that could not be computed is worse than any other, whatever is asked of it.
        ((3.0, math.nan, 1.0, math.nan, 9.0), 1, 1),
    ],
)
def test_the_worst_row_is_the_one_that_is_farthest_from_holding(
    numbers: tuple[float, ...], least: int, largest: int
) -> None:
    assert worst_row(_values(*numbers), "m", "min") == least
    assert worst_row(_values(*numbers), "m", "max") == largest


@pytest.mark.slow
def test_no_plant_of_a_verification_is_worse_than_the_one_that_it_names() -> None:
    found = verify(pi(), family(spread=0.3), make_requirements({**QUICK, "sim": {"necks": 0}}))
    computed = [verdict for verdict in found.verdicts if verdict.value is not None]
    assert len(computed) > 8
    for verdict in computed:
        asked, values = verdict.requirement, found.evidence.metrics[verdict.requirement.metric].values
        assert verdict.value == (values.min() if asked.bound == "min" else values.max())
        # What holds for the worst holds for all.
        assert verdict.holds == all(asked.holds(float(value)) for value in values)
    # The named plant is the one of that value: its own margins, computed alone.
    plants = found.evidence.linear[0].plants
    law = LinearLaw.of(pi().ss())
    table = margins(plants, law)
    for verdict in computed:
        axis, _, name = verdict.requirement.metric.partition(".")
        if axis == "axes" and f"pitch.{name}" in table:
            row = plants.names.index(verdict.worst["name"])
            own = table[f"{verdict.worst['axis']}.{name}"][row]
            assert own == pytest.approx(verdict.value, rel=1e-9)  # rounding of sums over other batches
    # A worse plant makes the value worse, never better: all margins shrink as the box grows.
    narrow = verify(pi(), family(spread=0.05), make_requirements({**QUICK, "sim": {"necks": 0}}))
    for wide, tight in zip(found.verdicts, narrow.verdicts, strict=True):
        if wide.value is None or not wide.requirement.metric.startswith(("axes.", "stability.", "robust.mu")):
            continue
        sign = 1.0 if wide.requirement.bound == "min" else -1.0
        assert tight.value is not None
        assert sign * wide.value < sign * tight.value, wide.requirement.metric


def test_the_loop_of_a_worst_neck_runs_at_a_sample_time_estimated_from_a_log(tmp_path: Path) -> None:
    sample_time = 0.020895371  # a file that rounds it to six digits names another one
    replace(pi(), sample_time=sample_time).save(tmp_path / "pi.npz")
    worst = {
        "name": "paper, 1 kg", "parameters": {}, "payload_kg": 1.0, "seed": 7, "pitch_deg": 15.0, "roll_deg": 0.0,
        "at_s": 0.5, "duration_s": 2.5, "sample_time_s": sample_time, "order": "sequential",
    }  # fmt: skip
    file = write_neck(
        tmp_path, "neck", worst, controller=tmp_path / "pi.npz", observer=None, force=False, robot=Robot.preset()
    )
    parts = load_loop(file).loop.parts
    assert {name: part.sample_time for name, part in parts.items()} == {
        "plant": sample_time, "controller": sample_time
    }  # fmt: skip


BENT = Robot.from_dict({
    "name": "bent", "extends": "antagonist", "outputs": {"rest": [0.2]}, "motors": {"rest": [0.4, 0.4]},
})  # fmt: skip


def plant_of(robot: Robot, m: int, axis: int) -> dict[str, Any]:
    """Return the facts of a plant whose axes differ, `axis` stepped."""
    poles = [0.9, 0.8][:m]
    return {
        "name": 'a "b"\\c', "numerator": [[0.0, 0.5 * (1.0 - a)] for a in poles],
        "denominator": [[1.0, -a] for a in poles],
        "delay": [2, 3][:m], "cross": [0.1, -0.2][: m * (m - 1)], "sample_time": TS, "axis": axis,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("robot", "axis"), [(Robot.preset(), 0), (Robot.preset(), 1), (BENT, 0)], ids=["p", "r", "bent"]
)
def test_a_worst_linear_plant_is_written_as_the_loop_in_which_it_was_stepped(
    robot: Robot, axis: int, tmp_path: Path
) -> None:
    """What the file steps by, how long, and from where are those of the step test; a second one goes beside it."""
    m = len(robot.outputs.names)
    asked = make_requirements({"step": {"size_deg": 8.0, "duration_s": 2.0, "noise_deg": 0.02}}, robot=robot)
    pi().save(tmp_path / "pi.npz")
    weights = robot.weights()
    assert weights is not None
    block: Any = SimpleNamespace(parameters=())
    how = {"controller": tmp_path / "pi.npz", "asked": asked, "block": block, "weights": 1.5 * weights}
    file = write_linear(tmp_path, "w", plant_of(robot, m, axis), force=False, **how)
    with pytest.raises(OutputFileError):
        write_linear(tmp_path, "w", plant_of(robot, m, axis), force=False, **how)
    assert write_linear(tmp_path, "w", plant_of(robot, m, axis), force=True, **how) == file == tmp_path / "w.toml"
    table = tomllib.loads(file.read_text())
    assert (table["order"], table["sample_time_s"], table["controller"]["file"]) == ("sequential", TS, "pi.npz")
    assert table["plant"]["parameters"] == {"noise_std": pytest.approx(math.radians(0.02))}
    module, _, name = table["plant"]["python"].partition(":")
    space: dict[str, Any] = {}
    exec((tmp_path / f"{module}.py").read_text(), space)
    plant: Block = space[name]()
    numbers = plant_of(robot, m, axis)
    assert [np.asarray(part).tolist() for part in plant.arrays[:3]] == [
        numbers["numerator"], numbers["denominator"], numbers["delay"]
    ]  # fmt: skip
    np.testing.assert_allclose(plant.arrays[4], robot.redefinition(1.5 * weights)[0])
    around = middle_of(robot)
    np.testing.assert_allclose(plant.arrays[5], around)
    before = robot.redefinition(1.5 * weights)[0] @ middle_motors(robot, block)
    loads = [port.start for port in plant.inputs if port.name.startswith("load_")]
    assert loads == pytest.approx((-before[:-1]).tolist())
    step = np.radians(8.0) * (np.arange(m) == axis)
    if robot is not BENT:
        assert table["duration_s"] == 2.0
        ends = [table["reference"][f"{output}_deg"] for output in robot.outputs.names]
        assert ends == pytest.approx(np.degrees(step).tolist())
        assert (table["reference"]["kind"], table["reference"]["at_s"]) == ("step", 0.0)
        return
    # Motors and outputs are moved to their rest first, for as long as the step and its load take.
    assert table["duration_s"] == 2.0 + 200 * TS
    reference = read_recording(tmp_path / table["reference"]["file"])
    assert (len(reference), reference.sample_time) == (201, TS)
    wanted = reference.channels[f"{robot.outputs.names[0]}_reference"]
    np.testing.assert_allclose(wanted[:-1], around[0])
    assert wanted[-1] == pytest.approx(around[0] + step[0])
    np.testing.assert_allclose(reference.channels["cocontraction_reference"], before[-1])


GOOD: dict[str, Any] = {
    "numerator": [[0.0, 0.1], [0.0, 0.2]],
    "denominator": [[1.0, -0.9], [1.0, -0.8]],
    "delay": [0, 2],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"numerator": [[0.0, 0.1]]}, "must have one shape"), ({"denominator": [[1.0], [1.0]]}, "must have one shape"),
        ({"numerator": [[0.0, 0.1]] * 3, "denominator": [[1.0, -0.9]] * 3}, r"must have one shape \(2, q\)"),
        ({"numerator": [[0.0, 0.1], [0.1, 0.2]]}, "must begin with 0"),
        ({"numerator": [[0.1, 0.1], [0.0, 0.2]]}, "must begin with 0"),
        ({"denominator": [[1.0, -0.9], [2.0, -0.8]]}, "with 1"),
        ({"denominator": [[0.5, -0.9], [1.0, -0.8]]}, "with 1"),
        ({"delay": [0, -1]}, "must not be negative"), ({"delay": [-1, 0]}, "must not be negative"),
    ],
)  # fmt: skip
def test_a_linear_plant_answers_one_sample_later_at_least(change: dict[str, Any], message: str) -> None:
    assert linear_plant(**GOOD).arrays[3].tolist() == [[1.0, 0.0], [0.0, 1.0]]
    with pytest.raises(SettingsError, match=message):
        linear_plant(**{**GOOD, **change})


def test_a_linear_plant_is_its_difference_equation_about_its_operating_point() -> None:
    """Inputs by the weights of the motors, crossed, late, and counted from where they were; noise none."""
    block = linear_plant(**GOOD, cross=[0.5, -0.25], inputs=[0.3, -0.1], outputs=[0.02, 0.04])
    T = Robot.preset().redefinition()[0][:2]
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1.0, 1.0, (60, len(block.inputs)))
    names = [port.name for port in block.inputs]
    motors = [names.index(name) for name in Robot.preset().set_points]
    loads = [names.index(f"load_{axis}") for axis in ("pitch", "roll")]
    X = np.array([[1.0, 0.5], [-0.25, 1.0]])
    # A load is of one axis alone; what the other motors do leaks in.
    u = rows[:, motors] @ T.T @ X.T + rows[:, loads]
    y = np.zeros((61, 2))
    for k in range(60):
        for i, (a, b, d) in enumerate(((0.9, 0.1, 0), (0.8, 0.2, 2))):
            y[k + 1, i] = a * y[k, i] + b * (u[k - d, i] if k >= d else 0.0)
    state, told = block.initial_state(), []
    for row in rows:
        state, out = block.step(state, row)
        told.append(out[:4])
    np.testing.assert_allclose(np.array(told)[:, :2], y[1:] + np.array([0.02, 0.04]), atol=1e-12)
    np.testing.assert_allclose(np.array(told)[:, 2:], np.array(told)[:, :2], atol=1e-12)
