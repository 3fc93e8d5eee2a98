"""What a recording cannot teach is said in one line before a model is trained, and nothing is said of a good one."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError
from softneck.identification import Network, OutputError, Play
from softneck.signals import Recording, redefinition_matrix, signal
from softneck.signals.quality._excitation import explained_variance, independent_motions, poor_excitation, why_at_rest

from ..data import neck_recording, recording_from

GOOD = neck_recording(1500)


def one_axis(recording: Recording) -> Recording:
    """The same neck with theta_i alone: the motors move as one."""
    U = recording.set_points @ redefinition_matrix().T
    U[:, 1:] = 0.0
    return recording_from(U @ np.linalg.inv(redefinition_matrix()).T, noise=5e-4)


def unrelated_roll() -> Recording:
    drift = np.cumsum(np.random.default_rng(5).standard_normal(len(GOOD))) * 0.01
    return GOOD.with_channels(roll=drift)


def still_motor() -> Recording:
    return GOOD.with_channels(motor_setpoint_2=np.zeros(len(GOOD)))


def few_steps() -> Recording:
    P = np.zeros((1500, 3))
    for number, row in enumerate(range(100, 1500, 200)):
        P[row:] = np.roll([3.0, 1.0, 0.0], number)
    return recording_from(P, noise=5e-4)


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (GOOD.rows(0, 300), "300 rows (6 s) are few"),
        (one_axis(GOOD), "the motors move along 1 direction(s) for 2 outputs"),
        (unrelated_roll(), "`roll` does not follow the motors"),
        (still_motor(), "motor_setpoint_2 never moves"),
        (few_steps(), "the set-points change in 7 rows only"),
    ],
    ids=["short", "one_axis", "unrelated", "still", "steps"],
)
def test_poor_excitation_is_named(recording: Recording, said: str) -> None:
    lines = poor_excitation(recording)
    assert any(said in line for line in lines), lines
    assert all("\n" not in line for line in lines)


def test_nothing_is_said_of_a_good_recording() -> None:
    assert poor_excitation(GOOD) == ()
    assert independent_motions(GOOD) == 3
    # Eq. 22 has little co-contraction, and enough of it.
    assert poor_excitation(recording_from(signal("eq22", duration=30.0).set_points, noise=5e-4)) == ()


def test_rows_held_out_that_stand_still_are_named() -> None:
    """One step at the start, and the rest of it at rest."""
    P = np.zeros((800, 3))
    P[50:] = [3.0, -1.0, 0.5]
    step = recording_from(P, noise=0.0)
    _, rest = step.split(0.7)
    said = why_at_rest(rest, step)
    assert said is not None
    assert said.startswith("the rows held out stand still: pitch moves by ")
    # A motion of a twentieth is enough, whatever its size in degrees.
    pitch = step.channels["pitch"].copy()
    pitch[560:] += 0.051 * pitch.std() * np.sqrt(2.0) * np.sin(np.arange(240) * np.pi / 10.0)
    roll = step.channels["roll"] + pitch
    moved = step.with_channels(pitch=pitch, roll=roll)
    assert why_at_rest(moved.split(0.7)[1], moved) is None
    _, tail = GOOD.split(0.7)
    assert why_at_rest(tail, GOOD) is None


def test_what_motors_explain_is_what_is_left_of_the_variance_without_noise() -> None:
    half = float(GOOD.outputs[:, 0].std())
    noisy = GOOD.with_channels(pitch=GOOD.outputs[:, 0] + half * np.random.default_rng(0).standard_normal(len(GOOD)))
    clean, shared = explained_variance(GOOD)[0], explained_variance(noisy)[0]
    assert clean > 0.9  # the lags are an octave apart: a pole between them is met to a tenth
    # Noise as large as the motion halves the explained share; 30 coefficients on half of 1,500 rows cost some percent.
    assert shared == pytest.approx(0.5 * clean, abs=0.08)


@pytest.mark.parametrize("small", [1e-3, 1e-5])
def test_a_motion_that_hardly_shows_where_it_is_fitted_does_not_hide_that_outputs_follow(small: float) -> None:
    # Co-contraction as drives add it in one half of the blocks, and a motion in the other, extrapolated 1/small times.
    rows = np.arange(len(GOOD))
    V = GOOD.set_points @ redefinition_matrix().T
    V[:, 2] = np.sin(0.05 * rows) * np.where(rows * 10 // len(GOOD) % 2 == 1, 1.0, small)
    recording = recording_from(V @ np.linalg.inv(redefinition_matrix()).T, noise=2e-3)
    assert (explained_variance(recording) > 0.9).all()
    assert poor_excitation(recording) == ()


@pytest.mark.parametrize("settings", [Play(), Network()], ids=lambda s: type(s).__name__)
def test_kinds_that_learn_each_motor_refuse_motors_that_move_as_one(settings: Play) -> None:
    with pytest.raises(DataError, match=r"move along 1 direction\(s\) for 2 outputs.*or take `oe`"):
        settings.fit(one_axis(GOOD))


def test_a_linear_kind_takes_one_axis() -> None:
    model = OutputError().fit(one_axis(GOOD))
    assert model.kind == "oe"
