"""Each fault does what it says inside its window, and nothing outside it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.loop import Fault, Loop, LoopResult, MotorFault, NeckFault, SensorFault, run_loop
from softneck.loop._disturbed_bus import ActiveFault, _normal_rows, sensor_outputs
from softneck.loop._faults import FAULT_KINDS, make_fault
from softneck.robot import Robot
from softneck.runtime import Port

from ..references import SineReference
from ._parts import SETPOINTS, FunctionPart, lag_plant, p_controller, ports, relay_observer

TS = 0.02
WISH = SineReference(pitch=0.3, roll=-0.2, frequency=0.5)
DISTURBED = (Port(name="payload", unit="kg"), Port(name="push_x", unit="N"), Port(name="base_tilt_pitch", unit="rad"))


def bridging_observer() -> FunctionPart:
    """Pass the angles on, and hold the last ones where none came."""

    def advance(state: list[float], u: np.ndarray) -> list[float]:
        if not state:
            state.extend([0.0, 0.0])
        state[:] = [state[i] if math.isnan(u[3 + i]) else float(u[3 + i]) for i in (0, 1)]
        return [*state, 1.0]

    relay = relay_observer()
    return FunctionPart("observer", relay.inputs, relay.outputs, advance)


def run(
    *faults: Fault, order: str = "sequential", duration: float = 4.0, plant: FunctionPart | None = None
) -> LoopResult:
    loop = Loop(
        plant=plant or lag_plant(extra=DISTURBED), controller=p_controller(gain=4.0), observer=bridging_observer(),
        reference=WISH, duration=duration, faults=faults, order=order,
    )  # fmt: skip
    return run_loop(loop)


EVERY: dict[str, dict[str, object]] = {
    "sensor_dropout": {},
    "sensor_freeze": {},
    "sensor_bias": {"size_deg": 2.0},
    "sensor_outlier": {"size_deg": 30.0, "share": 0.5, "seed": 3},
    "sensor_delay": {"delay_s": 0.1},
    "measurement_noise": {"std_deg": 0.5, "seed": 4},
    "motor_stuck": {"motor": 1},
    "motor_slow": {"motor": 0, "rate_rad_s": 0.2},
    "motor_offset": {"motor": 2, "size_rad": 0.5},
    "payload_step": {"payload_kg": 0.5},
    "push": {"x_n": 3.0},
    "base_tilt": {"pitch_deg": 5.0},
}


def test_every_kind_of_fault_is_tested() -> None:
    assert set(EVERY) == set(FAULT_KINDS)


@pytest.mark.parametrize("order", ["sequential", "jacobi"])
@pytest.mark.parametrize("kind", list(EVERY))
def test_a_fault_changes_nothing_before_its_window_or_when_that_never_comes(kind: str, order: str) -> None:
    clean = run(order=order)
    late = run(make_fault(kind, {**EVERY[kind], "start_s": 2.0, "duration_s": 0.5}), order=order)
    never = run(make_fault(kind, {**EVERY[kind], "start_s": 99.0}), order=order)
    for name, values in clean.signals.items():
        np.testing.assert_array_equal(never[name], values, err_msg=name)
        np.testing.assert_array_equal(late[name][:100], values[:100], err_msg=name)
    if kind not in ("payload_step", "push", "base_tilt"):  # the toy plant takes those but does not feel them
        assert not np.array_equal(late["pitch"], clean["pitch"]) or not np.array_equal(late["roll"], clean["roll"])


def window(result: LoopResult, start: float, end: float) -> slice:
    return slice(round(start / TS), round(end / TS))


def test_a_dropout_is_no_value_and_an_invalid_one() -> None:
    outputs = (
        *ports("pitch", "roll"),
        Port(name="measurement_valid", boolean=True, start=1.0),
        *lag_plant().outputs[2:],
    )
    valid = FunctionPart("plant", SETPOINTS, outputs, lambda _, u: [0.1, 0.2, 1.0, *map(float, u[:3])])
    result = run(SensorFault(kind="dropout", axis="pitch", start=1.0, duration=0.5), plant=valid)
    off = np.isnan(result["pitch_measured"])
    np.testing.assert_array_equal(np.flatnonzero(off), np.arange(50, 75))
    np.testing.assert_array_equal(result["measurement_valid"], np.where(off, 0.0, result["plant_measurement_valid"]))
    assert np.isfinite(result["pitch"]).all()
    assert "roll_measured" not in result.signals


def test_a_dropout_without_an_observer_is_said_so() -> None:
    loop = Loop(
        plant=lag_plant(), controller=p_controller(), reference=WISH, duration=1.0,
        faults=(SensorFault(kind="dropout", start=0.5),),
    )  # fmt: skip
    with pytest.raises(DataError, match=r"input `pitch` of the controller is nan at t = 0\.5 s .*put an observer"):
        run_loop(loop)


def test_a_frozen_sensor_keeps_its_last_value() -> None:
    result = run(SensorFault(kind="freeze", start=1.0, duration=0.5))
    w = window(result, 1.0, 1.5)
    assert set(result["pitch_measured"][w]) == {result["pitch"][49]}
    np.testing.assert_array_equal(result["pitch_measured"][75:], result["pitch"][75:])


def test_bias_delay_and_outliers_are_sums_and_shifts() -> None:
    biased = run(SensorFault(kind="bias", axis="roll", size=0.05, start=1.0, duration=0.5))
    np.testing.assert_array_equal(biased["roll_measured"][50:75], biased["roll"][50:75] + 0.05)
    delayed = run(SensorFault(kind="delay", delay=0.06, start=1.0, duration=0.5))
    np.testing.assert_array_equal(delayed["pitch_measured"][50:75], delayed["pitch"][47:72])
    outliers = run(SensorFault(kind="outlier", size=0.4, share=0.25, seed=1), duration=40.0)
    jumps = outliers["pitch_measured"] - outliers["pitch"]
    # 2000 draws: the share of a binomial variable has a standard deviation of 1 %.
    assert np.mean(np.abs(jumps) > 0.1) == pytest.approx(0.25, abs=0.04)
    assert np.abs(np.abs(jumps[np.abs(jumps) > 0.1]) - 0.4).max() < 1e-12


def test_noise_has_its_spread_and_its_seed() -> None:
    noise = [run(SensorFault(kind="noise", std=0.01, seed=seed), duration=40.0) for seed in (1, 1, 2)]
    first, again, other = (item["pitch_measured"] - item["pitch"] for item in noise)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    # 2000 samples: the standard deviation is known to 1.6 %.
    assert first.std() == pytest.approx(0.01, rel=0.08)
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.1


def test_motors_stick_crawl_and_slip() -> None:
    stuck = run(MotorFault(kind="stuck", motor=1, start=1.0, duration=0.5))
    assert set(stuck["motor_setpoint_applied_1"][50:75]) == {stuck["motor_setpoint_1"][49]}
    np.testing.assert_array_equal(stuck["motor_setpoint_applied_1"][75:], stuck["motor_setpoint_1"][75:])
    slow = run(MotorFault(kind="slow", motor=0, rate=0.3, start=1.0))
    moves = np.abs(np.diff(slow["motor_setpoint_applied_2"]))[49:]
    assert moves.max() <= 0.3 * TS * (1.0 + 1e-9)
    offset = run(MotorFault(kind="offset", motor=2, size=0.5, start=1.0))
    np.testing.assert_array_equal(offset["motor_position_2"][51:], offset["motor_setpoint_2"][50:-1] + 0.5)


def test_disturbances_reach_the_inputs_of_the_neck_and_add_up() -> None:
    plant = lag_plant(extra=DISTURBED)
    loop = Loop(
        plant=plant, controller=p_controller(), reference=WISH, duration=1.0, plant_inputs={"payload": 0.25},
        faults=(
            make_fault("payload_step", {"payload_kg": 0.5, "start_s": 0.2}),
            make_fault("payload_step", {"payload_kg": 1.0, "start_s": 0.4, "duration_s": 0.2}),
            make_fault("push", {"x_n": 3.0, "start_s": 0.5, "duration_s": 0.02}),
            make_fault("base_tilt", {"pitch_deg": 10.0, "start_s": 0.9}),
        ),
    )  # fmt: skip
    run_loop(loop)
    seen = np.array([inputs[3:] for _, inputs in plant.calls])
    k = np.arange(50)
    np.testing.assert_array_equal(seen[:, 0], 0.25 + 0.5 * (k >= 10) + 1.0 * ((k >= 20) & (k < 30)))
    np.testing.assert_array_equal(seen[:, 1], 3.0 * (k == 25))
    np.testing.assert_array_equal(seen[:, 2], np.radians(10.0) * (k >= 45))


def test_sizes_are_si_whatever_the_plant_measures_in() -> None:
    plain = lag_plant()
    in_degrees = FunctionPart(
        "plant",
        SETPOINTS,
        tuple(Port(name=p.name, unit="deg") if p.name in ("pitch", "roll") else p for p in plain.outputs),
        lambda _, u: [10.0, 20.0, *map(float, u[:3])],
    )
    result = run(SensorFault(kind="bias", size=math.radians(2.0)), plant=in_degrees)
    np.testing.assert_allclose(result["pitch_measured"], result["pitch"] + math.radians(2.0), rtol=1e-14)


def test_faults_on_one_signal_act_in_their_order() -> None:
    first = run(SensorFault(kind="bias", size=0.1), SensorFault(kind="freeze", start=1.0))
    second = run(SensorFault(kind="freeze", start=1.0), SensorFault(kind="bias", size=0.1, start=1.0))
    assert set(first["pitch_measured"][50:]) == {first["pitch_measured"][49]}
    assert second["pitch_measured"][60] == pytest.approx(second["pitch_measured"][49] + 0.1, abs=1e-15)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("flood", {}, "unknown kind of fault `flood`; use one of sensor_dropout"),
        ("sensor_bias", {"size_kg": 1.0, "axis": "yaw"}, "sensor_bias: `axis` must be one of pitch, roll, both"),
        ("sensor_bias", {}, "sensor_bias: `size` of a sensor bias must not be zero"),
        ("sensor_bias", {"size_deg": "2"}, "`size_deg` must be a number; got '2'"),
        ("sensor_freeze", {"size_deg": 2.0}, "unknown key `size_deg` of a sensor_freeze; it takes start_s"),
        ("sensor_delay", {}, "`delay` must be positive"),
        ("measurement_noise", {"std_deg": -1.0}, "`std` must be positive"),
        ("sensor_outlier", {"size_deg": 1.0, "share": 1.5}, "`share` must be above 0 and at most 1"),
        ("motor_stuck", {"motor": 4}, "`motor` must be a whole number between 0 and 3"),
        ("motor_slow", {"motor": 1}, "`rate` must be positive"),
        ("payload_step", {}, "needs a value other than zero"),
        ("push", {"z_n": 1.0}, "unknown key `z_n` of a push; it takes start_s, duration_s, x, y"),
        ("sensor_freeze", {"start_s": -1.0}, "`start` must not be negative"),
        ("sensor_freeze", {"duration_s": 0.0}, "`duration` must be positive"),
        ("sensor_bias", {"size_deg": 1.0, "signals": "pitch"}, "`signals` must be a list of names"),
    ],
)
def test_wrong_settings_are_one_clear_line(kind: str, values: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message) as caught:
        make_fault(kind, values)
    assert "\n" not in str(caught.value)


def no_such_input() -> Fault:
    return NeckFault(values={"push_y": 1.0})


def no_such_output() -> Fault:
    return SensorFault(kind="freeze", signals=("yaw",))


def uneven_delay() -> Fault:
    return SensorFault(kind="delay", delay=0.03)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (
            no_such_input,
            "disturbance of push_y needs the plant's input `push_y`; the plant has motor_setpoint_1",
        ),
        (no_such_output, "sensor freeze acts on `yaw`, which is not an output of the plant"),
        (uneven_delay, r"sensor delay of 0\.03 s is not a multiple of the loop's step 0\.02 s"),
    ],
    ids=lambda item: item.__name__ if callable(item) else "",
)
def test_what_the_plant_lacks_is_named(fault: Callable[[], Fault], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        run(fault())


def test_faults_are_of_the_robot_s_outputs_and_units() -> None:
    robot = Robot.from_dict({
        "name": "finger", "motors": {"names": ["pressure"], "unit": "kPa", "setpoint_min": 0, "setpoint_max": 150},
        "outputs": {"names": ["flexion"], "unit": "deg"}, "directions": {"kind": "identified"},
    })  # fmt: skip
    slow = make_fault("motor_slow", {"rate_kPa_s": 20.0}, robot)
    assert isinstance(slow, MotorFault)
    assert slow.rate == pytest.approx(2e4)
    plant = FunctionPart(
        "plant", ports("pressure_setpoint"), ports("flexion", "flexion_measured"), lambda _, u: [float(u[0])] * 2
    )
    for axis in ("flexion", "both"):
        assert sensor_outputs(SensorFault(kind="dropout", axis=axis), plant, robot) == ("flexion_measured",)
    with pytest.raises(SettingsError, match="`axis` must be one of flexion, both"):
        sensor_outputs(SensorFault(kind="dropout", axis="pitch"), plant, robot)
    with pytest.raises(SettingsError, match="`size` must be between"):
        make_fault("motor_offset", {"size_kPa": 200.0}, robot)


def test_noise_of_a_row_follows_from_seed_and_row_however_the_rows_are_run() -> None:
    whole = _normal_rows(3, 0, 10, 2)
    np.testing.assert_array_equal(whole, np.vstack([_normal_rows(3, 0, 4, 2), _normal_rows(3, 4, 10, 2)]))
    np.testing.assert_array_equal(whole[7], np.random.default_rng([3, 7]).standard_normal(2))
    assert len({*whole.ravel().tolist(), *_normal_rows(4, 0, 10, 2).ravel().tolist()}) == 40
    # The candidates of a search share their noise: it is drawn once, and no loop changes it.
    assert _normal_rows(3, 0, 10, 2) is whole
    fault = SensorFault(kind="noise", std=2.0, seed=3)
    acting = ActiveFault(fault, [0, 1], [], np.array([1.0, 0.5]), 0.02)
    np.testing.assert_array_equal(acting.amounts(0, 10), whole * [2.0, 1.0])
    assert _normal_rows(3, 0, 10, 2) is whole
