"""Findings on a recording and its excitation do not depend on units, pace, names, order or signs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softneck.robot import Robot
from softneck.signals import assess_quality, signal, signal_names
from softneck.signals.quality._excitation import explained_variance, poor_excitation

from .worlds import PACES, PLANTS, UNITS, View, World, orders, without_limits, world

_VIEWS = [(name, view) for name in PLANTS for view in (*UNITS[name], *PACES, *orders(name))]


def set_dead_time(seen: World) -> World:
    """Return the world with a robot that gives its time constant."""
    plant = seen.plant
    seconds = plant.time_constant * plant.robot["sample_time_s"] * seen.view.pace
    robot = Robot.from_dict(seen.robot.as_dict() | {"time_constant_s": seconds})
    return replace(seen, robot=robot, recording=replace(seen.recording, robot=robot))


def damaged(seen: World) -> World:
    """Return the world whose first output misses rows, jumps once, and whose first motor is clipped where it is."""
    channels = {name: values.copy() for name, values in seen.recording.channels.items()}
    first = seen.robot.outputs.names[list(seen.view.outputs or [0]).index(0)]
    values = channels[first]
    middle, span = float(np.mean(values)), float(np.ptp(values))
    values[200] = middle + (2.0 * span if values[200] < middle else -2.0 * span)
    values[100:107] = np.nan
    return replace(seen, recording=replace(seen.recording, channels=channels))


def findings(seen: World) -> list[tuple[str, str]]:
    return sorted((finding.severity, finding.topic) for finding in assess_quality(seen.recording).findings)


@pytest.mark.parametrize(("name", "view"), _VIEWS)
def test_findings_are_the_same_in_every_view(name: str, view: View) -> None:
    plain, seen = (damaged(set_dead_time(world(name, v))) for v in (View(), view))
    assert findings(seen) == findings(plain)
    found, expected = assess_quality(seen.recording), assess_quality(plain.recording)
    assert found.directions == expected.directions
    assert found.spectrum.bandwidth * view.pace == pytest.approx(expected.spectrum.bandwidth, rel=1e-12)
    for key in ("below_bandwidth", "crest"):
        # Sums of 400 rounded products, and columns in another order.
        ours, plains = sorted(getattr(found.spectrum, key)), sorted(getattr(expected.spectrum, key))
        np.testing.assert_allclose(ours, plains, rtol=1e-9)


@pytest.mark.parametrize("name", PLANTS)
def test_outliers_and_dropouts_are_found(name: str) -> None:
    topics = {topic for severity, topic in findings(damaged(set_dead_time(world(name)))) if severity != "ok"}
    assert {"dropouts", "outliers"} <= topics


@pytest.mark.parametrize(("name", "view"), _VIEWS)
def test_what_motors_explain_is_the_same_without_limits_too(name: str, view: View) -> None:
    plain, seen = (without_limits(world(name, v)) for v in (View(), view))
    order = list(view.outputs or range(len(seen.robot.outputs.names)))
    # Least squares on data that differ by rounding: singular values near the cut are left out on both sides.
    np.testing.assert_allclose(
        explained_variance(seen.recording), explained_variance(plain.recording)[order], rtol=1e-6
    )
    assert len(poor_excitation(seen.recording)) == len(poor_excitation(plain.recording))


@pytest.mark.parametrize("name", signal_names())
def test_a_signal_is_the_same_at_the_pace_of_its_robot(name: str) -> None:
    for pace in (0.1, 1000.0):
        first, other = (_played(name, set_dead_time(world("arm", View(pace=p)))) for p in (1.0, pace))
        assert other.time.size == first.time.size
        np.testing.assert_allclose(other.time, pace * first.time, rtol=1e-12)
        # Instants on the border between two levels move by rounding: a row in a thousand may differ.
        same = np.isclose(other.set_points, first.set_points, rtol=1e-6, atol=1e-6 * np.abs(first.set_points).max())
        assert same.mean() > 0.999, pace


def _played(name: str, seen: World) -> Any:
    return signal(name, duration=80.0 * (seen.robot.time_constant_s or np.nan), seed=3, robot=seen.robot)


def test_a_signal_of_a_robot_of_the_necks_time_constant_takes_the_necks_time() -> None:
    neck = Robot.preset("neck")
    slow = replace(neck, time_constant_s=2.0, sample_time_s=0.2)
    one, other = signal("mixed", robot=neck, seed=1), signal("mixed", robot=slow, seed=1)
    assert other.time.size == one.time.size
    np.testing.assert_allclose(other.time, 10.0 * one.time, rtol=1e-12)
    with pytest.raises(Exception, match="260 s long by definition"):
        signal("steps", robot=slow, duration=300.0)
