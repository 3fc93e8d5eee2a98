"""Recordings: what they refuse, and runs that are never joined."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.robot import Robot, Scaling
from softneck.signals import Recording, concatenate
from softneck.signals.recording._channels import (
    column_name,
    file_unit,
    is_held,
    known_channels,
    may_miss,
    parse_column,
    si_unit,
)
from softneck.signals.recording._recording import (
    check_rising,
    conditions,
    median_step,
    merge_conditions,
    scale_recording,
    uneven_steps,
)

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


@pytest.mark.parametrize(("Ts", "most"), [(4.0, 0.08), (TS, 0.02 * TS), (1e-7, 2e-9), (1e-8, 1e-9), (1e-9, 1e-9)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_may_be_off_by_two_percent_or_by_the_rounding_of_printed_times(
    Ts: float, most: float, sign: float
) -> None:
    time = Ts * np.arange(8)
    run = np.repeat([0, 1], 4)
    for off, uneven in ((0.95 * most, []), (1.05 * most, [5])):
        moved = time + sign * off * (np.arange(8) > 5) + 100.0 * Ts * run
        assert np.flatnonzero(uneven_steps(moved, Ts, run)).tolist() == uneven


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


# -- arrays, runs, conditions ------------------------------------------------------------------------------------------


def test_rows_of_arrays_are_equidistant_and_each_run_begins_at_zero() -> None:
    U = np.arange(21.0).reshape(7, 3)
    run = [3, 3, 3, 5, 5, 3, 3]
    made = Recording.from_arrays(U, 0.01 * U[:, :2], motor_positions=-U, sample_time=0.5, run=run)
    assert made.time.tolist() == [0.0, 0.5, 1.0, 0.0, 0.5, 0.0, 0.5]
    assert [part.run[0] for part in made.runs()] == [3, 5, 3]
    assert (made.set_points.tolist(), made.motor_positions.tolist()) == (U.tolist(), (-U).tolist())
    assert made.outputs.tolist() == (0.01 * U[:, :2]).tolist()
    plain = Recording.from_arrays(U)
    assert (plain.sample_time, plain.run.tolist(), plain.time[1]) == (0.02, [0] * 7, 0.02)
    slow = Robot.from_dict({"name": "slow", "extends": "neck", "sample_time_s": 4.0})
    assert Recording.from_arrays(U, robot=slow).sample_time == 4.0
    assert Recording.from_arrays(U, robot=slow, sample_time=0.5).sample_time == 0.5


@pytest.mark.parametrize("run", [[0, 0, 1], [0.0] * 4, [[0] * 4], [True] * 4], ids=str)
def test_numbers_of_runs_are_integers_one_a_row(run: list) -> None:
    with pytest.raises(DataError, match=r"`run` must be integers of shape \(4,\); got"):
        Recording.from_arrays(np.zeros((4, 3)), run=run)


@pytest.mark.parametrize("rows", [1, 2])
def test_a_summary_counts_rows_and_runs(rows: int) -> None:
    made = concatenate([neck_recording(100)] * rows)
    first, second = made.summary().splitlines()
    assert first == f"{100 * rows} rows of 20 ms in {rows} run(s), robot neck"
    assert second.startswith("set-points of 3 motors, ")
    assert "pitch, roll" in second
    assert "setpoint" not in second


@pytest.mark.parametrize("Ts", [1e-6, 1e-3, 4.0])
def test_sample_times_are_the_same_to_a_millionth_at_any_pace(Ts: float) -> None:
    def of(sample_time: float) -> Recording:
        return Recording(sample_time * np.arange(50), sample_time, neck_recording(50).channels)

    assert concatenate([of(Ts), of(Ts * (1.0 + 5e-7))]).sample_time == Ts
    for factor in (1.0 + 5e-6, 1.0 - 5e-6):
        with pytest.raises(DataError, match="different sample times"):
            concatenate([of(Ts), of(Ts * factor)])


def test_recordings_put_together_keep_what_all_have_and_a_payload_of_one_is_zero_elsewhere() -> None:
    one = neck_recording(100, positions=False).with_channels(payload=np.full(100, 0.7), compression=np.zeros(100))
    two = neck_recording(120, seed=2)
    for parts in ([one, two], [two, one]):
        both = concatenate(parts)
        assert set(both.channels) == set(one.channels) - {"compression"}
        assert [set(part.channels["payload"]) for part in both.runs()] == [
            {0.7} if len(part) == 100 else {0.0} for part in both.runs()
        ]
    with pytest.raises(DataError, match=r"\(first\.csv and second\.csv\)"):
        concatenate([one, Recording(two.time * 2, 2 * TS, two.channels)], names=["first.csv", "second.csv"])


def test_conditions_are_the_range_of_payload_and_of_the_mean_set_point() -> None:
    U = np.array([[1.0, 2.0, 6.0], [0.0, -3.0, 0.0], [1.0, 1.0, 1.0]])
    plain = Recording.from_arrays(U)
    loaded = plain.with_channels(payload=np.array([0.2, 0.9, 0.4]))
    assert conditions(plain) == {"payload_kg": [0.0, 0.0], "cocontraction": [-1.0, 3.0]}
    assert conditions(loaded) == {"payload_kg": [0.2, 0.9], "cocontraction": [-1.0, 3.0]}
    other = {"payload_kg": [0.5, 1.5], "cocontraction": [0.0, 2.0]}
    for parts in ([conditions(loaded), other], [other, conditions(loaded)]):
        assert merge_conditions(parts) == {"payload_kg": [0.2, 1.5], "cocontraction": [-1.0, 3.0]}
    assert merge_conditions([]) == {}


def test_a_recording_is_scaled_where_it_has_units_and_nowhere_else() -> None:
    """Of a robot in kPa and mm at 2 s: motors, outputs and times have each their factor, loads and flags none."""
    robot = Robot.from_dict({
        "name": "bellows", "time_constant_s": 2.0, "directions": {"kind": "matrix", "matrix": [[1.0]]},
        "motors": {"names": ["p"], "unit": "kPa", "nominal": 50.0},
        "outputs": {"names": ["x"], "unit": "mm", "nominal": 30.0},
    })  # fmt: skip
    scaling = Scaling.of(robot)
    t = np.arange(8.0)
    made = Recording.from_arrays(
        1e3 * t[:, None], 1e-3 * t[:, None], motor_positions=2e3 * t[:, None], sample_time=0.4, robot=robot
    ).with_channels(payload=t)
    found = scale_recording(made, scaling)
    # Scaled numbers are rounded to 2^-40.
    np.testing.assert_allclose(found.set_points, scaling.scale_motors(made.set_points), atol=1e-12)
    np.testing.assert_allclose(found.motor_positions, 2.0 * found.set_points, atol=3e-12)
    np.testing.assert_allclose(found.outputs, scaling.scale_outputs(made.outputs), atol=1e-12)
    assert np.abs(found.set_points - made.set_points).max() > 1.0
    np.testing.assert_array_equal(found.channels["payload"], t)
    assert found.sample_time == pytest.approx(0.4 / scaling.second)
    np.testing.assert_allclose(found.time, made.time / scaling.second)
    without = scale_recording(Recording.from_arrays(1e3 * t[:, None], robot=robot), scaling)
    assert not without.has_motor_positions
    neck = neck_recording(100)
    some = {name: c for name, c in neck.channels.items() if name != "motor_position_2"}
    partly = scale_recording(Recording(neck.time, TS, some), scaling)
    assert set(partly.channels) == {*neck.robot.set_points, *neck.robot.outputs.names}
    assert scale_recording(neck, Scaling.of(neck.robot)) is neck


# -- times ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("Ts", [1e-6, 1e-3, 0.02, 4.0])
def test_a_sample_time_is_the_mean_of_the_regular_steps_inside_the_runs(Ts: float) -> None:
    k = np.arange(60)
    run = np.repeat([0, 1], 30)
    jittered = Ts * (k + 0.3 * (k % 2))
    assert median_step(jittered, np.zeros(0)) == pytest.approx(Ts, rel=0.02)
    # A step of half as much again or half as long is an irregular one; a pause between runs is no step.
    for odd, counted in ((1.51, 0), (0.49, 0), (1.49, 1), (0.51, 1)):
        time = Ts * k
        time[40:] += (odd - 1.0) * Ts
        mean = Ts * (1.0 + counted * (odd - 1.0) / 58.0)
        assert median_step(time, run) == pytest.approx(mean, rel=1e-9)
    paused = Ts * (k + 1000.0 * (k >= 30))
    assert median_step(paused, run) == pytest.approx(Ts, rel=1e-9)
    for rows in (0, 1):
        with pytest.raises(DataError, match=f"at least 2 rows; got {rows}"):
            median_step(Ts * k[:rows], np.zeros(0))
    assert median_step(Ts * k[:2], np.zeros(0)) == pytest.approx(Ts)


def test_times_that_stand_are_allowed_where_they_are_made_even_later() -> None:
    run = np.zeros(4)
    check_rising(np.array([0.0, 1.0, 1.0, 2.0]), run, may_stand=True)
    check_rising(np.array([0.0, 1.0, 0.5, 2.0]), np.array([0, 0, 1, 1]))
    for time, may_stand in (([0.0, 1.0, 1.0, 2.0], False), ([0.0, 1.0, 0.9, 2.0], True)):
        with pytest.raises(DataError, match="at row 2"):
            check_rising(np.array(time), run, may_stand=may_stand)


def test_angles_up_to_half_a_turn_are_taken_and_each_output_is_looked_at() -> None:
    limit = Robot.preset("neck").angle_limit
    for name in ("pitch", "roll"):
        for sign in (-1.0, 1.0):
            at = np.where(np.arange(100) == 4, sign * limit, 0.0)
            neck_recording(100).with_channels(**{name: at})
            with pytest.raises(DataError, match=rf"channel `{name}` is -?3\.14\d+ rad at row 4, more than half a turn"):
                neck_recording(100).with_channels(**{name: np.nextafter(1.0, 2.0) * at})


def test_a_part_is_split_off_where_one_of_its_runs_has_rows_on_both_sides() -> None:
    """Runs that are too short to be cut go to one side whole."""
    runs = concatenate([neck_recording(100), neck_recording(50).rows(0, 1)])
    head, tail = runs.split(0.7)
    assert ([len(part) for part in head.runs()], [len(part) for part in tail.runs()]) == ([70, 1], [30])
    head, tail = runs.split(0.3)
    assert ([len(part) for part in head.runs()], [len(part) for part in tail.runs()]) == ([30], [70, 1])
    with pytest.raises(DataError, match=r"1 rows cannot be split at 0\.3"):
        runs.runs()[1].split(0.3)


# -- channels ---------------------------------------------------------------------------------------------------------

CART = Robot.from_dict({
    "name": "cart", "motors": {"names": ["p", "q"], "unit": "kPa"}, "outputs": {"names": ["x"], "unit": "mm"},
    "directions": {"kind": "matrix", "matrix": [[1.0, -1.0]]},
})  # fmt: skip
COMMON = {
    "cocontraction_reference": "", "compression": "m", "payload": "kg", "payload_estimate": "kg", "push_x": "N",
    "push_y": "N", "base_tilt_pitch": "deg", "base_tilt_roll": "deg", "innovation": "1", "healthy": "1", "enabled": "1",
    "measurement_valid": "1",
}  # fmt: skip


@pytest.mark.parametrize(
    ("robot", "outputs", "motors", "unit", "shown"),
    [(Robot.preset("neck"), ("pitch", "roll"), "123", "rad", "deg"), (CART, ("x",), "12", "kPa", "mm")],
)
def test_a_robot_has_these_channels_in_these_units_held_or_missed(
    robot: Robot, outputs: tuple[str, ...], motors: str, unit: str, shown: str
) -> None:
    ends = ("", "_measured", "_estimate", "_reference", "_lower", "_upper")
    expected = {"time": "s", **COMMON, "cocontraction_reference": unit, **{f"tension_{j}": "N" for j in motors}}
    for names, per in ((robot.set_points, unit), (robot.motor_positions, unit), (robot.motor_velocities, f"{unit}/s")):
        assert len(names) == len(motors)
        expected |= dict.fromkeys(names, per)
    expected |= {f"{name}{end}": shown for name in outputs for end in ends}
    expected |= {f"{name}_rate{end}": f"{shown}/s" for name in outputs for end in ends[:3]}
    assert {name: file_unit(name, robot) for name in known_channels(robot)} == expected
    held = {name for name in expected if name.endswith("_reference")} | set(robot.set_points)
    assert {name for name in expected if is_held(name)} == held | {
        "payload", "healthy", "enabled", "measurement_valid",
    }  # fmt: skip
    missed = {name for name in expected if name.startswith(outputs)} | {f"tension_{j}" for j in motors}
    missed |= {*robot.motor_positions, *robot.motor_velocities, "compression"}
    assert {name for name in expected if may_miss(name, robot)} == missed - held
    for name, own in expected.items():
        factor = {"deg": np.pi / 180.0, "deg/s": np.pi / 180.0, "kPa": 1e3, "kPa/s": 1e3, "mm": 1e-3, "mm/s": 1e-3}
        for title, scale in ((column_name(name, robot), factor.get(own, 1.0)), (f" {name} [ {own}] ", None),
                             (f"{name}[{si_unit(name, robot)}]", 1.0)):  # fmt: skip
            channel, found = parse_column(title, robot)
            assert channel == name
            assert found == pytest.approx(factor.get(own, 1.0) if scale is None else scale, rel=1e-15)
    for j in motors:
        assert parse_column(f"motor_setpoint_{j} [{unit}]", robot)[0] == robot.set_points[int(j) - 1]


@pytest.mark.parametrize(
    ("title", "told"),
    [("x", r"column `x` names no unit; write `x \[mm\]`"), ("y", "names no unit; use `softneck import`"),
     ("x [mm", "names no unit"), ("[mm]", "names no unit"), ("x [m] [m]", "names no unit"),
     ("y [mm]", "column `y` is not a channel of a recording of robot `cart`"),
     ("x [kPa]", "cannot be in `kPa`; expected mm"),
     ("x []", "unit"), ("motor_setpoint_3 [kPa]", "is not a channel")],
)  # fmt: skip
def test_a_title_is_a_known_channel_with_a_unit_of_its_kind(title: str, told: str) -> None:
    with pytest.raises((DataError, SettingsError), match=told):
        parse_column(title, CART)
