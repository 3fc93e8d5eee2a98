"""Other robots' models and FMUs as plants of a tuning: the loops are theirs, and what does not fit is said first."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import KINDS, DataError, SettingsError, resolve, silent
from softneck.cosim import FmuPart
from softneck.design import PiSettings
from softneck.fmu import build_fmu
from softneck.loop import SensorFault
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot
from softneck.tuning import tune
from softneck.tuning._judge import loop_of, prepare
from softneck.tuning._requirements import check_feasibility, make_tune_requirements, relax_limits
from softneck.tuning._space import spaces
from softneck.tuning._tune import Tuned, task_of
from softneck.verification import make_simulation_model, read_requirements, start_of
from softneck.verification._metrics import Scale
from softneck.verification._neck_loops import direction, run_loops
from softneck.verification._verify import sources_of
from tests.design.test_robots import BELLOWS, LEARNED, TS, plant

QUICK: dict[str, Any] = {"sampling": {"plants": 12, "search_generations": 0}, "step": {"duration_s": 2.0},
                         "sim": {"duration_s": 2.5}, "track": {"noise_deg": 0.0}}  # fmt: skip


def tuned(plants: dict[str, Any]) -> Tuned:
    # Of one kind: linear checks, a few loops, all of them, and the margins by experiment.
    return tune(plants, QUICK, kinds=("pi",), budget=4, workers=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["antagonist", pytest.param("trunk4", marks=pytest.mark.nightly)])
def test_a_robots_own_plant_steps_as_the_linear_one_that_it_is(name: str) -> None:
    model = plant(Robot.preset(name))
    found = tuned({"model": model, "again": model.block()})
    metrics = found.best.metrics
    assert found.best.level == "margins"
    # The worst of a box around the model is never quicker than the model itself; a sample more is what rounds.
    assert 0.0 < metrics["sim.rise_s"] <= metrics["step.rise_s"] + 0.02
    assert metrics["sim.overshoot_pct"] <= metrics["step.overshoot_pct"] + 0.5
    assert ("track.circle_rms_deg" in metrics) == (name == "trunk4"), "a circle is of two angles"


def test_a_default_that_is_quieter_than_the_noise_of_a_neck_refuses_no_other_robot() -> None:
    model = plant(Robot.preset("antagonist"))
    asked = task_of({"model": model}, {"track": {"noise_deg": 5.0}}, 0).asked
    assert 0.0 < (asked.limit("sim.steady_rms_deg") or 0.0) < 5.0
    check_feasibility(asked, model)


def test_noise_and_delay_of_the_noisy_loops_are_the_robots_own() -> None:
    model = plant(BELLOWS)
    asked, stated = (task_of({"model": model}, table, 0).asked for table in ({}, {"track": {"delay_ms": 7.0}}))
    time = asked.certificate.scale.time
    assert time != 1.0
    assert asked.track["delay_ms"] == pytest.approx(20.0 * time, rel=1e-11)  # a neck's 20 ms, in a file of 12 digits
    assert asked.track["noise_deg"] == asked.certificate.step["noise_deg"]
    named = {name.replace("_mm", "_deg"): value for name, value in asked.table["track"].items()}
    assert named == asked.track
    assert stated.track == {**asked.track, "delay_ms": 7.0}


def test_a_loosened_settling_time_of_a_slow_robot_is_a_file_that_is_read_again() -> None:
    slow = replace(plant(BELLOWS), sample_time=2.0)
    asked = task_of({"model": slow}, {}, 0).asked
    limit = 1.5 * (asked.limit("sim.settling_s") or 0.0)
    assert limit > 5.0  # the neck's duration of a step
    wider = relax_limits(asked, {"sim.settling_s": limit})
    table = {key: value for key, value in wider.table.items() if key != "version"}
    again = make_tune_requirements(table, robot=slow.robot)
    assert again.limit("sim.settling_s") == pytest.approx(limit, rel=1e-6)  # a file has 9 digits
    assert again.certificate.sim["duration_s"] == asked.certificate.sim["duration_s"]


def test_the_recordings_cocontraction_is_told_to_controllers_in_si() -> None:
    muscles = replace(Robot.preset("antagonist").motors, unit="bar", setpoint_min=(0.0, 0.0), setpoint_max=(3.0, 3.0))
    robot = replace(Robot.preset("antagonist"), motors=muscles)
    recorded = {"tested": {"conditions": [{"payload_kg": [0.0, 0.0], "cocontraction": [1.4e5, 1.8e5]}]}}
    lone = plant(BELLOWS)
    assert task_of({"m": replace(lone, findings={**lone.findings, **recorded})}, QUICK, 0).cocontraction is None
    model = plant(robot, gain=1e-6)
    task = task_of({"model": replace(model, findings={**model.findings, **recorded})}, QUICK, 0)
    assert (task.cocontraction, task.said_cocontraction) == (1.6e5, 1.6)  # Pa and bar
    for space in spaces(("pi", "lqg"), rise=0.4, cocontraction=task.cocontraction, robot=robot):
        limits = resolve(KINDS[space.kind].settings)(**space.settings(space.start)).design(model).limits
        assert limits.least_cocontraction == 1.6e5
    (planned,) = spaces(("nmpc",), rise=0.4, cocontraction=1.6e5, robot=BELLOWS)
    assert "minimum_tautness" not in planned.fixed  # which only tendons have


def test_verify_judges_by_what_tune_stretched_and_not_by_more() -> None:
    """Times of another robot are stretched once, not twice."""
    model = plant(BELLOWS)
    asked = task_of({"model": model}, None, 0).asked.certificate
    sources = sources_of({"model": model}, asked)
    assert abs(asked.scale.time - 1.0) > 0.02
    assert asked.at(Scale.of(model.robot, sources)) is asked
    plain = read_requirements(robot=model.robot)
    assert asked.uncertainty["delay_ms"] == pytest.approx(asked.scale.time * plain.uncertainty["delay_ms"])


@pytest.mark.slow
def test_a_budget_that_ends_before_the_loops_promises_nothing_and_goes_on(tmp_path: Path) -> None:
    model = plant(Robot.preset("antagonist"))
    plants = {"model": model, "own": model.block()}
    # Without loops nothing of the requirements on them is known, even where all that is known holds.
    easy = {**QUICK, "require": {"step.rise_s": {"max": 2.0}}}
    for budget, level in ((1, "linear"), (2, "all")):
        found = tune(plants, easy, kinds=("pi",), budget=budget, workers=0, folder=tmp_path)
        assert (found.evaluations, found.best.level) == (budget, level)
        assert not found.holds or level == "all"
    assert len(json.loads((tmp_path / "evaluations.json").read_text())["evaluations"]) == 2


@pytest.mark.slow
def test_an_fmu_is_the_plant_that_it_was_made_of(tmp_path: Path) -> None:
    model = plant(Robot.preset("antagonist"))
    build_fmu(model.block(), tmp_path / "plant.fmu")
    as_fmu, as_block = (
        tuned({"model": model, "own": own}).best.metrics
        for own in (partial(FmuPart, tmp_path / "plant.fmu", role="plant"), model.block())
    )
    assert as_fmu == pytest.approx(as_block, rel=1e-6)


def test_physics_stand_for_the_robot_and_not_for_a_neck() -> None:
    robot = Robot.preset("trunk4")
    task = task_of({"model": plant(robot), "physics": NeckParameters.preset("trunk")}, QUICK, 0)
    neck = task.own["physics"]
    assert isinstance(neck, VirtualNeck)
    assert neck.robot.hash == robot.hash
    assert [p.name for p in neck.block().inputs if p.name.startswith("motor_setpoint")] == [
        f"motor_setpoint_{k}" for k in range(1, 5)
    ]


def test_a_plant_of_another_robot_is_refused_before_anything_is_searched(tmp_path: Path) -> None:
    own, other = "antagonist", "trunk4"
    with pytest.raises(DataError, match="of two robots cannot be used together"):
        tune({"model": plant(Robot.preset(other)), "nonlinear": plant(Robot.preset(own))}, folder=tmp_path)
    with pytest.raises(SettingsError, match="own: needs the outputs"):
        tune(
            {"model": plant(Robot.preset("trunk4")), "own": plant(Robot.preset("antagonist")).block()}, folder=tmp_path
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_loops_step_from_where_the_robot_is_operated() -> None:
    """A sensor that reads 50 mm more moves the range by as much, and changes no metric of a step."""
    values = []
    for shift in (0.0, 50.0):
        outputs = replace(BELLOWS.outputs, min=(shift - 10.0,) * 3, max=(shift + 10.0,) * 3)
        robot = replace(BELLOWS, outputs=outputs)
        model, gain = plant(robot, gain=5e-8), 5e-8  # [m/Pa]
        offset = shift / 1e3 - gain * LEARNED @ np.full(4, 1.5e5)  # in the middle at 1.5 bar
        model = replace(model, arrays={**model.arrays, "offset": offset})
        controller = PiSettings().design(model)
        asked = task_of({"model": model, "own": model.block()}, QUICK, 0).asked.certificate
        assert start_of(robot) == pytest.approx(np.full(3, shift / 1e3))
        runs = run_loops(
            controller.block(), asked, order="sequential", observer=None, seed=0, progress=silent,
            own=[make_simulation_model(model.block(), "own", robot)],
        )  # fmt: skip
        values.append([run.metrics for run in runs])
        for run in runs:
            assert run.metrics["rise_s"] < 2.0
            assert run.metrics["steady_rms_deg"] < 0.05 * asked.sim["size_deg"]
    # Without shift loops start at the middle at once; with it, they move there before, to 1 % of the step.
    for at_once, moved in zip(*values, strict=True):
        assert moved["rise_s"] == pytest.approx(at_once["rise_s"], abs=2.0 * TS)
        assert moved["overshoot_pct"] == pytest.approx(at_once["overshoot_pct"], abs=1.0)


def test_every_step_is_judged_as_verify_does_and_with_a_noisy_sensor_each_direction_its_own() -> None:
    robot = Robot.preset("trunk4")
    task = task_of({"model": plant(robot), "own": plant(robot).block()}, QUICK | {"track": {}}, 3)
    ready, controller = prepare(task), PiSettings().design(plant(robot))
    quiet = {
        case.orientation for case in ready.all if case == replace(case, noise=False, late=False, circle=False, part=1.0)
    }
    assert quiet == {case.orientation for case in ready.all if case.noise}
    assert {case.late for case in ready.all} == {False, True}
    plain = [case for case in ready.all if case.noise and case.part == 1.0 and not case.late]
    loops = [loop_of(case, ready.own[0], controller.block(), "sequential", task) for case in plain]
    noise = [fault for loop in loops for fault in loop.faults if isinstance(fault, SensorFault)]
    assert len({fault.seed for fault in noise}) == len(loops) == 3
    assert {fault.std for fault in noise} == {math.radians(0.05)}


@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_a_step_has_a_share_of_every_output(outputs: int) -> None:
    robot = (Robot.preset("antagonist"), Robot.preset("trunk4"), BELLOWS)[outputs - 1]
    shares = direction(0.5, robot)
    assert len(shares) == outputs
    assert sum(share**2 for share in shares) == pytest.approx(1.0 if outputs > 1 else shares[0] ** 2)
