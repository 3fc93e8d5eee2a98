"""Recordings: what they refuse, and runs that are never joined."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.robot import Robot
from softneck.signals import Recording, concatenate

from ..data import TS, neck_recording, with_time


def three_runs() -> Recording:
    return concatenate([neck_recording(rows, seed=rows) for rows in (120, 130, 140)])


def test_runs_come_apart_as_they_were_put_together() -> None:
    runs = three_runs().runs()
    assert [len(run) for run in runs] == [120, 130, 140]
    for run, rows in zip(runs, (120, 130, 140), strict=True):
        np.testing.assert_array_equal(run.outputs, neck_recording(rows, seed=rows).outputs)
        assert run.time[0] == 0.0


def test_a_split_cuts_every_run_and_loses_no_row() -> None:
    whole = three_runs()
    head, tail = whole.split(0.7)
    assert [len(run) for run in head.runs()] == [84, 91, 98]
    assert [len(run) for run in tail.runs()] == [36, 39, 42]
    for run, first, second in zip(whole.runs(), head.runs(), tail.runs(), strict=True):
        np.testing.assert_array_equal(np.vstack([first.outputs, second.outputs]), run.outputs)


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.0, 1.1, np.nan])
def test_a_part_that_is_none_is_refused(fraction: float) -> None:
    with pytest.raises(DataError, match="the part to split off must be between 0 and 1, without both; got"):
        three_runs().split(fraction)


def test_different_sample_times_are_not_put_together() -> None:
    slow = neck_recording(120)
    slow = Recording(slow.time * 2, 2 * TS, slow.channels)
    with pytest.raises(DataError, match=r"different sample times cannot be used together: 0\.02 s and 0\.04 s"):
        concatenate([neck_recording(120), slow])
    with pytest.raises(DataError, match="there is no recording"):
        concatenate([])


def test_motor_positions_are_the_set_points_where_none_were_logged() -> None:
    plain = neck_recording(120, positions=False)
    assert not plain.has_motor_positions
    np.testing.assert_array_equal(plain.motor_positions, plain.set_points)
    assert np.abs(neck_recording(120).motor_positions - plain.set_points).max() > 0.1


@pytest.mark.parametrize("name", ["motor_setpoint_2", "pitch"])
def test_a_missing_channel_is_named(name: str) -> None:
    r = neck_recording(120)
    channels = {key: value for key, value in r.channels.items() if key != name}
    with pytest.raises(DataError, match=rf"missing: {name}"):
        Recording(r.time, TS, channels)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("motor_setpoint_1", np.nan, r"channel `motor_setpoint_1` is nan at row 7 \(t = 0\.14 s\)"),
        ("motor_position_3", np.inf, "channel `motor_position_3` is inf at row 7"),
        ("pitch", np.inf, "channel `pitch` is inf at row 7"),
    ],
)
def test_a_value_that_is_not_finite_is_named_with_its_time(name: str, value: float, message: str) -> None:
    r = neck_recording(120)
    bad = r.channels[name].copy()
    bad[7] = value
    with pytest.raises(DataError, match=message):
        r.with_channels(**{name: bad})


def test_a_missed_sample_of_a_sensor_is_allowed() -> None:
    r = neck_recording(120)
    pitch = r.channels["pitch"].copy()
    pitch[7] = np.nan
    assert np.isnan(r.with_channels(pitch=pitch).outputs[7, 0])


def test_an_unknown_channel_and_a_wrong_shape_are_named() -> None:
    r = neck_recording(120)
    with pytest.raises(DataError, match="`yaw` is not a channel of a recording; known: time, motor_setpoint_1"):
        r.with_channels(yaw=r.time)
    with pytest.raises(DataError, match=r"channel `pitch` has shape \(119,\); time has \(120,\)"):
        r.with_channels(pitch=r.time[1:])
    with pytest.raises(DataError, match=r"`run` has shape"):
        with_time(r, r.time, np.zeros(5, dtype=int))
    with pytest.raises(DataError, match="the recording has no rows"):
        r.rows(5, 5)
    for sample_time in (0.0, 1e-294, 1e286):
        with pytest.raises(SettingsError, match=r"`sample_time` must be between 1e-09 and 1e\+09 \[s\]"):
            Recording(r.time, sample_time, r.channels)


def test_time_that_runs_backwards_or_jumps_is_named() -> None:
    r = neck_recording(120)
    back, jump, nan = r.time.copy(), r.time.copy(), r.time.copy()
    back[60:] -= 0.5
    jump[60:] += 0.5
    nan[60] = np.nan
    with pytest.raises(DataError, match=r"`time` runs backwards or stands still at row 60 \(1\.18 to 0\.7 s\)"):
        with_time(r, back)
    with pytest.raises(
        DataError, match=r"`time` jumps by 0\.52 s at row 60 \(t = 1\.7 s\) where the sample time is 0\.02"
    ):
        with_time(r, jump)
    with pytest.raises(DataError, match="`time` is not finite at row 60"):
        with_time(r, nan)


def test_a_new_run_may_start_at_any_time() -> None:
    r = neck_recording(120)
    for shift in (-0.5, 0.5):
        time = r.time.copy()
        time[60:] += shift
        assert len(with_time(r, time, np.repeat([4, 9], 60)).runs()) == 2


def test_a_loggers_jitter_of_two_percent_is_allowed() -> None:
    r = neck_recording(120)
    jitter = np.where(np.arange(120) % 2, 0.0, 1.0)
    with_time(r, r.time + 0.019 * TS * jitter)
    with pytest.raises(DataError, match="`time` jumps by"):
        with_time(r, r.time + 0.021 * TS * jitter)


def test_angles_beyond_half_a_turn_are_taken_for_degrees() -> None:
    whole = neck_recording(100)
    with pytest.raises(DataError, match=r"channel `roll` is 20 rad at row 4, more than half a turn; is it in degrees"):
        whole.with_channels(roll=np.where(np.arange(100) == 4, 20.0, 0.0))


def test_what_no_tendons_bend_may_turn_more_than_once() -> None:
    robot = Robot.from_dict({
        "name": "stage", "sample_time_s": 0.02, "motors": {"names": ["motor_1"], "unit": "rad"},
        "outputs": {"names": ["angle"], "unit": "rad"}, "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip
    angle = np.linspace(0.0, 40.0, 200)
    turned = Recording.from_arrays(np.zeros((200, 1)), angle[:, None], robot=robot)
    np.testing.assert_array_equal(turned.outputs[:, 0], angle)
    assert Robot.preset("neck").angle_limit == np.pi


def test_set_points_alone_have_outputs_that_were_not_measured() -> None:
    alone = Recording.from_arrays(np.zeros((5, 3)))
    assert np.isnan(alone.outputs).all()
    assert alone.outputs.shape == (5, 2)
