"""The best linear model in hindsight: 100 where the truth is linear, and nothing linear lies above it."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.identification import WARM_UP, Rls, nrmse_fit, validate
from softneck.signals import Recording, concatenate, signal

from ...data import Truth, neck_recording, recording_from
from ._numbers import number

ROWS = 1500
# What the ladder of octaves leaves of 100 on a neck of one lag.
LADDER = 0.02


def clean(seed: int = 4, rows: int = ROWS) -> Recording:
    return recording_from(signal("aprbs", duration=0.02 * rows, seed=seed).set_points)


def some_model() -> Rls:
    return Rls(delay=0.06)


def test_a_linear_neck_is_met_exactly() -> None:
    result = validate(some_model().fit(neck_recording(600)), clean())
    for horizon in ("1", "5", "25", "inf"):
        # 0.92 lies between two poles of the ladder, which meet it to 1e-4 of the response; it printed 99.989.
        assert result.best_linear[horizon]["pitch"] == pytest.approx(100, abs=LADDER)
        assert result.best_linear[horizon]["roll"] == pytest.approx(100, abs=LADDER)


@pytest.mark.parametrize("pole", [0.3, 0.8, 0.97, 0.995])
@pytest.mark.parametrize("delay", [0, 14])
def test_any_lag_and_dead_time_of_a_neck_is_met(pole: float, delay: int) -> None:
    truth = Truth(pole=(pole, pole), gain=(0.1 * (1 - pole), 0.1 * (1 - pole)), delay=(delay, delay))
    recording = recording_from(signal("aprbs", duration=40.0, seed=3).set_points, truth=truth)
    result = validate(some_model().fit(neck_recording(600)), recording, horizons=("inf",))
    # The worst place between two poles of the ladder: 1e-3 of the response at one tap, less in the sum.
    assert number(result.best_linear["inf"]["pitch"]) > 99.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_no_rls_model_lies_above(seed: int) -> None:
    """Trained on other rows, on these rows, and with any dead time; free run, and each horizon."""
    recording = neck_recording(ROWS, seed=seed, noise=3e-3)
    for model in (
        Rls().fit(neck_recording(800, seed=seed + 50, noise=3e-3)),
        Rls().fit(recording),
        Rls(na=2, nb=2).fit(recording),
        Rls(delay=0.12).fit(recording),
    ):
        result = validate(model, recording, include_training=True)
        for horizon, fits in result.fits.items():
            for axis, fit in fits.items():
                # What the ladder leaves is nothing beside what its 86 parameters take of the noise.
                assert number(fit) <= number(result.best_linear[horizon][axis]) + 1e-6


@pytest.mark.slow
def test_it_is_what_a_long_impulse_response_by_another_method_finds() -> None:
    recording = neck_recording(4000, seed=2, noise=1e-2)
    ours = validate(some_model().fit(neck_recording(600)), recording, horizons=("inf",)).best_linear["inf"]
    # 90 taps (1.8 s: 0.92^90 = 5e-4 is left) of each motor, row by row, u = u(0) before the record.
    u, y = recording.set_points, recording.outputs[WARM_UP:]
    padded = np.vstack([np.repeat(u[:1], 90, axis=0), u])
    rows = np.array([[1.0, *padded[90 + k - 90 : 90 + k].ravel()] for k in range(WARM_UP, len(u))])
    other = rows @ np.linalg.lstsq(rows, y, rcond=None)[0]
    for axis, name in enumerate(("pitch", "roll")):
        # 271 parameters against 86 take 185 more of 3,975 parts of the noise: 4.7 % of its square.
        left = 100 - nrmse_fit(y[:, axis], other[:, axis])
        assert 100 - number(ours[name]) == pytest.approx(left * 1.023, rel=0.01)


@pytest.mark.slow
def test_persistence_lies_below_and_more_knowledge_never_harms() -> None:
    result = validate(some_model().fit(neck_recording(600)), neck_recording(ROWS, seed=9, noise=2e-3))
    bound = result.best_linear
    for axis in ("pitch", "roll"):
        for horizon, held in result.persistence.items():
            assert number(held[axis]) <= number(bound[horizon][axis]) + 1e-9
        # What was measured 25 samples ago is a column more than the free run has; 1e-9 is rounding.
        assert number(bound["inf"][axis]) <= number(bound["25"][axis]) + 1e-9


def test_pure_noise_is_hardly_flattered() -> None:
    """The guard: ten rows for each parameter leave at most 100 (1 - sqrt(0.9)) = 5.1 of fit to chance."""
    recording = neck_recording(1000, seed=1)
    y = np.random.default_rng(0).standard_normal((1000, 2)) * 0.05
    result = validate(some_model().fit(neck_recording(600)), recording.with_channels(pitch=y[:, 0], roll=y[:, 1]))
    assert 0 < number(result.best_linear["inf"]["pitch"]) < 6.5  # one record: 5.1 or less, and its scatter
    short = validate(some_model().fit(neck_recording(600)), neck_recording(500, seed=2))
    assert short.best_linear["inf"] == {"pitch": None, "roll": None}


def test_runs_are_never_joined_and_start_anywhere() -> None:
    """Each run begins tilted where the other did not end: a clean linear neck is met all the same."""
    runs = [clean(4, 800), clean(5, 900)]
    moved = []
    for run, offset in zip(runs, (0.1, -0.2), strict=True):
        decay = np.exp(-np.arange(len(run)) * 0.02 / 0.4)  # a start of its own, decaying as one of the modes
        moved.append(run.with_channels(pitch=run.channels["pitch"] + offset * decay))
    result = validate(some_model().fit(neck_recording(600)), concatenate(moved), horizons=("inf",))
    assert result.best_linear["inf"]["pitch"] == pytest.approx(100, abs=LADDER)


def test_set_points_that_stand_still_do_no_harm() -> None:
    u = signal("aprbs", duration=30.0, seed=4).set_points.copy()
    u[:, 1:] = 0.5
    result = validate(some_model().fit(neck_recording(600)), recording_from(u))
    assert result.best_linear["inf"]["pitch"] == pytest.approx(100, abs=LADDER)
    assert result.best_linear["inf"]["roll"] is None  # phi_i stands still: nothing moves
