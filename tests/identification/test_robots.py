"""Models of other robots than the neck: the truth behind clean records, time scales, files, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from scipy.signal import lfilter

from softneck import identify, load, validate
from softneck.core import DataError, FileFormatError, Matrix, SettingsError
from softneck.identification import FamilySettings, choose
from softneck.identification.models._directions import directions_of
from softneck.robot import Robot, load_for_robot
from softneck.signals import Recording

from ..data import slow_but

POLE, GAIN, DELAY = 0.9, 0.08, 3
# Three outputs of four chambers that nobody told the directions of.
BELLOWS: dict[str, Any] = {
    "name": "bellows",
    "motors": {"names": ["a", "b", "c", "d"], "unit": "bar"},
    "outputs": {"names": ["x", "y", "z"], "unit": "mm"},
    "directions": {"kind": "identified"},
}
WEIGHTS = np.array([[0.8, -0.6, 0.0, 0.0], [0.0, 0.6, 0.8, 0.0], [0.5, 0.5, 0.5, 0.5]])
ROBOTS = {name: Robot.preset(name) for name in ("finger", "antagonist", "trunk4")} | {
    "bellows": Robot.from_dict(BELLOWS)
}
KINDS_AND_SETTINGS: dict[str, dict[str, Any]] = {
    "rls": {"delay": 0.06},
    "oe": {"delay": 0.06},
}


def weights_of(robot: Robot) -> Matrix:
    given = robot.weights()
    return WEIGHTS if given is None else given


def recorded(
    robot: Robot, *, sample_time: float = 0.02, rows: int = 700, noise: float = 0.0, rest: float = 0.0
) -> Recording:
    """Each output a lag behind its direction, DELAY + 1 samples late, around `rest`."""
    rng = np.random.default_rng(4)
    W = weights_of(robot)
    U = np.repeat(rng.uniform(-2.0, 2.0, (rows // 10 + 1, W.shape[1])), 10, axis=0)[:rows]
    Y = np.zeros((rows, len(W)))
    for k in range(rows - 1):
        Y[k + 1] = POLE * Y[k] + (1.0 - POLE) * GAIN * W @ U[max(k - DELAY, 0)]
    Y += rest + noise * rng.standard_normal(Y.shape)
    channels = dict(zip(robot.set_points, U.T, strict=True)) | dict(zip(robot.outputs.names, Y.T, strict=True))
    return Recording(sample_time * np.arange(rows), sample_time, channels, robot=robot)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("kind", KINDS_AND_SETTINGS)
def test_the_truth_behind_a_record_is_recovered(kind: str, name: str, tmp_path: Path) -> None:
    recording = recorded(ROBOTS[name], noise=1e-5, rest=0.3)
    model = identify(kind, recording, train=1.0, **KINDS_AND_SETTINGS[kind])
    free = model.simulate(recording)[25:, : recording.outputs.shape[1]]
    # Noise of 1e-5 in a motion of 0.1: what is left is a few times that.
    assert np.abs(free - recording.outputs[25:]).max() < 2e-3
    system = model.ss()
    np.testing.assert_allclose(system.dcgain(), GAIN * weights_of(ROBOTS[name]), atol=2e-3)
    assert np.abs(np.abs(system.poles()) - POLE).min() < 2e-3
    model.save(tmp_path / "m.npz")
    again = load(tmp_path / "m.npz")
    assert again.robot.hash == recording.robot.hash
    np.testing.assert_array_equal(again.simulate(recording), model.simulate(recording))
    assert [port.name for port in again.block().outputs][: free.shape[1]] == list(recording.robot.outputs.names)


def test_directions_that_nobody_gave_are_learned_with_the_time_constant() -> None:
    recording = recorded(ROBOTS["bellows"])
    found = directions_of(recording, [recording.set_points])
    assert found.learned
    # The dead time of three samples bends the low-pass that is fitted here a little; weights are of length 1.
    np.testing.assert_allclose(found.weights, WEIGHTS / np.linalg.norm(WEIGHTS, axis=1, keepdims=True), atol=0.02)
    assert np.all((found.seconds > 0.15) & (found.seconds < 0.35))  # 0.19 s, and part of the dead time
    assert found.findings()["directions_from"] == "data"


@pytest.mark.parametrize("kind", ["rls", "oe"])
def test_the_same_rows_at_another_sample_time_give_the_same_model(kind: str) -> None:
    """Nothing is in seconds: a tank sampled every 4 s is identified as well as a finger every 20 ms."""
    fast, slow = (recorded(ROBOTS["finger"], sample_time=s, rows=300, noise=1e-3) for s in (0.02, 4.0))
    model, other = identify(kind, fast, train=1.0), identify(kind, slow, train=1.0)
    assert other.findings["time_constants_s"] == pytest.approx(200.0 * np.array(model.findings["time_constants_s"]))
    # The searches take the same steps but for rounding.
    np.testing.assert_allclose(other.simulate(slow), model.simulate(fast), atol=1e-6)
    assert other.arrays["delay"][0] == model.arrays["delay"][0]


def test_rls_over_the_motors_takes_any_robot() -> None:
    recording = recorded(ROBOTS["bellows"], noise=1e-5)
    for structure in ("miso", "mimo"):
        model = identify("rls", recording, train=1.0, structure=structure, delay=0.06)
        np.testing.assert_allclose(model.ss().dcgain(), GAIN * WEIGHTS, atol=2e-3)


@pytest.mark.parametrize("structure", ["miso", "mimo"])
def test_rls_over_motors_in_pairs_learns_nothing_of_what_they_never_did(structure: str) -> None:
    """Rounding of `a + c = b + d` had gains far larger than those of the motions."""
    seen = recorded(ROBOTS["bellows"], rows=2000)
    a, b, c, _ = (np.round(seen.channels[name], 3) for name in seen.robot.set_points)
    rounding = np.round(np.random.default_rng(8).uniform(-1e-3, 1e-3, a.size), 3)
    U = np.column_stack([a, b, c, a + c - b + rounding])
    x = lfilter([1.0 - POLE], [1.0, -POLE], GAIN * U @ WEIGHTS.T, axis=0)
    Y = np.concatenate([np.zeros((DELAY + 1, 3)), x[: -DELAY - 1]])
    Y += 1e-3 * np.random.default_rng(9).standard_normal(Y.shape)
    channels = dict(zip(seen.robot.set_points, U.T, strict=True)) | dict(zip("xyz", Y.T, strict=True))
    model = identify("rls", seen.with_channels(**channels), train=1.0, delay=0.06, structure=structure)
    never = np.array([1.0, -1.0, 1.0, -1.0]) / 2.0
    made = WEIGHTS - np.outer(WEIGHTS @ never, never)
    np.testing.assert_allclose(model.ss().dcgain(), GAIN * made, atol=0.1 * GAIN)  # noise of a hundredth of the motion


@pytest.mark.parametrize("name", ["finger", "bellows"])
def test_play_takes_any_robot(name: str, tmp_path: Path) -> None:
    recording = recorded(ROBOTS[name], noise=1e-4, rest=0.3)
    # A lag of 0.2 s behind a chain of five filters of 0.02 s: what such a chain cannot follow is a few per cent.
    model = identify("play", recording, train=1.0, rate=20.0, order=6, widths=(), degree=2, ridge=1e-6)
    fits = validate(model, recording, include_training=True).fits["inf"].values()
    assert min(fit or 0.0 for fit in fits) > 93.0
    model.save(tmp_path / "m.npz")
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(recording), model.simulate(recording))


# A few weights and steps: enough for a lag.
NETWORKS: dict[str, dict[str, Any]] = {
    "nn": {"hidden": (3, 3), "iterations": 10, "refine": 12, "starts": 2},
}


@pytest.mark.parametrize("name", slow_but(["finger", "bellows"], ["finger"]))
@pytest.mark.parametrize("kind", NETWORKS)
def test_networks_take_any_robot(kind: str, name: str, tmp_path: Path) -> None:
    recording = recorded(ROBOTS[name], noise=1e-4, rest=0.3)
    train, test = recording.split(0.7)
    model = identify(kind, train, train=1.0, **NETWORKS[kind])
    # A dead time that lies between the samples of the regressor costs a network a tenth or two.
    assert min(fit or 0.0 for fit in validate(model, test).fits["inf"].values()) > (75.0 if kind == "nn" else 95.0)
    model.save(tmp_path / "m.npz")
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(recording), model.simulate(recording))


# What is simulated for the set, or measured by it; and how far a set over noise of a hundredth gets.
SETS = {
    # Its weight of the outputs is chosen: how components range differs from robot to robot.
    "paper": ("nlsm", {"epsilon": 3e-3}, 40.0),
    "residual": ("nlsm", {"form": "residual", "epsilon": 3e-3, "output_weight": 5.0}, 95.0),
    "chosen": ("nlsm", {"form": "residual"}, 95.0),
}


@pytest.mark.parametrize("name", slow_but(["finger", "antagonist", "bellows"], ["finger"], ["antagonist", "bellows"]))
@pytest.mark.parametrize("form", slow_but(SETS, ["residual"]))
def test_set_membership_takes_any_robot(form: str, name: str, tmp_path: Path) -> None:
    kind, settings, least = SETS[form]
    recording = recorded(ROBOTS[name], noise=1e-3, rest=0.3)
    train, test = recording.split(0.7)
    model = identify(kind, train, train=1.0, **settings)
    judged = validate(model, test)
    assert min(fit or 0.0 for fit in judged.fits["inf"].values()) > least
    assert judged.coverage_pct is not None
    # Made for 97 % of what it was trained on, and the paper's set is fed back what it says.
    assert min(judged.coverage_pct.values()) > (75.0 if form == "paper" else 95.0)
    ports = [port.name for port in model.block().outputs]
    first = recording.robot.outputs.names[0]
    assert ports[-2 * recording.outputs.shape[1] - 1 :][:2] == [f"{first}_lower", f"{first}_upper"]
    assert ports[-1] == "validity"
    model.save(tmp_path / "m.npz")
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(test), model.simulate(test))
    # Who starts where the robot rests stays there: the set adds the rest, the base nothing.
    if form != "paper":
        starts = {f"{output}_start": 0.3 for output in recording.robot.outputs.names}
        state = model.block().initial_state(**starts)
        _, rest = model.step(state, np.zeros(recording.set_points.shape[1]))
        np.testing.assert_allclose(rest[: recording.outputs.shape[1]], 0.3, atol=0.02)


@pytest.mark.parametrize("form", slow_but(SETS, ["residual"]))
def test_a_set_of_the_same_rows_at_another_sample_time_is_the_same(form: str) -> None:
    kind, settings, _ = SETS[form]
    fast, slow = (recorded(ROBOTS["finger"], sample_time=s, rows=300, noise=1e-3) for s in (0.02, 4.0))
    model, other = (identify(kind, one, train=1.0, **settings) for one in (fast, slow))
    np.testing.assert_array_equal(other.arrays["table"], model.arrays["table"])
    # The bases' searches take the same steps but for rounding.
    np.testing.assert_allclose(other.simulate(slow), model.simulate(fast), atol=1e-5)


@pytest.mark.parametrize("kind", NETWORKS)
def test_networks_of_the_same_rows_at_another_sample_time_are_the_same(kind: str) -> None:
    fast, slow = (recorded(ROBOTS["finger"], sample_time=s, rows=300, noise=1e-3) for s in (0.02, 4.0))
    model, other = (identify(kind, one, train=1.0, **{**NETWORKS[kind], "starts": 1}) for one in (fast, slow))
    # The searches take the same steps but for rounding, which training makes grow.
    np.testing.assert_allclose(other.simulate(slow), model.simulate(fast), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(["finger", "trunk4"], [], ["trunk4"]))
@pytest.mark.parametrize("sample_time", slow_but([0.02, 1.0], [], [1.0]))
def test_a_family_holds_the_truth_of_each_axis(name: str, sample_time: float, tmp_path: Path) -> None:
    recording = recorded(ROBOTS[name], sample_time=sample_time, rows=500, noise=1e-4, rest=0.3)
    family = FamilySettings(window=4.0).fit(recording)
    assert list(family.axes) == list(recording.robot.outputs.names)
    assert family.directions is not None
    np.testing.assert_allclose(family.directions, weights_of(recording.robot))
    for output, axis in family.axes.items():
        gain, pole, delay = axis.nominal
        # Noise of a thousandth of the motion; the middle of a box over a few windows.
        assert gain == pytest.approx(GAIN, rel=0.03)
        assert pole == pytest.approx(-np.log(POLE) / sample_time, rel=0.05)
        assert delay == pytest.approx(DELAY * sample_time, rel=0.1)
        assert family.covered(output) <= 1.0 + 1e-9
        G, W = family.tf(output), family.weight(output)
        assert float(np.real(G.dcgain())) == pytest.approx(gain, rel=1e-6)
        assert np.all(np.real(W.poles()) < 0.0)
    # Each axis answers to its own direction; the record's first motion, from no rest, costs a tenth.
    np.testing.assert_allclose(family.cross, GAIN * np.eye(len(family.axes)), atol=0.15 * GAIN)
    family.save(tmp_path / "f.npz")
    again = load(tmp_path / "f.npz")
    assert again.robot.hash == recording.robot.hash
    assert again.summary() == family.summary()
    np.testing.assert_array_equal(again.directions, family.directions)


def test_a_family_of_two_robots_is_refused() -> None:
    with pytest.raises(DataError, match="recordings of two robots"):
        FamilySettings().fit([recorded(ROBOTS["antagonist"]), recorded(ROBOTS["finger"])])


def test_the_kinds_that_take_a_robot_are_tried_and_the_best_is_chosen() -> None:
    finger = Robot.from_dict({**ROBOTS["finger"].as_dict(), "directions": {"kind": "matrix", "matrix": [[1.0]]}})
    recording = recorded(finger, noise=1e-3, rows=400)
    choice = choose(*recording.split(0.7), kinds=("rls", "oe", "greybox"))
    assert choice.chosen.kind in ("rls", "oe")
    assert choice.chosen.fit > 90.0
    failed = {one.kind: one.failure for one in choice.ranking if one.model is None}
    assert list(failed) == ["greybox"]
    assert "must know where tendons stand" in failed["greybox"]


def test_scores_are_by_the_outputs_names_and_in_their_unit() -> None:
    recording = recorded(ROBOTS["bellows"], noise=1e-3)
    head, tail = recording.split(0.6)
    said = validate(identify("oe", head, train=1.0, delay=0.06), tail).as_dict()
    assert list(said["fits"]["model"]["inf"]) == ["x", "y", "z"]
    assert said["unit"] == "mm"
    # Noise of 1e-3 m.
    assert all(0.7 < value < 1.5 for value in said["rmse"]["inf"].values())
    assert "rmse_deg" not in said
    finger = recorded(ROBOTS["finger"], noise=1e-3)
    assert (
        "rmse_deg" in validate(identify("oe", finger, train=1.0, delay=0.06), finger, include_training=True).as_dict()
    )


def test_the_equations_of_tendons_are_of_no_robot_without_them() -> None:
    with pytest.raises(SettingsError, match=r"kind `greybox` has motors in rad or deg, and `motors.unit` of robot"):
        identify("greybox", recorded(ROBOTS["bellows"]), train=1.0)
    angles = {"motors": {**BELLOWS["motors"], "unit": "rad"}, "outputs": {**BELLOWS["outputs"], "unit": "rad"}}
    with pytest.raises(SettingsError, match="kind `greybox` must know where tendons stand"):
        identify("greybox", recorded(Robot.from_dict({**BELLOWS, **angles})), train=1.0)


# Of each kind what is quick.
EVERY_KIND = {
    **KINDS_AND_SETTINGS,
    **NETWORKS,
    "play": {"rate": 5.0, "widths": (), "degree": 1, "ridge": 1e-4},
    "nlsm": {"form": "residual", "epsilon": 0.02, "output_weight": 5.0},
    "greybox": {"evaluations": 1, "sensor_delay": 1},
}


@pytest.mark.parametrize("name", slow_but(ROBOTS, ["finger"], [*ROBOTS][1:]))
@pytest.mark.parametrize("kind", slow_but(EVERY_KIND, ["play"], [*EVERY_KIND][:-3] + [*EVERY_KIND][-2:]))
def test_a_model_of_a_robot_that_goes_on_and_on_is_read_as_it_was_written(kind: str, name: str, tmp_path: Path) -> None:
    """Its time constant is taken for a third of the record: what is by the time constant must fit into a file."""
    recording = recorded(ROBOTS[name], rows=2600, noise=1e-3)
    drift = np.cumsum(recording.outputs, axis=0) / 500.0
    recording = recording.with_channels(**dict(zip(recording.robot.outputs.names, drift.T, strict=True)))
    if kind == "greybox" and recording.robot.directions.kind != "tendons":
        pytest.skip("its equations are of tendons")
    model = identify(kind, recording, train=1.0, **EVERY_KIND[kind])
    assert model.findings.get("time_constants_s", [10.0])[0] > 5.0
    model.save(tmp_path / "m.npz")
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(recording), model.simulate(recording))


def test_models_and_recordings_of_two_robots_are_not_mixed() -> None:
    model = identify("oe", recorded(ROBOTS["finger"]), train=1.0, delay=0.06)
    with pytest.raises(DataError, match=r"of two robots cannot be used together: `finger` \(\w+\) and `antagonist` \("):
        model.simulate(recorded(ROBOTS["antagonist"]))
    with pytest.raises(DataError, match="of two robots"):
        model.initial_state(recorded(ROBOTS["trunk4"]))


def test_a_robot_whose_set_points_have_one_sign_rests_at_the_mean_of_its_data(tmp_path: Path) -> None:
    seen = recorded(ROBOTS["bellows"], rest=0.3)
    pressed = seen.with_channels(**{name: seen.channels[name] + 3.0 for name in seen.robot.set_points})
    assert identify("oe", seen, train=1.0, delay=0.06).robot.motors.rest is None
    model, family = identify("oe", pressed, train=1.0, delay=0.06), FamilySettings().fit(pressed)
    for robot in (model.robot, family.robot):
        assert robot.motors.rest == pytest.approx(pressed.set_points.mean(axis=0) / 1e5, rel=1e-5)  # six digits
        assert robot.outputs.rest == pytest.approx(pressed.outputs.mean(axis=0) / 1e-3, rel=1e-5)
    # A robot file without `rest` leaves the model's, another one decides.
    model.save(tmp_path / "m.npz")
    (tmp_path / "robot.toml").write_text(tomli_w.dumps(BELLOWS), encoding="utf-8")
    assert load_for_robot(tmp_path / "m.npz").robot.motors.rest == model.robot.motors.rest
    own = BELLOWS | {"motors": BELLOWS["motors"] | {"rest": 2e-5}}
    (tmp_path / "robot.toml").write_text(tomli_w.dumps(own), encoding="utf-8")
    assert load_for_robot(tmp_path / "m.npz").robot.motors.rest == (2e-5,) * 4


def test_a_transfer_function_is_of_the_direction_or_of_a_motor() -> None:
    model = identify("oe", recorded(ROBOTS["trunk4"]), train=1.0, delay=0.06)
    # The direction of tendons at 0 and 180 deg is the difference of their motors.
    for G in (model.tf("pitch"), model.tf("pitch", input="motor_setpoint_1")):
        assert float(G.dcgain()) == pytest.approx(GAIN, abs=2e-3)


def test_an_output_that_follows_no_motor_is_said() -> None:
    recording = recorded(ROBOTS["finger"])
    rng = np.random.default_rng(0)
    still = recording.with_channels(motor_setpoint_1=np.r_[1.0, np.zeros(len(recording) - 1)] * 0.0 + 1.0)
    with pytest.raises(DataError, match="set-points are constant"):
        identify("oe", still.with_channels(pitch=rng.standard_normal(len(recording)) * 0.01))


def test_a_file_whose_arrays_do_not_fit_its_robot_is_refused(tmp_path: Path) -> None:

    model = identify("oe", recorded(ROBOTS["finger"]), train=1.0, delay=0.06)
    replace(model, robot=ROBOTS["trunk4"]).save(tmp_path / "m.npz")
    with pytest.raises(FileFormatError):
        load(tmp_path / "m.npz")
