"""The payloads of the requirements in the loops over a user's own plants: carried where one knows them, else said."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError, load, silent
from softneck.loop import LoopResult, RobotReference
from softneck.plant import NeckParameters
from softneck.robot import Robot
from softneck.verification import Scale, _neck_loops, make_requirements
from softneck.verification._neck_loops import (
    AroundMiddle,
    SimulationModel,
    check_blocks,
    judged_elsewhere,
    make_simulation_model,
    named_plants,
    rows_of,
    run_loops,
    start_of,
    step_time,
    without_lead,
)

from ..data import ROOT
from ..identification.structured.test_payload import at
from .necks import QUICK, pi

GREYBOX = ROOT / "tests" / "golden" / "greybox.npz"


def plant_with(payload: str, seen: list[float]) -> SimulationModel:
    return replace(
        make_simulation_model(NeckParameters.paper(), "own"), payload=payload, conditions={"payload_kg": seen}
    )


ASKED = [0.0, 0.32, 0.5, 1.0]


@pytest.mark.parametrize(
    ("payload", "seen", "judged", "told"),
    [
        ("inputs", [0.0, 0.0], ASKED, {}),
        ("parameters", [0.0, 1.0], ASKED, {}),
        ("parameters", [0.35, 1.0], [0.35, 0.5, 1.0], {0.0: "0.35", 0.32: "0.35"}),
        # The ends of the recordings are judged, asked or not.
        ("parameters", [0.0, 1.2], [*ASKED, 1.2], {}),
        ("parameters", [0.7, 0.8], [0.7, 0.8], {0.0: "0.7", 0.32: "0.7", 0.5: "0.7", 1.0: "0.8"}),
        ("parameters", [0.4, 0.4], [0.4], {0.0: "0.4", 0.32: "0.4", 0.5: "0.4", 1.0: "0.4"}),
        ("", [0.0, 0.0], [0.0], {0.32: "", 0.5: "", 1.0: ""}),
        ("", [0.3, 0.6], [0.0], {0.0: "", 1.0: ""}),
    ],
)
def test_each_payload_asked_is_judged_at_the_nearest_known_and_said(
    payload: str, seen: list[float], judged: list[float], told: dict[float, str]
) -> None:
    plant = plant_with(payload, seen)
    assert plant.payloads(ASKED) == judged
    found = judged_elsewhere([plant], make_requirements({**QUICK, "sim": {"payloads_kg": ASKED}}))
    assert list(found) == [f"payload {kg:g} kg of own" for kg in told]
    for how, kg in zip(found.values(), told.values(), strict=True):
        assert how.startswith(f"judged at {kg} kg, it was recorded with" if kg else "judged as recorded, ")
    # Asked, judged and told: each payload is judged as it is, or told.
    assert not payload or set(ASKED) <= set(judged) | set(told)


def test_each_direction_asked_is_judged_or_said() -> None:
    asked = {"sim": {"orientations_deg": [0.0, 90.0]}}
    assert not judged_elsewhere([], make_requirements(asked))
    one = make_requirements(asked, scale=Scale(robot=Robot.preset("finger")))
    assert judged_elsewhere([], one) == {
        "directions": f"{one.robot.outputs.names[0]} is the only output, so all of `orientations_deg` are one step"
    }


def test_loops_over_a_model_of_several_payloads_carry_each() -> None:
    """They are those over the model of that payload alone."""
    plain = load(GREYBOX)
    several = replace(
        plain, arrays={**plain.arrays, "payload": np.array([0.0, 1.0, -3.0, -0.2])},
        findings={**plain.findings, "conditions": {"payload_kg": [0.0, 1.0]}},
    )  # fmt: skip
    few = make_requirements({**QUICK, "sim": {"payloads_kg": [0.0, 1.0], "orientations_deg": [0.0], "duration_s": 2.5}})

    def angles(model: Any) -> list[np.ndarray]:
        own = [make_simulation_model(model, "m")]
        runs = run_loops(pi().block(), few, order="sequential", observer=None, seed=0, progress=silent, own=own)
        return [run.result.angle("pitch") for run in runs if run.result is not None]

    light, heavy = angles(several)
    np.testing.assert_array_equal(light, angles(at(several, 0.0))[0])
    np.testing.assert_array_equal(heavy, angles(at(several, 1.0))[0])
    assert not np.array_equal(light, heavy)


# -- the loops of a robot ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["neck", "antagonist", "trunk4"])
def test_a_direction_is_shared_by_the_first_two_outputs(preset: str) -> None:
    robot = Robot.preset(preset)
    shares = _neck_loops.direction(math.radians(30.0), robot)
    assert shares == pytest.approx((math.cos(math.pi / 6.0), 0.5, 0.0, 0.0)[: len(robot.outputs.names)])
    assert len(shares) == len(robot.outputs.names)


BENT = Robot.from_dict({
    "name": "bent", "extends": "antagonist", "time_constant_s": 0.4,
    "outputs": {"rest": [0.2], "min": [0.1], "max": [1.1]}, "motors": {"rest": [0.5, 0.7]},
})  # fmt: skip


def controller_with(pull: float | None = None) -> Any:
    port = SimpleNamespace(name="least_cocontraction", start=pull)
    return SimpleNamespace(parameters=() if pull is None else (port,), sample_time=0.02, inputs=())


def test_a_step_waits_for_what_moves_before_it_in_the_seconds_of_the_robot() -> None:
    neck, bent = make_requirements({}), make_requirements({}, robot=BENT)
    assert bent.scale.time == pytest.approx(2.0)
    for pull, begin in ((None, 0.5), (0.0, 0.5), (0.3, 3.0)):
        assert step_time(controller_with(pull), neck) == begin
        assert step_time(controller_with(pull), bent) == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("low", "high", "tendons", "start"),
    [(-0.4, 1.0, True, 0.0), (0.0, 1.0, True, 0.0), (-1.0, 0.0, True, 0.0), (0.5, 1.0, True, 0.2),
     (-1.0, -0.5, True, 0.2), (None, None, True, 0.0), (-0.4, 1.0, False, 0.2)],
)  # fmt: skip
def test_loops_start_upright_where_tendons_bend_to_it_and_else_in_the_middle(
    low: float | None, high: float | None, tendons: bool, start: float
) -> None:
    ends = {} if low is None else {"min": [low], "max": [high]}
    directions = {} if tendons else {"directions": {"kind": "matrix", "matrix": [[1.0, -1.0]]}, "neck": None}
    base = Robot.from_dict({"name": "r", "extends": "antagonist", **{k: v for k, v in directions.items() if v}})
    robot = replace(base, outputs=replace(base.outputs, **{"min": None, "max": None}, rest=(0.2,)))
    robot = replace(robot, outputs=replace(robot.outputs, **{key: tuple(value) for key, value in ends.items()}))
    assert start_of(robot).tolist() == [start]


def test_a_reference_about_the_middle_leads_there_first_and_is_cut_off_before_it_is_judged() -> None:
    asked = make_requirements({}, robot=BENT)
    steps = RobotReference(kind="step", values=(0.05,), at=6.0)
    led = AroundMiddle.of(steps, controller_with(), asked)
    assert isinstance(led, AroundMiddle)
    assert led.outputs == pytest.approx((0.2,))
    assert (led.cocontraction, led.lead) == pytest.approx((0.6, 2.0))
    assert led(0.0) == pytest.approx((0.0, 0.0))
    half = led(0.5 * led.lead)
    assert half == pytest.approx((0.1, 0.3))
    assert led(5.99) == pytest.approx((0.2, 0.6))
    assert led(6.01) == pytest.approx((0.25, 0.6))
    # A co-contraction that is asked for goes first.
    asked_for = replace(led, reference=lambda _: (0.0, 0.9))
    assert asked_for(5.0) == pytest.approx((0.2, 0.9))
    assert AroundMiddle.of(steps, controller_with(), make_requirements({})) is steps
    time = np.arange(500) * 0.02
    whole = LoopResult(time, {"x": time.copy()}, {}, 0.02)
    judged = without_lead(whole, led)
    first = round(led.lead / 0.02)
    assert (judged.time[0], judged["x"][0], len(judged.time)) == (time[first], time[first], 500 - first)
    assert without_lead(whole, steps) is whole
    part = rows_of(whole, 3, 7)
    assert (part.time.tolist(), part["x"].tolist()) == (time[3:7].tolist(), time[3:7].tolist())


def test_plants_are_named_by_their_files_or_numbers_each_by_its_own() -> None:
    thing = NeckParameters.paper()
    assert list(named_plants(thing)) == ["plant"]
    assert list(named_plants([thing])) == ["plant"]
    assert list(named_plants([thing, thing])) == ["plant 1", "plant 2"]
    assert list(named_plants({"a": thing, 3: thing})) == ["a", "3"]
    assert list(named_plants("paper")) == ["paper"]
    assert list(named_plants((thing, "paper"))) == ["plant 1", "paper"]


def test_a_random_neck_is_one_that_its_tendons_do_not_buckle(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def virtual(parameters: Any, robot: Any = None) -> Any:
        del robot
        tried.append(1)
        if len(tried) < most:
            raise SettingsError("buckles")
        return SimpleNamespace(parameters=parameters)

    plant: Any = SimpleNamespace(robot=None, parameters=SimpleNamespace(sample=lambda _rng, spread: ("near", spread)))
    monkeypatch.setattr(_neck_loops, "VirtualNeck", virtual)
    rng = np.random.default_rng(0)
    for most in (1, 3, 100):
        tried.clear()
        assert _neck_loops._sample_neck(plant, rng, 0.1) == ("near", 0.1)
        assert len(tried) == most
    most = 101
    tried.clear()
    with pytest.raises(SettingsError, match=r"no random neck within a spread of 0\.1 supports its tendons"):
        _neck_loops._sample_neck(plant, rng, 0.1)


@pytest.mark.parametrize("count", [1, 3])
def test_necks_near_the_virtual_one_are_drawn_with_their_spread_and_numbered(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = make_requirements({"sim": {"necks": count, "spread_pct": 10.0}})
    found, again = _neck_loops._virtual(asked, 4), _neck_loops._virtual(asked, 4)
    assert [plant.name for plant in found] == ["paper", "paper varied 1", "paper varied 2"][:count]
    assert found[0].parameters == NeckParameters.paper()
    assert [plant.parameters for plant in found] == [plant.parameters for plant in again]
    for plant in found[1:]:
        assert plant.parameters is not None
        assert _neck_loops.neck_changes(plant.parameters, Robot.preset())
    spreads: list[float] = []
    monkeypatch.setattr(
        _neck_loops, "_sample_neck", lambda plant, _, spread: spreads.append(spread) or plant.parameters
    )
    _neck_loops._virtual(asked, 4)
    assert spreads == [0.1] * (count - 1)
    assert _neck_loops.neck_changes(NeckParameters.paper(), Robot.preset()) == {}


def test_an_observer_runs_as_often_as_its_controller() -> None:
    for factor in (1.0, 1.0 + 5e-10, 1.0 - 5e-10):
        check_blocks(controller_with(), SimpleNamespace(sample_time=0.02 * factor))  # pyright: ignore[reportArgumentType]
    for factor in (1.0 + 2e-9, 1.0 - 2e-9, 2.0):
        with pytest.raises(SettingsError, match="the observer has a sample time of"):
            check_blocks(controller_with(), SimpleNamespace(sample_time=0.02 * factor))  # pyright: ignore[reportArgumentType]
    check_blocks(controller_with(), None)


@pytest.mark.parametrize(
    ("value", "ends", "more", "inside"),
    [(1.0, [1.0, 2.0], 0.0, True), (2.0, [2.0, 1.0], 0.0, True), (2.1, [1.0, 2.0], 0.0, False),
     (2.1, [1.0, 2.0], 0.1000001, True), (0.9, [1.0, 2.0], 0.0999, False), (0.9, [1.0], 0.1000001, True),
     (math.nan, [1.0, 2.0], 1.0, False)],
)  # fmt: skip
def test_what_was_recorded_is_between_its_ends(value: float, ends: list[float], more: float, inside: bool) -> None:
    assert _neck_loops._within(value, ends, more) is inside


def test_a_plant_covers_what_it_was_identified_at() -> None:
    def plant(payload: str, **conditions: list[float]) -> Any:
        return SimpleNamespace(payload=payload, conditions=conditions)

    covers = _neck_loops._covers
    assert covers(plant("inputs"), 9.0, 9.0)
    assert covers(plant(""), 0.0, 9.0)
    assert not covers(plant(""), 0.1, 0.0)
    known = plant("parameters", payload_kg=[0.35, 1.0], cocontraction=[0.5, 0.8])
    for kg, held, inside in ((0.35, 0.5, True), (1.0, 0.8, True), (0.34, 0.6, False), (1.01, 0.6, False),
                             (0.5, 0.4001, True), (0.5, 0.8999, True), (0.5, 0.39, False),
                             (0.5, 0.91, False)):  # fmt: skip
        assert covers(known, kg, held) is inside
