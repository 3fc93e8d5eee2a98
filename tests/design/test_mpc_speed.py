"""How fast predictive control is: `rise_s`, what an identified neck is taken for, plans that are too large."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import MpcSettings
from softneck.design.plants._uncertain import uncertain_plant
from softneck.design.predictive._plant import predicted_plants, scaled_plant
from softneck.design.predictive._settings import MpcNumbers

from ..oracles.bake_off import bake_off_neck
from .mpc_neck import TS, Neck, Samples


class Identified(Samples):
    """The bake-off's family, as if it had been identified."""

    findings = ()


def identified() -> Any:
    nominal = bake_off_neck()
    return Identified(pitch=nominal.pitch, roll=nominal.roll)


@pytest.mark.parametrize("rise", [pytest.param(0.15, marks=pytest.mark.slow), 0.4, 1.0])
def test_a_step_rises_in_the_time_that_was_asked(rise: float) -> None:
    controller = MpcSettings(rise_s=rise).design(bake_off_neck())
    neck, y = Neck(controller), []
    neck.step(0.0)
    for _ in range(200):
        neck.step(0.01)  # too small for any limit
        y.append(float(neck.y[0]) / 0.01)
    end = int(np.argmax(np.array(y) >= 0.9)) + 1  # until there it only rises
    low, high = np.interp([0.1, 0.9], y[:end], range(end))
    # The search ends within 2 % of the bandwidth, 30 halvings of the filter.
    assert (high - low) * TS == pytest.approx(rise, rel=0.03)
    assert max(controller.design["sensitivity"]) <= 1.5 + 1e-9  # what is faster costs no robustness


def test_rises_that_cannot_be_are_refused() -> None:
    with pytest.raises(SettingsError, match="`rise_s` must be between"):
        MpcSettings(rise_s=0.0)
    with pytest.raises(SettingsError, match="faster than any plan of this plant rises"):
        MpcSettings(rise_s=0.002).design(bake_off_neck())


def test_an_identified_neck_is_taken_to_be_taut() -> None:
    """Its slowest pole and its gain are at least what is asked and what any sample has; one's own is as it is."""
    model = identified()
    plant = scaled_plant(uncertain_plant(model), identified=True)
    settings: Any = MpcNumbers().fill_defaults(plant)
    plants = predicted_plants(settings, plant)
    for plant, name in zip(plants, ("pitch", "roll"), strict=True):
        # Rounding of a root.
        assert np.abs(np.roots(plant.denominator)).max() <= np.exp(-settings.taut_pole * TS) + 1e-9
        largest = max(float(np.real(system.dcgain())) for system in model.samples(name))
        assert plant.static_gain == pytest.approx(largest, rel=1e-9)
        assert plant.delay * TS >= settings.least_delay - 1e-9
    own = scaled_plant(uncertain_plant(bake_off_neck()))
    assert MpcNumbers().fill_defaults(own).minimum_tautness is None
    believed = predicted_plants(MpcNumbers().fill_defaults(own), own)
    assert believed[0].static_gain == pytest.approx(float(np.real(bake_off_neck().pitch.dcgain())))
    given = MpcNumbers(taut_pole=7.0, minimum_tautness=0.1).fill_defaults(own)
    assert (given.taut_pole, given.minimum_tautness) == (7.0, 0.1)  # what is asked stays


def test_the_default_tautness_is_a_wish_and_a_given_one_a_limit() -> None:
    plant, slackest = scaled_plant(uncertain_plant(identified()), identified=True), []
    for settings in (MpcNumbers(bandwidth=6.0), MpcNumbers(bandwidth=6.0, minimum_tautness=0.5)):
        problem = settings.fill_defaults(plant).problem(plant, 6.0)
        slackest.append(problem.tautness_weight / problem.slack_weight)
    assert slackest == [pytest.approx(3e-4), 1.0]


def test_plans_beyond_what_the_solver_takes_are_refused() -> None:
    with pytest.raises(
        SettingsError, match="`moves` 60 of 3 motors are 180 unknowns, and the solver takes at most 120"
    ):
        MpcNumbers(horizon=100, moves=60, bandwidth=6.0).design(bake_off_neck())


@pytest.mark.slow
def test_on_a_neck_that_nobody_tuned_to_it_is_fast_and_close() -> None:
    """The defaults' promise: 0.45 s and 3 deg; 0.36 s and 2.3 deg when they were chosen."""
    from softneck.identification import FamilySettings
    from softneck.loop import BlockPart, Loop, metrics, run_loop
    from softneck.signals import signal

    from ..foreign_necks.necks import ForeignNeck, record
    from ..references import StepReference

    neck = ForeignNeck(name="spring")
    controller = MpcSettings().design(FamilySettings().fit([record(signal("eq22", duration=60.0), neck, seed=6)]))

    def around(time: float, /) -> tuple[float, float, float]:
        tilt = np.radians(12.0) * min(1.0, time / 3.0)
        return tilt * np.cos(1.2 * time), tilt * np.sin(1.2 * time), 0.0

    def run(reference: Any, duration: float) -> Any:
        return run_loop(Loop(plant=BlockPart(neck.block()), controller=BlockPart(controller.block()),
                             reference=reference, duration=duration))  # fmt: skip

    for axis in ("pitch", "roll"):
        found: Any = metrics(run(StepReference(**{axis: np.radians(10.0)}, at=1.0), 6.0))[axis]
        assert found["rise_s"] <= 0.45
        assert found["overshoot_pct"] <= 10.0
    result = run(around, 14.0)
    late = result.time > 8.3
    wanted = np.array([around(t)[:2] for t in result.time[late]])
    errors = np.column_stack([result.angle(axis) for axis in ("pitch", "roll")])[late] - wanted
    assert np.degrees(np.sqrt(np.mean(errors**2, axis=0)).max()) <= 3.0
