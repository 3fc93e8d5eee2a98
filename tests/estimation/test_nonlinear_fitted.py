"""Noise levels of an observer over a nonlinear model: their likelihood, and what recordings tell of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import SettingsError
from softneck.estimation import KalmanSettings, NonlinearObserver, fit_noise
from softneck.estimation._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE
from softneck.estimation._noise import SETTLE, WalkCost
from softneck.estimation._observer import estimate_sensor_delay, fit_levels_and_delays
from softneck.identification import Play
from softneck.identification.models._fitting import row_hashes
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, concatenate, signal

from .necks import without

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

TRUE = (math.radians(0.25), math.radians(0.2), 0.8)


@pytest.fixture(scope="module")
def observer() -> NonlinearObserver:
    training = record(signal("eq22", duration=60.0), VirtualNeck(NeckParameters.paper()), seed=1)
    model = Play(rate=6.0, widths=(0.3,), degree=2, ridge=1e-4).fit([training])
    found = KalmanSettings(sensor_delay=0.0).design(model)
    assert isinstance(found, NonlinearObserver)
    return without(found, KALMAN_GATE, KALMAN_FROZEN)


@pytest.fixture(scope="module")
def walking(observer: NonlinearObserver) -> Recording:
    """A recording of which the observer's own assumptions are true, at the levels `TRUE`."""
    run = record(signal("steps"), VirtualNeck(NeckParameters.paper()), seed=7)
    angles, motion, fastest = observer.simulate(run)
    _, timing, kept = observer.walk_start
    rng, runs = np.random.default_rng(3), []
    for _ in range(4):
        steps = np.sqrt(TRUE[1] ** 2 + (TRUE[2] * fastest) ** 2)[:, None] * rng.standard_normal(angles.shape)
        late = lfilter([math.sqrt(timing * (1.0 - kept**2))], [1.0, -kept], rng.standard_normal(angles.shape), axis=0)
        told = angles + late * motion + np.cumsum(steps, axis=0) + TRUE[0] * rng.standard_normal(angles.shape)
        runs.append(run.with_channels(pitch=told[:, 0], roll=told[:, 1]))
    return concatenate(runs)


def test_its_cost_is_that_of_the_filters_own_innovations(observer: NonlinearObserver, walking: Recording) -> None:
    """Over rows with gaps and an outlier, which neither sees: the runtime's log det S and NIS, added up."""
    at_true = observer.with_noise(TRUE)
    first = next(iter(walking.runs()))
    z = first.outputs.copy()
    z[400:460] = z[1000] = math.nan
    run = first.with_channels(pitch=z[:, 0], roll=z[:, 1])
    cost, told = WalkCost(at_true, [run]), at_true.estimate(run)
    judged = told.judged & (np.arange(len(run)) >= SETTLE)
    assert told.accepted[judged].all()
    assert cost.rows == judged.sum()
    whole = float((told.log_det + told.innovation)[judged].sum())
    # Two orders of adding some 1200 numbers.
    assert cost.of(np.log10(TRUE)) * cost.rows == pytest.approx(whole, rel=1e-9)


def test_levels_that_are_true_are_found(observer: NonlinearObserver, walking: Recording) -> None:
    fit = fit_noise(observer, walking)
    # 5000 rows of two outputs tell a standard deviation to about 1 %, and three at once to a few.
    np.testing.assert_allclose(fit.noise, TRUE, rtol=0.1)
    assert fit.at_bound == ()
    assert fit.log_likelihood[1] > fit.log_likelihood[0]
    held = fit_noise(observer, walking, fixed=["measurement_noise_std"])
    assert held.noise[0] == observer.noise[0]


def test_what_was_fitted_is_kept_only_where_it_is_better(observer: NonlinearObserver, walking: Recording) -> None:
    run = next(iter(walking.runs()))
    found = fit_levels_and_delays(observer, [run])
    assert found.checks[found.kept] == min(found.checks.values())
    assert set(found.checks) == {"default", "noise"}
    assert "sensor_delay" in found.not_identifiable
    right = observer.with_noise(TRUE)
    again = fit_levels_and_delays(right, [run])
    assert again.checks[again.kept] <= again.checks["default"]


def test_rows_that_the_model_was_trained_on_tell_the_sensor_alone(
    observer: NonlinearObserver, walking: Recording
) -> None:
    """There it is better than anywhere else: what it misses elsewhere stays as it is."""
    seen = replace(observer, model=replace(observer.model, training_rows=row_hashes(walking)))
    found = fit_levels_and_delays(seen, [walking])
    assert found.fit.noise[1:] == observer.noise[1:]
    assert found.fit.noise[0] != observer.noise[0]
    assert {"rest_noise_std", "motion_noise_ratio"} <= set(found.not_identifiable)
    with pytest.raises(SettingsError, match="trained on these rows"):
        fit_levels_and_delays(seen, [walking], fixed=["measurement_noise_std"])


def test_motor_positions_tell_the_most_that_the_sensor_can_be_late(
    observer: NonlinearObserver, walking: Recording
) -> None:
    late = replace(
        observer, constants=KalmanSettings(sensor_delay=0.1, form="nonlinear").design(observer.model).constants
    )
    turned = walking.set_points @ observer.directions.T
    moved = {f"motor_position_{j + 1}": walking.set_points[:, j] for j in range(3)}
    for i, axis in enumerate(("pitch", "roll")):
        # An angle that stands in proportion to the motors, 3 samples ago.
        moved[axis] = 0.08 * np.concatenate([np.full(3, turned[0, i]), turned[:-3, i]])
    run = walking.with_channels(**moved)
    assert estimate_sensor_delay(late, [run]) == (pytest.approx(3 * run.sample_time), "motor positions")
    assert estimate_sensor_delay(observer, [run]) == (None, "")


def test_a_level_must_be_positive(observer: NonlinearObserver) -> None:
    with pytest.raises(ValueError, match="`motion_noise_ratio` must be positive; got -1"):
        observer.with_noise((TRUE[0], TRUE[1], -1.0))
