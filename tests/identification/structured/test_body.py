"""The optional parts of the grey box: softening, creep and displaced tendons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, load
from softneck.identification import GreyBox, Model
from softneck.identification.structured._greybox import PARAMETERS
from softneck.identification.structured._parameters import RIGID
from softneck.runtime import load_functions
from softneck.signals import SET_POINTS, Recording, signal
from softneck.signals.recording._channels import MOTOR_POSITIONS

from ...data import TS

FUNCTIONS = load_functions("softneck.identification.structured._neck_equations_runtime")
GUESS = np.array([number.guess for number in PARAMETERS])
REACH = 0.35
CREEP = np.array([REACH, 0.0, 0.0, 0.8, 1.0])


def run(body: np.ndarray, U: np.ndarray, numbers: np.ndarray = GUESS) -> tuple[np.ndarray, np.ndarray]:
    M, Y = np.empty(U.shape), np.empty((len(U), 2))
    FUNCTIONS.neck_run(numbers, body, TS, np.full(3, 3.0), 2, 50, np.ascontiguousarray(U), np.zeros(3), M, Y)
    return M, Y


def recording(body: np.ndarray, name: str, seed: int, rows: int = 1000) -> Recording:
    U = np.array(signal(name, duration=rows * TS, seed=seed).set_points)
    U[:10] = 0.0
    M, Y = run(body, U)
    Y = Y + 5e-4 * np.random.default_rng(seed).standard_normal(Y.shape)
    channels = dict(zip((*SET_POINTS, *MOTOR_POSITIONS, "pitch", "roll"), (*U.T, *M.T, *Y.T), strict=True))
    return Recording(np.arange(len(U)) * TS, TS, channels)


def held(size: float, rows: int) -> np.ndarray:
    U = np.zeros((rows, 3))
    U[10:] = size * np.array([1.0, -0.5, -0.5])
    return U


def test_a_body_creeps_from_the_bend_of_both_springs_to_that_of_one() -> None:
    stiff = GUESS.copy()
    stiff[[number.name for number in PARAMETERS].index("stiffness")] *= 1.8
    # Its friction would hold it on the way; the hysteresis is not what is looked at.
    for numbers in (GUESS, stiff):
        numbers[[number.name for number in PARAMETERS].index("friction")] = 0.0
    fast, slow = CREEP.copy(), CREEP.copy()
    slow[4] = 0.01
    after = run(fast, held(1.0, 1500))[1][-1, 0]
    # 30 s are 30 time constants of the branch: nothing of it is left.
    assert after == pytest.approx(run(RIGID, held(1.0, 1500))[1][-1, 0], abs=1e-9)
    # 3 s are 0.03 of its time constant.
    assert run(slow, held(1.0, 150))[1][-1, 0] == pytest.approx(run(RIGID, held(1.0, 150), stiff)[1][-1, 0], rel=0.03)


def test_softening_bends_further_beyond_half_the_reach_and_less_below() -> None:
    soft = np.array([REACH, 2.0, 0.0, 0.0, 1.0])
    for size, further in ((0.4, False), (3.0, True)):
        bends = [abs(run(body, held(size, 300))[1][-1, 0]) for body in (soft, RIGID)]
        assert (bends[1] > 0.5 * REACH) == further
        assert (bends[0] > bends[1]) == further


def test_a_large_bend_leaves_the_body_softer_for_a_while() -> None:
    lasting = np.array([REACH, 0.0, 0.6, 0.0, 1.0])
    before = np.vstack([held(3.0, 200), held(0.0, 100), held(0.5, 200)])
    gained = [run(body, before)[1][-1, 0] - run(body, held(0.5, 500))[1][-1, 0] for body in (lasting, RIGID)]
    # The rigid body differs by its hysteresis alone.
    assert gained[0] > 5.0 * abs(gained[1])


@pytest.fixture(scope="module")
def creeping() -> Model:
    return GreyBox(sensor_delay=2, body="creep").fit([recording(CREEP, "mixed", 1), recording(CREEP, "eq22", 2)])


@pytest.mark.slow
def test_the_creep_behind_its_own_equations_is_found(creeping: Model) -> None:
    found = {row["name"]: row for row in creeping.findings["numbers"]}
    # Within 20 %: stiffness and creep share what the bend says of both.
    assert found["creep"]["value"] == pytest.approx(0.8, rel=0.2)
    assert "softening" not in found
    assert "time constant" in creeping.findings["found"]
    assert "time constant" in creeping.summary()


@pytest.mark.slow
def test_its_file_keeps_the_body(creeping: Model, tmp_path: Path) -> None:
    creeping.save(tmp_path / "m.npz")
    test = recording(CREEP, "sine", 3, 300)
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(test), creeping.simulate(test))
    spoiled = {**creeping.arrays, "body": np.array([REACH, 0.0, 0.0, -1.0, 1.0])}
    replace(creeping, arrays=spoiled).save(tmp_path / "spoiled.npz")
    with pytest.raises(FileFormatError, match="body"):
        load(tmp_path / "spoiled.npz")


@pytest.mark.parametrize("body", ["", "foam", "creep+creep", "rigid+creep"])
def test_parts_that_do_not_exist_are_refused(body: str) -> None:
    with pytest.raises(SettingsError, match="rigid, all, or some of softening, creep, tendons"):
        GreyBox(body=body)
