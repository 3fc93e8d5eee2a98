"""A controller of one robot in other units, at another pace, renamed, in another order and turned: one verdict."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import pytest

from softneck.design import PiSettings
from softneck.tuning import tune
from softneck.verification import make_requirements, verify
from softneck.verification._metrics import Scale

from .models import model_of
from .worlds import PACES, PLANTS, UNITS, View, orders, world

VIEWS = [
    (name, view)
    for name, plant in PLANTS.items()
    for view in (*UNITS[name], *PACES, *orders(name), View(turned_motors=(-1,) * len(plant.weights[0])),
                 View(offset=plant.robot["motors"]["setpoint_max"]))
]  # fmt: skip
#: Of the defaults, but of tendons.
METRICS = [item.metric for item in make_requirements({"require": {"sim.slack_s": False}}).bounds]


def asked(scale: Scale, **more: Any) -> dict[str, Any]:
    """Few plants; noise is drawn for the axes in their order, so there is none."""
    quiet = {scale.name_of("noise_deg"): 0.0}
    return {"sampling": {"plants": 24, "search_generations": 0}, "step": quiet, "sim": {"necks": 0}, **more}


@cache
def verdicts(name: str, view: View) -> dict[str, tuple[float, bool | None]]:
    """Return metric -> value over its limit and verdict, by the neck's name."""
    seen = world(name, view)
    model, scale = model_of(seen), Scale(robot=seen.robot)
    found = verify(PiSettings().design(model), model, asked(scale))
    assert {item.requirement.metric for item in found.verdicts} == {scale.name_of(metric) for metric in METRICS}
    values = [float("nan") if item.value is None else item.value / item.requirement.limit for item in found.verdicts]
    return {metric: (value, item.holds) for metric, value, item in zip(METRICS, values, found.verdicts, strict=True)}


def check(name: str, view: View) -> None:
    plain, seen = verdicts(name, View()), verdicts(name, view)
    for metric, (ratio, holds) in plain.items():
        # Designs are bisected to 1e-3 or finer, and begin in scaled quantities that rounding alone tells apart.
        assert seen[metric] == (pytest.approx(ratio, rel=1e-6, abs=1e-6, nan_ok=True), holds), metric


@pytest.mark.parametrize(("name", "view"), [("finger", UNITS["finger"][0]), ("joint", PACES[1])])
def test_a_verdict_does_not_depend_on_units_or_pace(name: str, view: View) -> None:
    check(name, view)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "view"), VIEWS)
def test_a_verdict_is_the_same(name: str, view: View) -> None:
    check(name, view)


@cache
def tuned(name: str, view: View, *, stepping: bool) -> list[float]:
    """Return of the best of three candidates each metric over its limit; circles are of two angles alone."""
    seen = world(name, view)
    model, scale = model_of(seen), Scale(robot=seen.robot)
    plants = {"m": model, "own": model.block()} if stepping else {"m": model}
    quiet = {scale.name_of("noise_deg"): 0.0}
    found = tune(plants, asked(scale, track=quiet), kinds="pi", budget=3, workers=0)
    bounds = [bound for bound in found.task.asked.bounds if not bound.metric.startswith("track.")]
    return [found.best.metrics.get(bound.metric, math.nan) / bound.limit for bound in bounds]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "view"), VIEWS)
def test_a_search_is_the_same_on_linear_plants(name: str, view: View) -> None:
    plain, seen = (tuned(name, each, stepping=False) for each in (View(), view))
    assert len(plain) > 10
    # As a verdict's; settings are rounded to four digits.
    assert seen == pytest.approx(plain, rel=1e-6, abs=1e-6, nan_ok=True)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("view", [*UNITS["joint"], PACES[0], PACES[2]])
def test_a_search_over_a_simulation_is_the_same(view: View) -> None:
    plain, seen = (tuned("joint", each, stepping=True) for each in (View(), view))
    assert seen == pytest.approx(plain, rel=1e-6, abs=1e-6, nan_ok=True)
