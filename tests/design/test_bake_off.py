"""The bake-off's simulator against python-control, and what it counts."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.design import PiSettings
from softneck.design.plants._uncertain import StepAndLoad
from softneck.estimation import AxisPlant

from ..oracles.bake_off import bake_off_neck, bake_off_plant, bake_off_plants, block_stepper, run_bake_off

TS = 0.02


def test_its_plants_span_what_the_paper_s_neck_may_be() -> None:
    plants = bake_off_plants()
    gains = np.array([plant.static_gain for plant in plants])
    nominal = plants[len(plants) // 2]
    assert len(plants) == 75
    assert nominal.static_gain == bake_off_plant().static_gain
    # 0.6/1.4 and 1.4/0.6 of Eq. 31's 27.691/5.293 deg/rad.
    np.testing.assert_allclose(gains.min() / nominal.static_gain, 0.6 / 1.4, rtol=1e-12)
    np.testing.assert_allclose(gains.max() / nominal.static_gain, 1.4 / 0.6, rtol=1e-12)
    assert nominal.static_gain == pytest.approx(math.radians(27.691 / 5.293), rel=1e-12)
    assert {plant.delay for plant in plants} == {3, 4, 5}


@pytest.mark.parametrize(
    "plant",
    [bake_off_plant(), AxisPlant(np.array([0.01, 0.005]), np.array([1.0, -1.5, 0.56]), 3, TS)],
    ids=["first_order", "second_order"],
)
def test_a_slow_loop_is_the_linear_one(plant: AxisPlant) -> None:
    """Within its limits, the angle is that of python-control's closed loop from reference and load."""

    def factory():
        return lambda reference, angle: 0.5 * (reference - angle)

    found = run_bake_off(factory, [plant])
    G: Any = plant.tf()
    t = np.arange(301) * TS
    closed: Any = control.feedback(0.5 * G, 1)
    loaded: Any = control.feedback(G, 0.5)  # pyright: ignore
    load: Any = np.where(t >= 3.5 - 1e-9, -0.5, 0.0)
    reference: Any = np.full(301, math.radians(10.0))
    y = control.forced_response(closed, t, reference).outputs
    d = control.forced_response(loaded, t, load).outputs
    # Two simulations of 301 samples: rounding only.
    np.testing.assert_allclose(found.angles[0], np.asarray(y) + np.asarray(d), atol=1e-12)


def test_what_is_asked_beyond_the_limits_is_cut() -> None:
    found = run_bake_off(lambda: lambda _r, _y: 100.0, [bake_off_plant()])
    assert np.diff(found.inputs[0], prepend=0.0).max() <= 0.25 + 1e-12  # rounding of the sum
    assert found.inputs[0].max() == 6.0


def test_settling_overshoot_and_rms_are_what_they_say() -> None:
    """A gain without feedback: the paper's pole, a settling of delay + 3 time constants, and the load in full."""
    plant = bake_off_plant()
    found = run_bake_off(lambda: lambda r, _: r / plant.static_gain, [plant], StepAndLoad(slew_limit=100.0))
    # 4 + 1 samples until it moves; one sample more at most, as the border falls between two.
    assert found.settling[0] == pytest.approx(0.08 - math.log(0.05) / 5.293, abs=TS)
    assert found.overshoot[0] == 0.0
    e = -0.5 * plant.static_gain * (1.0 - np.exp(-5.293 * TS * np.maximum(np.arange(126) - 4, 0)))
    # The step itself is settled to exp(-5.293 * 3.4) = 2e-8 when the load comes.
    assert found.load_rms[0] == pytest.approx(math.degrees(math.sqrt(np.mean(e**2))), rel=1e-7)


@pytest.mark.parametrize("axis", ["pitch", "roll"])
def test_a_block_is_limited_as_the_test_asks(axis: str) -> None:
    block = PiSettings(reference_time=0.0, lead_limit=12.0).design(bake_off_neck()).block()
    step = block_stepper(block, axis=axis)()
    asked = [step(0.7, 0.0) for _ in range(60)]
    assert np.diff(asked).max() == pytest.approx(0.25, rel=1e-9)
    assert max(asked) == pytest.approx(6.0, rel=1e-9)


def test_it_says_what_does_not_fit() -> None:
    with pytest.raises(DataError, match="at least one plant"):
        run_bake_off(lambda: lambda _r, _y: 0.0, [])
    with pytest.raises(SettingsError, match=r"sample time is 0.01 s; the test's is 0.02 s"):
        run_bake_off(lambda: lambda _r, _y: 0.0, [bake_off_plant(sample_time=0.01)])
    with pytest.raises(SettingsError, match="`duration` must be beyond `load_at`"):
        StepAndLoad(duration=3.0)
    with pytest.raises(SettingsError, match=r"every 0.02 s, the bake-off every 0.01 s"):
        block_stepper(PiSettings().design(bake_off_neck()).block(), StepAndLoad(sample_time=0.01))
