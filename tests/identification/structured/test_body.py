"""The optional parts of the grey box: softening, creep and displaced tendons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, load, silent
from softneck.identification import GreyBox, Model
from softneck.identification.models._fitting import ScaledData
from softneck.identification.models._left_out import Fold, Judged
from softneck.identification.structured._greybox import PARAMETERS
from softneck.identification.structured._neck_equations_runtime import NECK_SUBSTEPS
from softneck.identification.structured._output_error import FitProblem, Found, SearchProgress
from softneck.identification.structured._parameters import BODY_PARAMETERS, PARTS, RIGID
from softneck.identification.structured._parts import _Trial, _trial
from softneck.runtime import load_functions
from softneck.signals import SET_POINTS, Recording, signal
from softneck.signals.recording._channels import MOTOR_POSITIONS

from ...data import TS

FUNCTIONS = load_functions("softneck.identification.structured._neck_equations_runtime")
GUESS = np.array([number.guess for number in PARAMETERS])
REACH = 0.35


def body(**numbers: float) -> np.ndarray:
    """The array `body` with some of its numbers."""
    found = dict(zip([number.name for number in BODY_PARAMETERS], RIGID[1:], strict=True)) | numbers
    return np.array([REACH, *found.values()])


CREEP = body(creep=0.8)


def run(p: np.ndarray, U: np.ndarray, numbers: np.ndarray = GUESS) -> tuple[np.ndarray, np.ndarray]:
    M, Y = np.empty(U.shape), np.empty((len(U), 2))
    FUNCTIONS.neck_run(
        numbers, p, TS, NECK_SUBSTEPS, np.full(3, 3.0), 2, 50, np.ascontiguousarray(U), np.zeros(3), M, Y
    )
    return M, Y


def recording(p: np.ndarray, name: str, seed: int, rows: int = 1000) -> Recording:
    U = np.array(signal(name, duration=rows * TS, seed=seed).set_points)
    U[:10] = 0.0
    M, Y = run(p, U)
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
    soft = body(softening=2.0)
    for size, further in ((0.4, False), (3.0, True)):
        bends = [abs(run(p, held(size, 300))[1][-1, 0]) for p in (soft, RIGID)]
        assert (bends[1] > 0.5 * REACH) == further
        assert (bends[0] > bends[1]) == further


def test_a_large_bend_leaves_the_body_softer_for_a_while() -> None:
    lasting = body(lasting_softening=0.6)
    before = np.vstack([held(3.0, 200), held(0.0, 100), held(0.5, 200)])
    gained = [run(p, before)[1][-1, 0] - run(p, held(0.5, 500))[1][-1, 0] for p in (lasting, RIGID)]
    # The rigid body differs by its hysteresis alone.
    assert gained[0] > 5.0 * abs(gained[1])


def pulled(motor: int, size: float, p: np.ndarray) -> np.ndarray:
    """The bend, a vector, after one motor has pulled and the others have given way."""
    U = np.roll(held(size, 300), motor, axis=1)
    pitch, roll = run(p, U)[1][-1]
    direction = np.array([np.tan(pitch), np.tan(roll)])
    return np.arctan(np.linalg.norm(direction)) * direction / np.linalg.norm(direction)


def turned(b: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([c * b[0] - s * b[1], s * b[0] + c * b[1]])


def test_lobes_are_the_same_after_a_third_of_a_turn_and_stiffer_towards_one() -> None:
    lobed = body(lobe_pitch=0.4)
    for motor in (1, 2):
        # The equations have no other direction; what is left is rounding.
        np.testing.assert_allclose(pulled(motor, 2.0, lobed), turned(pulled(0, 2.0, lobed), 120.0 * motor), atol=1e-9)
    assert pulled(0, 2.0, lobed)[0] < pulled(0, 2.0, RIGID)[0] < pulled(0, 2.0, body(lobe_pitch=-0.4))[0]
    # Lobes beside the pull push the link aside.
    assert abs(pulled(0, 2.0, body(lobe_roll=0.4))[1]) > 0.005 > abs(pulled(0, 2.0, lobed)[1])


def test_coupling_is_an_asymmetry_turned_by_45_deg() -> None:
    names = [number.name for number in PARAMETERS]
    numbers = GUESS.copy()
    numbers[names.index("asymmetry")] = 0.3
    U = held(2.0, 300)
    straight = run(RIGID, U, numbers)[1][-1]
    turned_numbers = GUESS.copy()
    turned_numbers[names.index("twist")] = np.radians(45.0)
    across = run(body(coupling=0.3), U, turned_numbers)[1][-1]
    # Tilts of a bend b are those of the turned bend: tan(pitch), tan(roll) turn as a vector.
    np.testing.assert_allclose(np.tan(across), turned(np.tan(straight), 45.0), atol=1e-9)


def test_a_link_at_its_stop_is_compressed_a_tenth_as_far() -> None:
    U = np.zeros((400, 3))
    U[10:] = 2.0  # all tendons alike: it is compressed and does not bend
    free, stopped = (run(p, U)[0][-1] for p in (RIGID, body(stop=20.0)))
    # A stiffer link stretches the tendons more: its drives stall earlier.
    assert (stopped < free - 0.1).all()
    np.testing.assert_array_equal(run(body(stop=1e-9), U)[0], run(RIGID, U)[0])


def index(name: str) -> int:
    return [number.name for number in PARAMETERS].index(name)


def test_two_branches_of_half_the_stiffness_creep_as_one() -> None:
    halves = body(creep=0.4, creep_rate=0.7, slow_creep=0.4, slow_creep_rate=0.7)
    U = held(1.5, 200)
    # The same sums in another order: rounding.
    np.testing.assert_allclose(run(halves, U)[1], run(body(creep=0.8, creep_rate=0.7), U)[1], atol=1e-12)


def test_drives_turn_at_their_top_speed_until_they_are_near() -> None:
    M, _ = run(body(top_speed=2.0), held(0.55, 100))
    speed = np.diff(M[:, 0]) / TS
    # The lag's 10 1/s alone would be faster down to 0.2 rad; sums of substeps round.
    far = 0.55 - M[:-1, 0] > 0.25
    np.testing.assert_allclose(speed[13:][far[13:]], 2.0, rtol=1e-9)
    assert far[13:].sum() >= 5
    assert M[-1, 0] == pytest.approx(0.55, abs=1e-3)
    np.testing.assert_array_equal(run(body(top_speed=1e3), held(0.55, 60))[0], run(RIGID, held(0.55, 60))[0])


def test_friction_holds_a_stalled_drive_back_and_falls_as_it_comes_to_rest() -> None:
    numbers = GUESS.copy()
    numbers[[index("gain"), index("compliance")]] = 0.0  # the link stays as it is
    limit, pretension = numbers[index("pull_limit")], numbers[index("pretension")]
    M = run(body(drag=0.2, drag_rate=3.0), held(2.0, 100), numbers)[0][:, 0]
    short = limit - pretension - M
    stalled = short <= 0.2 * limit
    assert short[stalled][0] == pytest.approx(0.2 * limit, rel=0.06)  # within a sample's yielding
    # Powers of substeps round.
    np.testing.assert_allclose(short[stalled][1:] / short[stalled][:-1], np.exp(-3.0 * TS), rtol=1e-9)
    assert stalled.sum() > 50
    np.testing.assert_array_equal(run(body(drag_rate=3.0), held(2.0, 60))[0], run(RIGID, held(2.0, 60))[0])


@pytest.mark.parametrize(("top_speed", "found"), [(2.0, "speed"), (100.0, "rigid")])
def test_the_speed_of_drives_is_kept_where_logged_motors_show_it(top_speed: float, found: str) -> None:
    data = recording(body(top_speed=top_speed), "mixed", 1, 300)
    model = GreyBox(sensor_delay=2, evaluations=8).fit(data)
    assert model.settings["body"] == found


def test_a_neck_at_home_where_it_rests_moves_as_one_that_rests_straight() -> None:
    numbers = GUESS.copy()
    # A cube of the bend and friction know where it is straight, or where it was.
    numbers[[index("stiffening"), index("friction")]] = 0.0
    leaning = numbers.copy()
    leaning[index("rest_pitch")] = 0.05
    U = held(1.0, 400)
    # In the plane of pitch the tilt is the bend. 8 s are far beyond its time constants.
    assert run(body(home_pitch=0.05), U, leaning)[1][-1, 0] == pytest.approx(run(RIGID, U, numbers)[1][-1, 0] + 0.05)
    assert abs(run(RIGID, U, leaning)[1][-1, 0] - run(RIGID, U, numbers)[1][-1, 0] - 0.05) > 0.01


def test_an_arc_rests_where_link_and_tendons_hold_the_least_energy() -> None:
    numbers = GUESS.copy()
    numbers[[index("friction"), index("compliance")]] = 0.0
    pretension, lever, gain, stiffness, stiffening = (
        numbers[index(name)] for name in ("pretension", "lever", "gain", "stiffness", "stiffening")
    )
    m = run(body(arc=2.0), held(1.0, 400), numbers)[0][-1]
    b = np.linspace(0.0, 0.5, 50_001)
    stretch = pretension + m[:, None] - lever * np.outer([1.0, -0.5, -0.5], b) - 2.0 * b**2
    energy = 0.5 * stiffness * b**2 + 0.25 * stiffening * b**4
    energy += gain / lever * 0.5 * (np.maximum(0.0, stretch) ** 2).sum(axis=0)
    # The grid's step is 1e-5 rad.
    found = run(body(arc=2.0), held(1.0, 400), numbers)[1][-1, 0]
    assert found == pytest.approx(b[np.argmin(energy)], abs=2e-5)
    assert abs(found - run(RIGID, held(1.0, 400), numbers)[1][-1, 0]) > 0.005


def test_the_search_for_the_top_speed_begins_at_the_recorded_one() -> None:
    U = np.zeros((400, 3))
    U[50:, 0], U[200:, 1] = 0.5, 0.5
    slow = body(top_speed=2.0)
    M, Y = run(slow, U)
    channels = dict(zip((*SET_POINTS, *MOTOR_POSITIONS, "pitch", "roll"), (*U.T, *M.T, *Y.T), strict=True))
    data = Recording(np.arange(len(U)) * TS, TS, channels)
    problem = FitProblem.of(ScaledData.of(data, amplitudes=False))
    speed, *_ = PARTS["speed"]
    # The drives get that fast; sums of substeps round.
    assert problem.guess(speed) == pytest.approx(2.0, rel=1e-9)
    # Set-points that the drives keep up with do not tell it.
    U = np.outer(0.5 * np.sin(0.04 * np.arange(400)), [1.0, -0.5, -0.5])
    M, Y = run(slow, U)
    channels = dict(zip((*SET_POINTS, *MOTOR_POSITIONS, "pitch", "roll"), (*U.T, *M.T, *Y.T), strict=True))
    smooth = FitProblem.of(ScaledData.of(replace(data, channels=channels), amplitudes=False))
    assert replace(smooth, logged=False).guess(speed) == smooth.guess(speed) == speed.guess
    assert problem.guess(PARAMETERS[0]) == PARAMETERS[0].guess


def test_trials_have_the_drives_of_the_whole() -> None:
    data = recording(RIGID, "eq22", 1, 400)
    scaled = ScaledData.of(data, amplitudes=False)
    whole = FitProblem.of(scaled)
    whole = replace(whole, drive_delays=whole.drive_delays + 2.0)  # as other rows might say
    x = np.array([number.encode(number.guess) for number in whole.numbers])
    fold = Fold(data, (Judged("part", data, np.ones(len(data), dtype=bool)),))
    trial = _trial(Found(whole, x, 2, 1.0), scaled, fold, 1, SearchProgress(silent, 1))
    for problem in (trial.found.problem, trial.judged[0][1]):
        np.testing.assert_array_equal(problem.drive_delays, whole.drive_delays)


def test_a_file_of_nine_numbers_of_the_body_is_one_without_the_later_parts(tmp_path: Path) -> None:
    model = GreyBox(sensor_delay=2, evaluations=1, body="creep").fit(recording(CREEP, "mixed", 1, 300))
    replace(model, arrays={**model.arrays, "body": body(creep=0.5)}).save(tmp_path / "new.npz")
    replace(model, arrays={**model.arrays, "body": body(creep=0.5)[:9]}).save(tmp_path / "old.npz")
    test = recording(CREEP, "sine", 3, 100)
    new, old = (load(tmp_path / f"{name}.npz").simulate(test) for name in ("new", "old"))
    np.testing.assert_array_equal(old, new)


@pytest.fixture(scope="module")
def creeping() -> Model:
    return GreyBox(sensor_delay=2).fit([recording(CREEP, "mixed", 1), recording(CREEP, "eq22", 2)])


@pytest.mark.slow
def test_the_creep_behind_its_own_equations_is_found(creeping: Model) -> None:
    found = {row["name"]: row for row in creeping.findings["numbers"]}
    # Each motion confirms the parts when the other is trained on.
    assert "creep" in creeping.settings["body"].split("+")
    fits = list(creeping.findings["parts"].values())
    assert fits[-1] > fits[0] + 0.5
    # Within 20 %: stiffness and creep share what the bend says of both.
    assert found["creep"]["value"] == pytest.approx(0.8, rel=0.2)
    # What the body has not is found to be next to nothing.
    nothing = {"softening": 0.0, "angle_2": 0.0, "angle_3": 0.0, "arm_2": 1.0, "arm_3": 1.0, "coupling": 0.0}
    for name in nothing.keys() & found.keys():
        assert found[name]["value"] == pytest.approx(nothing[name], abs=0.02)
    # Only what shows is told, which is creep.
    assert "time constant" in creeping.findings["found"]
    assert "compression" not in creeping.findings["found"]
    assert "time constant" in creeping.summary()


def test_rows_left_out_that_nobody_measured_say_nothing_of_parts() -> None:
    data = recording(RIGID, "eq22", 1, 200)
    problem = FitProblem.of(ScaledData.of(data, amplitudes=False))
    x = np.array([number.encode(number.guess) for number in problem.numbers])
    nothing = np.full(len(data), np.nan)
    measured, blank = (
        Judged("part", one, np.ones(len(data), dtype=bool))
        for one in (data, data.with_channels(pitch=nothing, roll=nothing))
    )
    assert _Trial(Found(problem, x, 2, 1.0), [(blank, problem)]).fit() == np.inf
    fits = [_Trial(Found(problem, x, 2, 1.0), [(one, problem) for one in judged]).fit()
            for judged in ([measured], [blank, measured])]  # fmt: skip
    assert fits[0] == fits[1] < 100.0


@pytest.mark.slow
def test_one_run_of_several_phases_confirms_creep() -> None:
    model = GreyBox(sensor_delay=2, evaluations=8).fit(recording(CREEP, "mixed", 1, 2500))
    assert "creep" in model.settings["body"].split("+")


@pytest.mark.slow
def test_a_rigid_body_gets_no_part() -> None:
    whole = GreyBox(sensor_delay=2).fit(recording(RIGID, "mixed", 1))
    assert whole.settings["body"] == "rigid"
    assert "parts" not in whole.findings
    same = GreyBox(sensor_delay=2, body="rigid").fit(recording(RIGID, "mixed", 1))
    np.testing.assert_array_equal(whole.arrays["neck"], same.arrays["neck"])


@pytest.mark.slow
def test_its_file_keeps_the_body(creeping: Model, tmp_path: Path) -> None:
    creeping.save(tmp_path / "m.npz")
    test = recording(CREEP, "sine", 3, 300)
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(test), creeping.simulate(test))
    spoiled = {**creeping.arrays, "body": body(creep=-1.0)}
    replace(creeping, arrays=spoiled).save(tmp_path / "spoiled.npz")
    with pytest.raises(FileFormatError, match="body"):
        load(tmp_path / "spoiled.npz")


@pytest.mark.parametrize("parts", ["", "foam", "creep+creep", "rigid+creep", "auto+creep"])
def test_parts_that_do_not_exist_are_refused(parts: str) -> None:
    with pytest.raises(SettingsError, match="auto, rigid, all, or some of anisotropy, stop, softening, creep, tendons"):
        GreyBox(body=parts)
