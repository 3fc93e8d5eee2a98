"""What a recording cannot teach is said in one line before a model is trained, and nothing is said of a good one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import DataError
from softneck.identification import Network, OutputError, Play
from softneck.robot import Robot
from softneck.signals import Recording, redefinition_matrix, signal
from softneck.signals.quality._excitation import (
    explained_variance,
    independent_motions,
    lightly_damped,
    poor_excitation,
    why_at_rest,
)

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


def _steps(rows: int, motors: int, seed: int) -> np.ndarray:
    """Return levels held for 20 to 120 rows, another for each motor."""
    rng = np.random.default_rng(seed)
    columns = [np.repeat(rng.uniform(-2.0, 2.0, rows // 20), rng.integers(20, 120, rows // 20)) for _ in range(motors)]
    return np.column_stack([column[:rows] for column in columns])


def _ringing(drive: np.ndarray, turn: float, damping: float) -> np.ndarray:
    """Return the motion of a mode of `turn` rad a sample that an input drives through a dead time of 3 samples."""
    pole = np.exp(turn * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    motion = np.asarray(lfilter([0.0, 0.0, 0.0, 1.0], np.poly([pole, pole.conj()]).real, drive))
    return motion / motion.std()


def _arm(sample_time: float, U: np.ndarray, unit: str, **outputs: np.ndarray) -> Recording:
    robot = Robot.from_dict({
        "name": "arm", "motors": {"names": [f"m{i}" for i in range(U.shape[1])], "unit": unit},
        "outputs": {"names": list(outputs), "unit": "mm"}, "directions": {"kind": "identified"},
    })  # fmt: skip
    return Recording.from_arrays(
        U, 0.01 * np.column_stack(list(outputs.values())), sample_time=sample_time, robot=robot
    )


# Share of Nyquist, damping, sample time [s]: slow and fast modes, from 1 ms to 4 s a sample.
MODES = [
    (0.005, 0.003, 0.02),
    (0.005, 0.001, 4.0),
    (0.08, 0.003, 0.02),
    (0.1, 0.001, 0.001),
    (0.1, 0.02, 0.3),
    (0.6, 0.01, 0.02),
]


@pytest.mark.parametrize(("share", "damping", "sample_time"), MODES)
@pytest.mark.parametrize(("motors", "unit"), [(1, "kPa"), pytest.param(3, "rad", marks=pytest.mark.slow)])
def test_a_lightly_damped_mode_is_named_and_the_output_beside_it_is_not(
    share: float, damping: float, sample_time: float, motors: int, unit: str
) -> None:
    # Three motors have nine coefficients, which three periods of a half determine too badly.
    U = _steps(5000 if share < 0.01 and motors > 1 else 2500, motors, seed=1)
    motion = _ringing(U.sum(axis=1), share * np.pi, damping) + 0.05 * np.random.default_rng(0).standard_normal(len(U))
    recording = _arm(sample_time, U, unit, tip=motion, lag=np.asarray(lfilter([0.1], [1.0, -0.9], U.sum(axis=1))))
    said = [line for line in poor_excitation(recording) if "`tip`" in line or "`lag`" in line]
    assert len(said) == 1
    assert "`tip` is lightly damped" in said[0]
    mode = lightly_damped(recording)["tip"]
    # Three periods in each half determine a frequency within a few percent, and more periods better.
    assert mode.frequency == pytest.approx(share * np.pi / sample_time, rel=0.02)
    # A decay by less than a third within a half of the recording cannot be told from the noise of the levels.
    periods = 0.25 * share * len(U)
    assert mode.damping == pytest.approx(damping, rel=0.5, abs=0.4 / (2.0 * np.pi * periods))


def test_a_mode_that_is_well_damped_is_not_called_lightly_damped() -> None:
    U = _steps(2500, 1, seed=1)
    assert poor_excitation(_arm(0.02, U, "rad", tip=_ringing(U[:, 0], 0.015, 0.4))) == ()


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["noise", "drift", "slow wave", "mode of its own", "mode of its own, damped"])
def test_an_output_that_the_motors_do_not_move_follows_through_no_mode(kind: str, seed: int) -> None:
    U = _steps(2000, 1 + 2 * seed, seed)
    e = np.random.default_rng(seed + 10).standard_normal(len(U))
    wave = np.sin(np.linspace(0.0, 8.0, len(U))) + 0.05 * e
    free = {"noise": e, "drift": np.cumsum(e), "slow wave": wave, "mode of its own": _ringing(e, 0.3, 0.003)}
    recording = _arm(0.02, U, "bar", tip=free.get(kind, _ringing(e, 0.3, 0.1)))
    assert any("`tip` does not follow the motors" in line for line in poor_excitation(recording))
    assert lightly_damped(recording) == {}
