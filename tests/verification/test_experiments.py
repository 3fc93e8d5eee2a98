"""Margins by experiment: on linear plants they are the closed forms, on others what the loop really stands."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block
from softneck.verification import linear_plant
from softneck.verification._experiments import (
    _POSTURES,
    _SMALL,
    Crossing,
    LoopUnderTest,
    _Case,
    _first_crossing,
    _group,
    crossing_values,
    crossings,
)
from softneck.verification._linear import LinearLaw, judged, margins
from softneck.verification._plants import Plants, all_plants, neck_of_family

from .necks import TS, family, pi

W = judged(TS, 20_000)


def over(plants: Plants, row: int, *, cross: float = 0.0) -> LoopUnderTest:
    block = linear_plant(
        numerator=plants.numerator[row], denominator=plants.denominator[row], delay=plants.delay[row].tolist(),
        cross=(cross, cross), sample_time=TS,
    )  # fmt: skip
    inputs = {"load_pitch": 0.0, "load_roll": 0.0}
    return LoopUnderTest(
        name="p", plant=lambda: BlockPart(block), controller=pi().block(), inputs=inputs, compiled=False
    )


def first(loop: LoopUnderTest, axes: str, what: str) -> float:
    """The first crossing of a small kick from upright."""
    case = _Case(loop, axes, what, _SMALL, _POSTURES[0])
    return _first_crossing(case, case.floor(), math.inf, False)


@pytest.mark.slow
@pytest.mark.parametrize("row", [0, 3])
def test_on_linear_plants_the_margins_are_the_closed_forms_to_one_percent(row: int) -> None:
    plants = all_plants([neck_of_family(family(), "f")], 12, 0)
    expected = margins(plants.take([row]), LinearLaw.of(pi().ss()), W)
    loop = over(plants, row)
    up = first(loop, "pitch", "gain_up")
    assert up == pytest.approx(expected["pitch.gain_margin"][0], rel=0.01)
    late = first(loop, "pitch", "delay")
    # The straight line between two samples is 0.5 % short at the crossover, for 1 % of delay.
    assert 1e3 * late == pytest.approx(expected["pitch.delay_margin_ms"][0], rel=0.01)
    # A loop whose plant is stable stands any smaller gain.
    assert math.isinf(first(loop, "pitch", "gain_down"))


@pytest.mark.slow
def test_only_the_axis_that_is_raised_counts_and_both_at_once_are_found_through_the_cross_gain() -> None:
    plants = all_plants([neck_of_family(family(), "f")], 12, 0)
    alone = over(plants, 0)
    pitch, both = (first(alone, axes, "gain_up") for axes in ("pitch", "both"))
    # Two equal axes without coupling: jointly they stand what each stands.
    assert both == pytest.approx(pitch, rel=0.01)
    crossed = over(plants, 0, cross=0.4)
    joint = first(crossed, "both", "gain_up")
    # Equal axes with c from each to the other are two loops of 1 + c and 1 - c times the gain.
    assert joint == pytest.approx(pitch / 1.4, rel=0.015)


def test_an_unstable_loop_has_no_margin_and_an_overflow_is_an_oscillation() -> None:
    plants = all_plants([neck_of_family(family(), "f")], 12, 0)
    slow = plants.take([0]).later(20)
    found = _group(over(slow, 0), "pitch", "gain_up", False)
    assert min(item.value for item in found) == 1.0


def test_the_first_crossing_is_found_where_stability_is_not_monotone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loud between 1.5 and 2 and beyond 6: 1.5 is the margin."""

    def windows(case: _Case, gain: float, delay: float) -> tuple[float, float]:
        del case, delay
        loud = 1.5 < gain < 2.0 or gain > 6.0
        return (1.0, 1.0) if loud else (1.0, 0.0)

    monkeypatch.setattr(_Case, "_windows", windows)
    found = _group(over(all_plants([neck_of_family(family(), "f")], 2, 0), 0), "pitch", "gain_up", False)
    assert found[0].value == pytest.approx(1.5, rel=0.005)
    # Later cases look no further than the least so far.
    assert all(item.value == pytest.approx(1.5, rel=0.005) or math.isinf(item.value) for item in found)


def test_the_least_over_plants_axes_and_kinds_is_each_metric_s() -> None:
    def crossing(axes: str, what: str, value: float) -> Crossing:
        return Crossing("p", axes, what, _SMALL, _POSTURES[0], value, 0.0)

    found = [
        crossing("pitch", "gain_up", 3.0), crossing("pitch", "gain_down", 2.5), crossing("roll", "gain_up", 4.0),
        crossing("both", "gain_up", 2.2), crossing("both", "delay", 0.05), crossing("pitch", "delay", 0.08),
    ]  # fmt: skip
    table = {name: float(values.min()) for name, (values, _) in crossing_values(found).items()}
    assert table == {
        "pitch.gain_margin": 2.5, "roll.gain_margin": 4.0, "axes.gain_margin": 2.2,
        "pitch.delay_margin_ms": 80.0, "axes.delay_margin_ms": 50.0,
    }  # fmt: skip


def neck_loop(block: Block) -> LoopUnderTest:
    return LoopUnderTest(name="paper", plant=lambda: BlockPart(block), controller=pi().block(), inputs={"payload": 0.5})


@pytest.mark.nightly
@pytest.mark.slow
def test_the_virtual_neck_stands_less_than_its_linear_model_and_coarse_is_quick() -> None:
    block = VirtualNeck(NeckParameters.paper().without_noise()).block()
    loop = neck_loop(block)
    crossings([loop], coarse=True)
    begin = time.process_time()
    coarse = crossings([loop], coarse=True)
    # Issue 29: under 3 s of processor time, to tune with.
    assert time.process_time() - begin < 3.0
    up = min(item.value for item in coarse if item.what == "gain_up")
    fine = min(item.value for item in _group(loop, "both", "gain_up", False))
    assert 1.2 < fine < 20.0
    # Coarse: the last of a ladder of sqrt(2) that was calm, in one posture.
    assert up / math.sqrt(2.0) <= fine * 1.01
    assert np.isfinite([item.value for item in coarse if item.what == "delay"]).any()
