"""The registry of aggregated numbers is whole, and its `worst` keeps the laws of order."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pandas as pd
import pytest

from softneck import loop
from softneck.core import METRICS, SettingsError, metric_of, worst
from softneck.cosim import group_runs
from softneck.cosim.studies import _store
from softneck.design.plants._uncertain import StepAndLoadResult
from softneck.estimation._noise import Consistency, NoiseFit
from softneck.estimation._observer import FittedObserver
from softneck.identification import Draws
from softneck.identification.validation._validation import Validation
from softneck.robot import Robot
from softneck.verification import LARGE, SMALL, Scale, metric_names
from softneck.verification._linear import AxisMargins
from softneck.verification._structured import SearchResult

from ..order import MEMBERS, check_worst

PRESSURE = Robot.from_dict({"name": "bellows", "motors": {"names": ["a", "b"], "unit": "kPa"},
                            "outputs": {"names": ["tip"], "unit": "m", "display_unit": "mm"},
                            "directions": {"kind": "identified"}})  # fmt: skip
SCORES = ("fits", "rmse_deg", "r2", "worst_deg")
# Better when larger, without an end at zero.
RATIOS = ("fits", "r2", "cold_fits", "coverage", "coverage_pct", "log_likelihood")
# The numbers of a result that nobody aggregates: settings, instants, series, and what has no better direction.
NO_METRICS: dict[type, set[str]] = {
    Validation: {"persistence", "best_linear", "worst_time", "intervals", "per_run", "diverged", "calibrated_bounds",
                 "validity", "time", "run", "measured", "free_run", "one_step", "lower", "upper"},
    Consistency: {"inside", "mean", "mean_band"}, NoiseFit: {"noise", "start"}, FittedObserver: set(),
    Draws: {"arrays", "factor", "share", "keep", "noise", "level", "conditions"},
    AxisMargins: {"band", "crossover", "margins", "at"}, SearchResult: set(),
    StepAndLoadResult: {"angles", "inputs"},
}  # fmt: skip


def numbers_of(result: type) -> set[str]:
    """Return the fields of a result that hold floats, alone or in arrays and tables, but those of `NO_METRICS`."""
    kinds = re.compile(r"\b(float|Vector|Matrix|ndarray|Scores|Any)\b")
    named = {field.name for field in dataclasses.fields(result) if kinds.search(str(field.type))}
    assert NO_METRICS[result] <= named, "a field that went is named here"
    return named - NO_METRICS[result]


# What tells runs of a study apart and has no better direction.
NO_COLUMNS = {"kind", "runs"}


def columns_of_a_study(robot: Robot) -> set[str]:
    """Return the columns of a study's groups, of all metrics of its runs."""
    metrics = loop.metric_names(robot)
    holds = pd.array([True], "boolean")
    runs = pd.DataFrame({"kind": ["a"], "error": [""], "holds": holds, **{name: [1.0] for name in metrics}})
    return set(group_runs(runs, ["kind"], metrics).columns) - NO_COLUMNS


# What `softneck` states, for the neck and for a robot in other units.
STATED = sorted(
    {
        *(name for robot in (Robot.preset(), PRESSURE) for name in metric_names(robot, track=True)),
        *(name for robot in (Robot.preset(), PRESSURE) for name in loop.metric_names(robot)),
        *(name for robot in (Robot.preset(), PRESSURE) for name in columns_of_a_study(robot)),
        "validity.min", *SCORES, *(name for result in NO_METRICS for name in numbers_of(result)),
    }
)  # fmt: skip


@pytest.mark.parametrize("name", STATED)
def test_every_number_is_registered_and_its_worst_is_the_worst(name: str) -> None:
    check_worst(name, lambda values: worst(name, values))


def test_what_is_not_registered_fails() -> None:
    with pytest.raises(SettingsError, match="register it"):
        metric_of("sim.charm_pct")
    with pytest.raises(SettingsError, match="register it"):
        worst("charm", [1.0])


def test_every_entry_is_stated_somewhere() -> None:
    """An entry that no table has is a rest of something that went."""
    found = [metric_of(name) for name in STATED]
    assert [key for key, item in METRICS.items() if item not in found] == []


def test_margins_and_fits_are_better_when_larger_and_all_else_when_smaller() -> None:
    assert all(metric_of(name).larger for name in (*LARGE, "validity.min", "fits", "r2"))
    assert not any(metric_of(name).larger for name in SMALL)
    assert {key for key, item in METRICS.items() if item.larger} == {
        "disk_margin", "gain_margin", "phase_margin", "delay_margin", "min", "fits", "r2", "cold_fits", "coverage",
        "log_likelihood", "holds",
    }  # fmt: skip
    assert set(SCORES) <= numbers_of(Validation)


def test_a_number_of_a_result_that_is_neither_registered_nor_named_is_found() -> None:
    @dataclasses.dataclass(frozen=True)
    class Charming(Consistency):
        charm: dict[str, float] | None = None
        words: tuple[str, ...] = ()

    NO_METRICS[Charming] = NO_METRICS[Consistency]
    try:
        assert numbers_of(Charming) == {"charm"}
    finally:
        del NO_METRICS[Charming]


@pytest.mark.parametrize("robot", [Robot.preset(), PRESSURE], ids=["neck", "pressure"])
def test_a_loop_states_the_metrics_that_are_registered_for_its_robot_and_no_others(robot: Robot) -> None:
    t = 0.02 * np.arange(100)
    names = [*robot.set_points, *(f"{name}{end}" for name in robot.outputs.names for end in ("", "_reference"))]
    result = loop.LoopResult(t, dict.fromkeys(names, np.sin(t)) | {"validity": 1.0 + 0.0 * t}, {}, 0.02, robot=robot)
    found = loop.metrics(result)
    stated = {f"{group}.{name}" for group, values in found.items() for name in values}
    assert stated == {*loop.metric_names(robot), "validity.min"}


def test_a_column_of_a_study_that_is_not_registered_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_store, "_spread", lambda _: {"worst": 1.0})
    assert columns_of_a_study(PRESSURE) > {"failed", "holds [%]", "tip.rise_s worst"}
    for name in columns_of_a_study(PRESSURE):
        assert metric_of(name).larger is (name == "holds [%]")
    with pytest.raises(SettingsError, match="register it"):
        metric_of("charm [%]")


def test_the_longest_name_counts_and_units_do_not() -> None:
    assert metric_of("motors.max_rate_kPa_s") is METRICS["max_rate"]
    assert metric_of("motors.max_kPa") is METRICS["max"]
    assert metric_of("step.rise_s") is METRICS["rise"]
    assert Scale(robot=PRESSURE).name_of("load_rms_deg") == "load_rms_mm"
    assert metric_of("step.load_rms_mm") is METRICS["load_rms"]


def test_an_unknown_margin_is_none_and_an_unknown_error_infinite() -> None:
    for name in STATED:
        unknown = metric_of(name).unknown
        assert worst(name, [*MEMBERS, math.nan]) == worst(name, [math.nan, *MEMBERS]) == unknown
        assert unknown == (
            math.inf if not metric_of(name).larger else 0.0 if metric_of(name).of == "peak" else -math.inf
        )
