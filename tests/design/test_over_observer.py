"""Predictive designs that know the observer of their loop: its look-ahead, and how taut its payload wants tendons."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import MpcSettings, NmpcSettings
from softneck.design.predictive._nmpc import NmpcNumbers
from softneck.design.predictive._plant import _mean_gain, least_taut_cocontraction
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings
from softneck.identification import GreyBox, Model
from softneck.signals import Recording, signal

from ..foreign_necks.necks import ForeignNeck, record
from .test_mpc_speed import identified


def log(payload: float) -> Recording:
    run = record(signal("eq22", duration=40.0), ForeignNeck(name="column"), seed=3, payload=payload)
    return run.with_channels(payload=np.full(len(run), payload))


@pytest.fixture(scope="module")
def model() -> Model:
    """Tendons of this neck hang under a kilogram; a few steps of the search see that."""
    return GreyBox(evaluations=8, sensor_delay=2).fit([log(0.0), log(1.0)])


@pytest.fixture(scope="module")
def observer(model: Model) -> Any:
    return KalmanSettings().design(model)


def test_tendons_are_as_taut_as_small_moves_need(model: Model) -> None:
    found = least_taut_cocontraction(model, 1.0)
    gains = {c: _mean_gain(model, 1.0, c) for c in np.arange(0.0, 4.01, 0.25)}
    assert gains[found] >= 0.9 * max(gains.values())
    assert all(gains[c] < 0.9 * max(gains.values()) for c in gains if c < found)
    # A payload slackens the tendons of this neck.
    assert least_taut_cocontraction(model, 0.0) < found


def test_what_the_observer_says_is_taken_where_nobody_says_other(model: Model, observer: Any) -> None:
    found = MpcSettings().over(observer)
    assert (found.look_ahead, observer.lead) == (pytest.approx(0.05), pytest.approx(0.05))
    assert found.payload_tautness == least_taut_cocontraction(model, 1.0)
    mine = MpcNumbers(look_ahead=0.0, payload_tautness=0.7).over(observer)
    assert (mine.look_ahead, mine.payload_tautness) == (0.0, 0.7)
    assert MpcSettings(minimum_tautness=None).over(observer).payload_tautness is None
    assert NmpcSettings().over(observer) == NmpcNumbers(look_ahead=observer.lead)


def test_the_controller_is_that_of_the_same_settings_given(observer: Any) -> None:
    found = MpcSettings(bandwidth=6.0).over(observer)
    ours = found.design(identified())
    given = MpcNumbers(bandwidth=6.0, look_ahead=0.05, payload_tautness=found.payload_tautness)
    for mine, theirs in zip(ours.arrays, given.design(identified()).arrays, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert [port.name for port in ours.block().inputs][-1] == "payload"
    assert "for an observer that looks 50 ms ahead and tells the payload, for which" in ours.summary()


def test_a_linear_observer_says_its_look_ahead_alone() -> None:
    model = identified()
    assert MpcSettings().over(KalmanSettings().design(model)) == MpcNumbers(look_ahead=0.0)
    assert MpcSettings().over(KalmanSettings(sensor_delay=0.04).design(model)).look_ahead == pytest.approx(0.04)


def test_a_late_sensor_takes_no_more_than_half_of_the_least_delay(model: Model) -> None:
    late = KalmanSettings(sensor_delay=0.08).design(model)
    assert MpcSettings().over(late).look_ahead == pytest.approx(0.05)
    assert MpcNumbers(least_delay=0.2).over(late).look_ahead == pytest.approx(0.08)
    assert MpcNumbers(look_ahead=0.08).over(late).look_ahead == 0.08
    # The nonlinear plan is over a model that has its dead time, not over one that hides it.
    assert NmpcSettings().over(late).look_ahead == pytest.approx(0.08)


def test_what_is_no_observer_is_refused(model: Model) -> None:
    with pytest.raises(SettingsError, match="an observer is needed, of `softneck observer`; got"):
        MpcSettings().over(model)
