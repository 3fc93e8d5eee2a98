"""The registry of aggregated numbers is whole, and its `worst` keeps the laws of order."""

from __future__ import annotations

import dataclasses
import math

import pytest

from softneck import loop
from softneck.core import METRICS, SettingsError, metric_of, worst
from softneck.identification.validation._validation import Validation
from softneck.robot import Robot
from softneck.verification import LARGE, SMALL, Scale, metric_names

from ..order import MEMBERS, check_worst

PRESSURE = Robot.from_dict({"name": "bellows", "motors": {"names": ["a", "b"], "unit": "kPa"},
                            "outputs": {"names": ["tip"], "unit": "m", "display_unit": "mm"},
                            "directions": {"kind": "identified"}})  # fmt: skip
SCORES = ("fits", "rmse_deg", "r2", "worst_deg")
# What `softneck` states, for the neck and for a robot in other units.
STATED = sorted(
    {
        *(name for robot in (Robot.preset(), PRESSURE) for name in metric_names(robot, track=True)),
        *(name for robot in (Robot.preset(), PRESSURE) for name in loop.metric_names(robot)),
        "validity.min", *SCORES,
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
        "disk_margin", "gain_margin", "phase_margin", "delay_margin", "min", "fits", "r2",
    }  # fmt: skip
    tables = {field.name for field in dataclasses.fields(Validation)}
    assert set(SCORES) <= tables


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
        assert unknown == (math.inf if not metric_of(name).larger else -math.inf if name in SCORES else 0.0)
