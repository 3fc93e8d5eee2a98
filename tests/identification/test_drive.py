"""The drive model: pole and delay behind clean positions, and runs of any length."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.identification import Network, Rls, SetMembership, fit_drive
from softneck.identification.models._drive import LoadedDrive, drive_delays, fit_loaded_drive
from softneck.signals import concatenate, signal

from ..data import TRUTH, drive_positions, neck_recording, recording_from, slow_but


def test_pole_and_delay_behind_clean_positions_are_found() -> None:
    drive = fit_drive(neck_recording(800))
    assert drive.delay.tolist() == list(TRUTH.drive_delay)
    # Positions are free of noise: a ratio of two sums, to rounding.
    np.testing.assert_allclose(drive.pole, TRUTH.drive_pole, rtol=0, atol=1e-10)


def test_it_simulates_as_the_plain_loop_does() -> None:
    drive = fit_drive(neck_recording(800))
    P = signal("aprbs", duration=5.0, seed=11).set_points
    np.testing.assert_allclose(drive.simulate(P, P[0]), drive_positions(P), rtol=0, atol=1e-9)


def test_without_positions_the_position_is_the_set_point() -> None:
    r = neck_recording(200, positions=False)
    drive = fit_drive(r)
    assert drive.delay.tolist() == [0, 0, 0]
    np.testing.assert_array_equal(drive.simulate(r.set_points, r.set_points[0]), r.set_points)


@pytest.mark.parametrize("rows", [2, 3, 5, 6, 9])
def test_a_run_shorter_than_the_longest_delay_does_no_harm(rows: int) -> None:
    long = neck_recording(400)
    both = concatenate([long, long.rows(20, 20 + rows)])
    assert fit_drive(both).delay.tolist() == list(TRUTH.drive_delay)
    Rls(delay=0.06).fit(both)


@pytest.mark.parametrize("limited", [True, False])
@pytest.mark.parametrize("stall", [0.0, 0.5])
def test_the_dead_times_are_those_of_the_drive_with_its_load_limit(limited: bool, stall: float) -> None:
    clean = neck_recording(600)
    truth = LoadedDrive(fit_drive(clean).array, np.array([0.95, 1.5, 0.4, -0.2]))
    # A drive that stalls part of the time seems later than it is, so that least squares and slack moves disagree.
    m = truth.simulate(clean.set_points, clean.set_points[0])
    mixed = (1.0 - stall) * clean.motor_positions + stall * m
    recording = clean.with_channels(**dict(zip(clean.robot.motor_positions, mixed.T, strict=True)))
    whole = fit_loaded_drive(recording, limited=limited)
    np.testing.assert_array_equal(drive_delays(recording, limited=limited), whole.drive[:, 1])


# Of the models, all but the grey box, whose drives are part of its own equations.
DRIVEN = ("rls", "mimo", "oe", "oe2", "nlsm", "residual", "play", "nn", "guarded")


@pytest.mark.parametrize("kind", slow_but(DRIVEN, ["rls", "mimo", "nlsm", "nn"]))
def test_the_models_free_run_moves_its_motors_by_the_drive_model(kind: str, models: dict) -> None:
    assert set(models) == {*DRIVEN, "greybox"}
    P = signal("aprbs", duration=5.0, seed=11).set_points
    motors = models[kind].simulate(recording_from(P), warm_up=0)[:, 2:5]
    # The drive of a model is identified from noise-free positions.
    np.testing.assert_allclose(motors, drive_positions(P), rtol=0, atol=1e-8)


SETTINGS = {
    "rls": Rls(),
    "nlsm": SetMembership(),
    "residual": SetMembership(form="residual"),
    "nn": Network(iterations=2, hidden=(3, 3)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SETTINGS)
def test_without_logged_positions_the_position_is_the_set_point_for_every_kind(kind: str) -> None:
    model = SETTINGS[kind].fit(neck_recording(400, positions=False))
    np.testing.assert_array_equal(model.arrays["drive"], np.zeros((3, 2)))


def test_missed_positions_do_not_move_the_drive() -> None:
    whole = neck_recording(600)
    m = whole.channels["motor_position_2"].copy()
    m[[0, 50, 51, 300]] = np.nan
    full, gappy = fit_drive(whole), fit_drive(whole.with_channels(motor_position_2=m))
    # Four of 600 samples less change a noisy pole in its third digit.
    np.testing.assert_allclose(gappy.pole, full.pole, rtol=1e-2)
    np.testing.assert_array_equal(gappy.delay, full.delay)
