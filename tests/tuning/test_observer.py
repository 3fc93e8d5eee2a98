"""What plans by an observer is designed for it and judged in loops that have it; other kinds are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softneck.design import MpcSettings
from softneck.estimation import KalmanSettings, NonlinearObserver
from softneck.identification import FamilySettings, GreyBox, Model
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import Recording, signal
from softneck.tuning import tune
from softneck.tuning._judge import Case, design_candidate, loop_of, make_observer, prepare
from softneck.tuning._space import spaces
from softneck.tuning._task import Task, digest_of
from softneck.tuning._tune import _observer, task_of

from .test_requirements import neck


def log(payload: float, rows: int = 800) -> Recording:
    found = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=1, payload=payload).rows(0, rows)
    return found.with_channels(payload=np.full(rows, payload))


@pytest.fixture(scope="module")
def several() -> Model:
    """Two coarse steps of the search: enough for a law, not for a fit."""
    return GreyBox(evaluations=2, sensor_delay=2).fit([log(0.0), log(1.0)])


@pytest.fixture(scope="module")
def task(several: Model) -> Task:
    made = task_of({"linear": neck(), "own": several}, {}, 0)
    made = replace(made, observer=_observer(made))
    return replace(made, digest=digest_of(made, ("pi", "mpc"), None))


def controller(task: Task, kind: str) -> Any:
    (space,) = spaces((kind,), rise=0.4, cocontraction=None, robot=Robot.preset())
    return design_candidate(task, prepare(task), kind, space.settings(space.start))


def test_the_observer_is_over_the_model_that_knows_payloads(task: Task) -> None:
    assert isinstance(task.observer, NonlinearObserver)
    assert task.observer.payloads == (0.0, 1.0)


@pytest.mark.slow
def test_a_planner_takes_the_observers_lead_and_payload_into_its_design(task: Task) -> None:
    found, plain = controller(task, "mpc"), controller(replace(task, observer=None, digest="plain"), "mpc")
    assert found.design["settings"]["look_ahead"] == task.observer.lead > 0.0
    assert plain.design["settings"]["look_ahead"] == 0.0
    assert found.design["settings"]["payload_tautness"] == MpcSettings().over(task.observer).payload_tautness


@pytest.mark.parametrize("kind", ["pi", pytest.param("mpc", marks=pytest.mark.slow)])
def test_loops_have_the_observer_that_their_kind_is_designed_for(task: Task, kind: str) -> None:
    case, block = Case(0, 1.0), controller(task, kind).block()
    loop = loop_of(case, prepare(task).own[0], block, "sequential", task, make_observer(task, kind))
    if kind == "pi":
        assert loop.observer is None
    else:
        assert isinstance(loop.observer, BlockPart)
        told = {port.name for port in loop.observer.block.outputs}
        assert "payload" in told


def test_another_observer_is_another_search_only_for_kinds_that_plan_by_it(task: Task) -> None:
    other = replace(task, observer=KalmanSettings(sensor_delay=0.0).design(neck()))
    assert digest_of(task, ("pi", "lqg"), None) == digest_of(other, ("pi", "lqg"), None)
    assert digest_of(task, ("pi", "mpc"), None) != digest_of(other, ("pi", "mpc"), None)


@pytest.mark.slow
def test_what_is_never_certified_beside_recordings_is_searched_to_the_end_where_it_is_named(several: Model) -> None:
    kind = "adaptive"
    families = {f"{kg:g} kg": FamilySettings().fit(log(kg, 2000)) for kg in (0.0, 1.0)}
    found = tune({**families, "own": several}, kinds=(kind,), budget=4, workers=0)
    assert (found.best.kind, found.best.level) == (kind, "margins")
    assert not found.holds
    # What has no linear form has no Ms: it is not what stands in the way.
    assert found.binding in found.best.metrics
    assert not found.observed


def test_another_range_of_the_motors_is_another_search(task: Task) -> None:
    """Designs and judgements are kept by the digest, and saturate at the robot's limits."""
    robot = Robot.from_dict(task.robot.as_dict() | {"motors": task.robot.as_dict()["motors"] | {"rate_limit": 1.0}})
    assert robot.hash == task.robot.hash
    assert digest_of(replace(task, robot=robot), ("pi",), None) != digest_of(task, ("pi",), None)


def test_in_which_order_things_are_asked_is_no_other_search(task: Task) -> None:
    """Tables, the robot's keys and the metrics of `track` may stand in any order in their files."""

    def turned(value: Any) -> Any:
        return {k: turned(v) for k, v in reversed(value.items())} if isinstance(value, dict) else value

    asked = task.asked
    certificate = replace(
        asked.certificate,
        **{name: turned(dict(getattr(asked.certificate, name))) for name in ("uncertainty", "sampling", "step", "sim")},
    )
    other = replace(task, asked=replace(asked, track=turned(dict(asked.track)), certificate=certificate))
    assert digest_of(other, ("pi",), None) == digest_of(task, ("pi",), None)
    assert digest_of(replace(task, seed=task.seed + 1), ("pi",), None) != digest_of(task, ("pi",), None)
