"""What to record next: motions on which members part, within a robot's limits."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.identification import Model, OutputError
from softneck.identification.selection._experiment_design import Bounds, Known, _greedy, motions, next_experiment
from softneck.identification.uncertainty._guarded import Guarded
from softneck.robot import Robot
from softneck.signals import SetPointLimits

from ...data import Truth, guarded_of, recording_from, short_neck


def line(roll: float) -> Model:
    """A neck whose roll answers `roll` times as much as the synthetic one's."""
    truth = Truth(gain=(0.011, 0.008 * roll))
    recording = recording_from(short_neck().set_points, truth=truth)
    return OutputError(nf=1, nb=1, delay=0.06).fit(recording)


@pytest.fixture(scope="module")
def known() -> Known:
    return Known.of_model(guarded_of([line(0.8), line(1.0), line(1.2)], short_neck()))


def test_a_second_motion_is_chosen_for_what_the_first_does_not_say() -> None:
    doubt = np.array([4.0, 4.0, 1.0])
    # The first two say the same, and most; beside one of them the third says more than the other.
    cover = np.array([[1.0, 0.9, 0.0], [1.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
    chosen, reached = _greedy(doubt, cover, 2)
    assert chosen == [0, 2]
    np.testing.assert_array_equal(reached, [1.0, 1.0, 1.0])


def test_motions_on_which_members_agree_are_not_chosen(known: Known) -> None:
    found = next_experiment(known, duration=40.0)
    # Members differ in roll alone, which motors that pull alike do not move.
    assert all(part.motion.signal != "cocontraction" for part in found.parts)
    assert all(part.spread > 0.0 for part in found.parts)
    assert found.after < found.before


def test_it_expects_what_the_members_expect_in_the_middle(known: Known) -> None:
    found = next_experiment(known, duration=20.0).recording
    first = found.rows(0, 500)
    # Each part begins at rest: what is expected is a free run of the middle member.
    np.testing.assert_allclose(first.outputs, line(1.0).simulate(first, warm_up=1)[:, :2], atol=1e-9)


@pytest.mark.parametrize("name", ["finger", "trunk4"])
def test_set_points_keep_the_limits_of_any_robot_and_begin_and_end_at_rest(name: str) -> None:
    robot = Robot.preset(name)
    bounds = Bounds.of(robot, SetPointLimits(speed=5.0, slack=1.0))
    motors, outputs = len(robot.motors.names), len(robot.outputs.names)
    # A member that expects nothing: distance alone decides.
    still: Any = SimpleNamespace(simulate=lambda motion, **_: np.zeros((len(motion), outputs)))
    nothing = Known(models=(still,), seen=np.zeros((1, motors)), reach=0.1, slope=np.full(outputs, 0.1),
                    sample_time=0.02, robot=robot, said="nothing")  # fmt: skip
    found = next_experiment(nothing, duration=25.0, bounds=bounds)
    P = found.recording.set_points
    assert len(P) == 1250
    assert P.min() >= -1.0
    assert P.min() >= min(robot.motors.setpoint_min or (0.0,))
    assert (P.max(axis=0) <= np.array(robot.motors.setpoint_max)).all()
    assert P.max() > 0.5
    # Rounding of sums of steps.
    assert np.abs(np.diff(P, axis=0)).max() <= 5.0 * 0.02 + 1e-9
    np.testing.assert_array_equal(P[0], 0.0)
    # One sample short of rest, where the ramp out ends.
    np.testing.assert_allclose(P[-1], 0.0, atol=0.02)


def test_a_range_without_zero_rests_at_its_end() -> None:
    robot = Robot.preset("finger")
    robot = replace(robot, motors=replace(robot.motors, setpoint_min=(0.5,)))
    P = Bounds.of(robot).within(np.full((400, 1), 2.0), 0.02)
    assert P[0, 0] == 0.5
    assert P.min() >= 0.5
    assert P.max() == 2.0


def test_the_same_seed_is_the_same_experiment(known: Known) -> None:
    drawn = [motions(known.robot, 0.02, 200, Bounds.of(known.robot), seed) for seed in (1, 1, 2)]
    same = [[np.array_equal(one.set_points, drawn[0][i].set_points) for i, one in enumerate(own)] for own in drawn]
    assert all(same[1])
    # Those without anything random are the same.
    assert {one.signal for one, alike in zip(drawn[2], same[2], strict=True) if alike} == {"eq22", "rotation"}


def test_a_robot_needs_no_sample_time_of_its_own(known: Known) -> None:
    unsaid = replace(known.robot, sample_time_s=None)
    assert len(motions(unsaid, 0.05, 80, Bounds.of(unsaid), 0)[0].set_points) == 80


def test_motions_beyond_the_outputs_range_are_left_out(known: Known) -> None:
    narrow = replace(known.robot, outputs=replace(known.robot.outputs, min=(-0.05, -0.05), max=(0.05, 0.05)))
    kept = next_experiment(replace(known, robot=narrow), duration=10.0).recording
    assert np.abs(kept.outputs).max() <= 0.05
    none = replace(known.robot, outputs=replace(known.robot.outputs, min=(0.01, 0.01), max=(0.05, 0.05)))
    with pytest.raises(SettingsError, match="lower --max-position"):
        next_experiment(replace(known, robot=none), duration=10.0)


def test_a_guarded_model_says_what_was_seen_and_its_base_has_no_vote() -> None:
    from softneck.identification.uncertainty._guarded import Base

    members = [line(0.9), line(1.1)]
    model = Guarded().around(Base(line(3.0), np.full(2, 0.01), np.array([90.0, 90.0])), members, short_neck())
    known = Known.of_model(model)
    assert len(known.models) == 2
    assert known.seen is not None
    assert known.reach == model.arrays["reach"][0]


def test_a_model_of_one_piece_is_refused() -> None:
    with pytest.raises(SettingsError, match="has no members that could part"):
        Known.of_model(line(1.0))
