"""What plans by an observer is designed for it and judged in loops that have it; other kinds are not."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import MpcSettings
from softneck.estimation import KalmanSettings, NonlinearObserver
from softneck.identification import FamilySettings, GreyBox, Model
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import Recording, signal
from softneck.tuning import _certify, _judge, _tune, tune
from softneck.tuning._judge import Case, design_candidate, loop_of, make_observer, prepare
from softneck.tuning._space import spaces
from softneck.tuning._task import Task, digest_of
from softneck.tuning._tune import _observer, task_of

from ..design.test_robots import plant
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
    tested = {"a": 1, "b": {"c": 2, "d": 3}}
    one, same = (with_findings(task, tested=findings) for findings in (tested, turned(tested)))
    assert digest_of(one, ("pi",), None) == digest_of(same, ("pi",), None)
    assert digest_of(replace(task, seed=task.seed + 1), ("pi",), None) != digest_of(task, ("pi",), None)


def with_findings(task: Task, **findings: Any) -> Task:
    model = plant(Robot.preset())
    return replace(task, linear={"linear": replace(model, findings={**model.findings, **findings})})


def with_own(task: Task, thing: Any) -> Task:
    return replace(task, own={"own": thing})


def block(runtime: str = "r", sample_time: float = 0.02, start: float = 0.0, number: float = 1.0) -> Any:
    ports = (SimpleNamespace(name="p", start=start),)
    return SimpleNamespace(runtime=runtime, sample_time=sample_time, parameters=ports, arrays=(np.eye(2), [number]))


def wrapped(**numbers: Any) -> Any:
    return SimpleNamespace(block=lambda: block(**numbers))


def asked(task: Task, **fields: Any) -> Task:
    return replace(task, asked=replace(task.asked, **fields))


def bounds(task: Task, **fields: Any) -> Task:
    return asked(task, bounds=(replace(task.asked.bounds[0], **fields), *task.asked.bounds[1:]))


def table(task: Task, name: str) -> Task:
    told = dict(getattr(task.asked.certificate, name))
    key = next(key for key, value in told.items() if isinstance(value, float))
    return asked(task, certificate=replace(task.asked.certificate, **{name: told | {key: told[key] + 0.01}}))


TWO_SEARCHES: dict[str, Any] = {
    "seed": (lambda t: t, lambda t: replace(t, seed=1)),
    "limit": (lambda t: t, lambda t: bounds(t, limit=0.5)), "bound": (lambda t: t, lambda t: bounds(t, bound="min")),
    "stated": (lambda t: t, lambda t: bounds(t, asked=True)),
    "track": (lambda t: t, lambda t: asked(t, track={**t.asked.track, "delay_ms": 7.0})),
    **{name: (lambda t: t, lambda t, name=name: table(t, name)) for name in ("uncertainty", "step", "sim")},
    "name": (lambda t: t, lambda t: replace(t, linear={"other": t.linear["linear"]})),
    "own name": (lambda t: t, lambda t: replace(t, own={"other": t.own["own"]})),
    "linear": (lambda t: t, lambda t: replace(t, linear={"linear": neck(delay=5)})),
    "tested": (lambda t: with_findings(t, tested=1), lambda t: with_findings(t, tested=2)),
    "directions": (lambda t: with_findings(t, directions=[[1.0, -0.5, -0.5], [0.0, 0.8, -0.8]]),
                   lambda t: with_findings(t, directions=[[1.0, -0.5, -0.5], [0.0, 0.9, -0.9]])),
    **{f"own block's {name}": (lambda t: with_own(t, wrapped()), lambda t, name=name, value=value:
                               with_own(t, wrapped(**{name: value})))
       for name, value in (("runtime", "s"), ("sample_time", 0.01), ("start", 1.0), ("number", 2.0))},
    "own arrays": (lambda t: with_own(t, block()), lambda t: with_own(t, block(number=2.0))),
    "own function": (lambda t: with_own(t, partial(block, number=1.0)),
                     lambda t: with_own(t, partial(block, number=2.0))),
    "second own": (lambda t: replace(t, own={"a": block(), "b": block()}),
                   lambda t: replace(t, own={"a": block(), "b": block(number=2.0)})),
}  # fmt: skip


@pytest.mark.parametrize("wrap", [lambda thing: thing, lambda thing: SimpleNamespace(block=lambda: thing)])
def test_how_a_plant_keeps_its_numbers_is_no_other_search(task: Task, wrap: Any) -> None:
    other = block()
    other.arrays, other.memo = [np.asfortranarray(np.eye(2)), np.array([1.0])], "kept"
    digests = [digest_of(with_own(task, wrap(thing)), ("pi",), None) for thing in (block(), other)]
    assert digests[0] == digests[1]


@pytest.mark.parametrize("what", TWO_SEARCHES)
def test_each_number_that_a_search_is_of_makes_it_another(task: Task, what: str) -> None:
    """A log is continued, and designs are kept, by the digest alone."""
    digests = [digest_of(make(task), ("pi",), None) for make in (*TWO_SEARCHES[what], *TWO_SEARCHES[what])]
    assert digests[:2] == digests[2:]
    assert digests[0] != digests[1]


def test_a_search_over_files_is_of_what_they_hold_wherever_they_are(task: Task) -> None:
    def digest(*files: tuple[str, str], kinds: tuple[str, ...] = ("pi",)) -> str:
        return digest_of(task, kinds, {str(k): file for k, file in enumerate(files)})

    one = digest(("a.npz", "1"), ("b.npz", "2"))
    assert digest(("c.npz", "1"), ("d.npz", "2")) == one
    others = [digest(("a.npz", "1"), ("b.npz", "3")), digest(("a.npz", "1")), digest_of(task, ("pi",), None),
              digest(("a.npz", "1"), ("b.npz", "2"), kinds=("pid",))]  # fmt: skip
    assert len({one, *others}) == 5
    # Plants of files are told by them: their numbers are not read again.
    moved = replace(task, linear={"linear": neck(delay=5)})
    assert digest_of(moved, ("pi",), {"0": ("a.npz", "1"), "1": ("b.npz", "2")}) == one


@pytest.mark.parametrize("observer", [None, "eyes"])
@pytest.mark.parametrize("over", [True, False])
def test_a_kind_is_designed_once_over_the_observer_if_it_can_be(
    observer: Any, over: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    class Plain:
        def design(self, plant: Any) -> list[Any]:
            made.append(plant)
            return [plant, getattr(self, "eyes", None)]

    class Over(Plain):
        eyes: Any = None

        def over(self, eyes: Any) -> Any:
            found = Over()
            found.eyes = eyes
            return found

    monkeypatch.setattr(_judge, "make_settings", lambda *_: Over() if over else Plain())
    task: Any = SimpleNamespace(observer=observer, plant="plant")
    ready: Any = SimpleNamespace(kept={})
    first = design_candidate(task, ready, "mpc", {"a": 1, "b": 2})
    assert first == ["plant", observer if over else None]
    assert design_candidate(task, ready, "mpc", {"b": 2, "a": 1}) is first
    assert made == ["plant"]
    assert design_candidate(task, ready, "mpc", {"a": 1, "b": 3}) is not first
    assert design_candidate(task, ready, "lqg", {"a": 1, "b": 2}) is not first


@pytest.mark.parametrize("observer", [None, SimpleNamespace(block=lambda: "eyes")])
@pytest.mark.parametrize(("kind", "over"), [("pi", False), ("mpc", True), ("nmpc", True)])
def test_the_loops_of_a_search_have_an_observer_where_there_is_one_and_the_kind_takes_it(
    observer: Any, kind: str, over: bool
) -> None:
    task: Any = SimpleNamespace(observer=observer)
    assert make_observer(task, kind) == ("eyes" if observer is not None and over else None)


@pytest.mark.parametrize("refused", [(), ("b",), ("b", "c"), ("b", "c", "a")])
def test_the_default_observer_is_over_the_first_model_with_payloads_that_has_one_else_the_nominal_plant(
    refused: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Kalman:
        def design(self, model: Any) -> str:
            if model.name in refused:
                raise SettingsError("no")
            return model.name

    monkeypatch.setattr(_tune, "KalmanSettings", Kalman)
    monkeypatch.setattr(_tune, "payloads", lambda arrays: arrays or None)
    linear, plain, light, heavy = (
        SimpleNamespace(name=name, arrays=arrays) for name, arrays in (("a", ()), ("x", ()), ("b", (1,)), ("c", (1,)))
    )
    task: Any = SimpleNamespace(models=[plain, light, heavy], linear={"first": linear, "second": plain})
    assert _observer(task) == next((name for name in "bca" if name not in refused), None)


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("eyes", [None, SimpleNamespace(block=lambda: "seen")])
@pytest.mark.parametrize("planned", [True, False])
@pytest.mark.parametrize("failed", [(), (7,)])
def test_a_loop_is_delivered_with_the_observer_that_its_kind_needs_or_over_which_its_steps_and_draws_hold(
    held: bool, own: bool, eyes: Any, planned: bool, failed: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen on a valve in kPa: a filter of 2 ms took the gain margin of 43 of 59 draws, steps alone did not show it."""
    monkeypatch.setattr(_certify, "make_observer", lambda *_: "eyes" if planned else None)
    monkeypatch.setattr(_certify, "holds_with_observer", lambda *_: held)
    task: Any = SimpleNamespace(observer=eyes, own={"p": 1} if own else {}, bounds=())
    item: Any = SimpleNamespace(kind="pi", metrics={"sim.rise_s": 0.5})
    # A loop over the second family fails, or its slowest draw rises later, with this observer in it.
    for rise, soon in ((0.5, True), (0.51, False), (math.nan, False)):
        drawn = [SimpleNamespace(failed=(), values={"sim.rise_s": np.array([0.4])}),
                 SimpleNamespace(failed=failed, values={"sim.rise_s": np.array([0.3, rise])})]  # fmt: skip
        monkeypatch.setattr(_certify, "_drawn_in_search", lambda *told, drawn=drawn: drawn if told[2] == "seen" else [])
        wanted = planned or (eyes is not None and own and held and not failed and soon)
        assert _certify._observed(task, item) is wanted
