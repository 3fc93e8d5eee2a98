"""Where the loop's rules begin and end: ranges, windows to the row, metrics to the sample, references by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.loop import (
    Loop,
    LoopResult,
    LoopRun,
    MotorFault,
    NeckFault,
    RecordingReference,
    SensorFault,
    check_limits,
    metrics,
    run_loop,
)
from softneck.loop._disturbed_bus import ActiveFault, FaultStages
from softneck.loop._faults import fault_field, fault_keys, make_fault
from softneck.loop._faults_runtime import faults_act
from softneck.loop._references import make_reference, reference_keys, same_quantity
from softneck.runtime import Port

from ..references import RampReference, RotationReference, SineReference, StepReference
from ._parts import SETPOINTS, FunctionPart, lag_plant, ports

TS = 0.02


# -- settings ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "given", "name", "least", "most"),
    [
        (MotorFault, {"kind": "stuck"}, "motor", 0, 3),
        (MotorFault, {"kind": "stuck"}, "size", -6.0, 6.0),
        (SensorFault, {"kind": "freeze"}, "seed", 0, 2**31 - 1),
    ],
)
def test_borders_belong_to_the_range(kind: Any, given: Mapping[str, Any], name: str, least: Any, most: Any) -> None:
    step = 1 if isinstance(least, int) else 1e-6
    for value in (least, most):
        assert getattr(kind(**given, **{name: value}), name) == value
    for value in (least - step, most + step):
        with pytest.raises(SettingsError, match="must"):
            kind(**given, **{name: value})


def test_a_share_is_above_zero_and_at_most_all() -> None:
    assert SensorFault(kind="freeze", share=1.0).share == 1.0
    assert SensorFault(kind="freeze").share == 0.1
    for share in (0.0, -0.1, 1.0 + 1e-9):
        with pytest.raises(SettingsError, match="share"):
            SensorFault(kind="freeze", share=share)


def test_windows_begin_at_zero_and_last() -> None:
    for made in (SensorFault(kind="freeze"), MotorFault(kind="stuck"), NeckFault(values={"payload": 1.0})):
        assert (made.start, made.duration) == (0.0, math.inf)
    windows: tuple[dict[str, Any], ...] = ({"start": -1e-9}, {"duration": 0.0}, {"duration": -1.0}, {"start": math.inf})
    for window in windows:
        with pytest.raises(SettingsError):
            MotorFault(kind="stuck", **window)
    for kind in ("offset", "slow"):
        with pytest.raises(SettingsError):
            MotorFault(kind=kind)
    for kind in ("bias", "outlier", "noise", "delay"):
        with pytest.raises(SettingsError):
            SensorFault(kind=kind)
    for values in ({}, {"payload": 0.0}, {"payload": math.nan}):
        with pytest.raises(SettingsError):
            NeckFault(values=values)


@pytest.mark.parametrize(
    ("start", "duration", "rows"),
    [
        (0.0, math.inf, range(12)),
        (0.1, 0.06, range(5, 8)),
        # Between rows it acts from the next one on, and ends before the first that is not in it.
        (0.09, 0.06, range(5, 8)),
        (0.101, 0.001, range(0)),
        # 0.06 / 0.02 is 2.9999999999999996.
        (0.06, 0.02, range(3, 4)),
    ],
)
def test_a_window_holds_its_rows_and_no_other(start: float, duration: float, rows: range) -> None:
    acting = ActiveFault(NeckFault(values={"payload": 2.0}, start=start, duration=duration), [1], [], np.ones(1), TS)
    stages = FaultStages([[]] * 4, [], [acting], 12)
    hit = []
    for k in range(12):
        bus = np.array([7.0, 1.0])
        faults_act(k, 1, stages.lists, bus)
        assert bus[0] == 7.0
        hit += [k] if bus[1] == 3.0 else []
    assert hit == list(rows)


@pytest.mark.parametrize(("fault", "second"), [
    (MotorFault(kind="stuck"), 7.0), (MotorFault(kind="slow", rate=5.0), 7.0 + 5.0 * TS),
])  # fmt: skip
def test_what_sticks_from_the_first_row_on_has_that_rows_own_value(fault: MotorFault, second: float) -> None:
    stages = FaultStages([[]] * 4, [], [ActiveFault(fault, [0], [], np.ones(1), TS)], 2)
    for k, (wanted, shown) in enumerate([(7.0, 7.0), (9.0, second)]):
        bus = np.array([wanted])
        faults_act(k, 1, stages.lists, bus)
        assert bus[0] == shown


def test_a_part_that_breaks_off_leaves_the_rows_before_it() -> None:
    def breaks(state: list[float], _: np.ndarray) -> list[float]:
        state.append(0.0)
        if len(state) > 5:
            raise RuntimeError("no more")
        return [0.0, 0.0, 0.0]

    controller = FunctionPart("controller", ports("pitch", "roll"), SETPOINTS, breaks)
    loop = Loop(plant=lag_plant(), controller=controller, reference=StepReference(pitch=0.1), duration=1.0)
    with LoopRun(loop) as run:
        with pytest.raises(RuntimeError, match="no more"):
            run.advance()
        assert run.row == run.result().time.size == 5


# -- keys of files ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("sensor_bias", {"size_deg": 2.0, "axis": "roll", "start_s": 1.5}),
        ("sensor_outlier", {"size_deg": 30.0, "share": 0.5, "seed": 3, "signals": ["pitch_measured"]}),
        ("sensor_delay", {"delay_ms": 100.0, "duration_s": 2.0}),
        ("motor_slow", {"motor": 0, "rate_deg_s": 20.0}),
        ("base_tilt", {"pitch_deg": 5.0, "roll_rad": 0.1}),
        ("push", {"x_n": 3.0, "y_n": -1.0}),
        ("payload_step", {"payload_g": 500.0}),
    ],
)
def test_a_fault_written_in_si_is_the_fault_again(kind: str, values: dict[str, Any]) -> None:
    fault = make_fault(kind, values)
    keys = fault_keys(fault)
    assert keys.pop("kind") == kind
    units = {"start": "_s", "duration": "_s", "delay": "_s", "size": "_rad", "std": "_rad", "rate": "_rad_s",
             "pitch": "_rad", "roll": "_rad", "x": "_n", "y": "_n", "payload": "_kg"}  # fmt: skip
    again = make_fault(kind, {f"{name}{units.get(name, '')}": value for name, value in keys.items()})
    assert again == fault
    # An end that never comes is not written.
    assert ("duration" in keys) == math.isfinite(fault.duration)


def test_units_of_keys_become_si() -> None:
    assert make_fault("sensor_delay", {"delay_ms": 100.0}) == SensorFault(kind="delay", delay=0.1)
    assert make_fault("motor_slow", {"motor": 2, "rate_deg_s": 180.0}) == MotorFault(kind="slow", motor=2, rate=math.pi)
    assert make_fault("payload_step", {"payload_g": 500.0}) == NeckFault(values={"payload": 0.5})
    assert make_fault("push", {"x_n": 2}) == NeckFault(values={"push_x": 2.0})
    for kind, values in (("push", {"x_n": True}), ("motor_stuck", {"motor": 1.5}), ("sensor_bias", {"signals": "a"})):
        with pytest.raises(SettingsError):
            make_fault(kind, values)


def test_fields_behind_keys_are_known() -> None:
    assert fault_field("sensor_bias", "size_deg") == "size"
    assert fault_field("sensor_bias", "start_s") == "start"
    assert fault_field("sensor_bias", "rate_rad_s") is None
    assert fault_field("nothing", "size_deg") is None
    assert same_quantity("pitch_deg", "pitch_rad")
    assert same_quantity("x", "x_mm")
    assert not same_quantity("pitch_deg", "roll_deg")
    assert same_quantity("at_ms", "at_s")


@pytest.mark.parametrize(
    "made",
    [
        StepReference(pitch=0.1, roll=-0.2, cocontraction=0.3, at=0.5),
        RampReference(pitch=0.1, roll=0.2, cocontraction=1.0, at=0.5, rise=2.0),
        SineReference(pitch=0.1, roll=0.3, cocontraction=1.0, frequency=0.7, at=0.1),
        RotationReference(inclination=0.2, cocontraction=1.0, frequency=0.3, at=0.4, rise=1.5),
    ],
)
def test_a_reference_written_to_a_file_is_the_reference_again(made: Any) -> None:
    keys = reference_keys(made)
    assert keys is not None
    kind = str(keys.pop("kind"))
    assert make_reference(kind, {name: float(value) for name, value in keys.items()}) == made
    assert reference_keys(lambda _: (0.0, 0.0, 0.0)) is None


@pytest.mark.parametrize(
    ("kind", "name", "most"),
    [(StepReference, "pitch", 0.8), (RampReference, "roll", 0.8), (SineReference, "cocontraction", 6.0),
     (RotationReference, "inclination", 0.8)],
)  # fmt: skip
def test_references_stay_within_what_the_robot_may_do(kind: Any, name: str, most: float) -> None:
    for value in (-most, most):
        made = kind(**{name: value})
        assert value in (*made.values, made.cocontraction)
        with pytest.raises(SettingsError, match="must be within"):
            kind(**{name: value * (1.0 + 1e-6)})


# -- references -------------------------------------------------------------------------------------------------------


def test_references_by_their_formulas() -> None:
    ramp = RampReference(pitch=0.4, roll=-0.2, cocontraction=1.0, at=1.0, rise=4.0)
    assert ramp(2.0) == pytest.approx((0.1, -0.05, 0.25))
    sine = SineReference(pitch=0.4, roll=-0.2, cocontraction=1.5, frequency=0.25, at=1.0)
    wave = math.sin(2.0 * math.pi * 0.25 * 0.7)
    assert sine(1.7) == pytest.approx((0.4 * wave, -0.2 * wave, 1.5))
    assert sine(0.0) == (0.0, 0.0, 1.5)
    turn = RotationReference(inclination=0.4, cocontraction=1.5, frequency=0.25, at=1.0, rise=2.0)
    # Half a second after its start: a quarter of the inclination, an eighth of a turn.
    assert turn(1.5) == pytest.approx((0.1 * math.sqrt(0.5), 0.1 * math.sqrt(0.5), 1.5))
    assert turn(4.0) == pytest.approx((0.4 * math.cos(1.5 * math.pi), -0.4, 1.5))
    assert turn(0.5) == (0.0, 0.0, 1.5)
    defaults = (
        SineReference().frequency,
        RotationReference().frequency,
        RotationReference().rise,
        RampReference().rise,
    )
    assert defaults == (0.2, 0.2, 3.0, 1.0)
    step = StepReference(pitch=0.1)
    assert (step(-TS)[0], step(0.0)[0]) == (0.0, 0.1)
    held = RecordingReference(np.array([[0.0, 1.0, 1.0, 1.0], [TS, 1.0, 1.0, 2.0]]))
    # 1 * 0.02 less half a nanosecond is row 1 already, as rounding of k * Ts may make it.
    assert [held(t)[2] for t in (0.0, TS - 1e-9, TS - 1e-10, TS)] == [1.0, 1.0, 2.0, 2.0]


# -- metrics ----------------------------------------------------------------------------------------------------------


def _result(pitch: Any, reference: Any, **more: Any) -> LoopResult:
    pitch, zero = np.asarray(pitch, dtype=float), np.zeros(len(pitch))
    signals = {
        "pitch": pitch, "roll": zero, "pitch_reference": np.asarray(reference, dtype=float), "roll_reference": zero,
        **{f"motor_setpoint_{j}": zero for j in (1, 2, 3)}, **more,
    }  # fmt: skip
    return LoopResult(np.arange(pitch.size) * TS, signals, {}, TS)


def test_a_step_response_sample_by_sample() -> None:
    response = [0.0, 0.0, 0.05, 0.1, 0.5, 0.9, 1.2, 0.94, 0.96, 1.0, 1.0, 1.0]
    found = metrics(_result(np.array(response) * 0.5, [0.0] + [0.5] * 11))["pitch"]
    # From the third sample after the step (10 %, reached exactly) to the fifth (90 %).
    assert found["rise_s"] == pytest.approx(2 * TS)
    # 0.94 is outside the 5 %; the next one is seven samples after the step.
    assert found["settling_s"] == pytest.approx(7 * TS)
    assert found["overshoot_pct"] == pytest.approx(20.0)
    # A reference that moves twice has no step; one that moves in the last row leaves nothing to see.
    assert metrics(_result(response, [0.0, 0.5, 0.6] + [0.6] * 9))["pitch"]["rise_s"] is None
    assert metrics(_result(response, [0.0] * 11 + [0.5]))["pitch"]["rise_s"] is None
    # From another level than zero, downwards.
    down = metrics(_result(0.7 - 0.5 * np.array(response), [0.7] + [0.2] * 11))["pitch"]
    assert (down["rise_s"], down["settling_s"]) == pytest.approx((found["rise_s"], found["settling_s"]))
    assert down["overshoot_pct"] == pytest.approx(20.0)


def test_what_is_settled_from_the_start_settles_at_once_and_what_leaves_in_the_end_never() -> None:
    assert metrics(_result(np.full(10, 0.5), np.full(10, 0.5)))["pitch"]["settling_s"] == 0.0
    late = np.full(10, 0.5)
    late[-1] = 0.4
    assert metrics(_result(late, np.full(10, 0.5)))["pitch"]["settling_s"] is None
    # 95 % itself is not within 5 % of the step.
    edge = metrics(_result([0.0, 0.9499, 0.9501, 1.0], [1.0] * 4))["pitch"]
    assert edge["settling_s"] == pytest.approx(2 * TS)


def test_errors_are_weighed_by_the_time_since_the_step() -> None:
    found = metrics(_result([0.0, 0.0, 0.1, 0.3], [0.0, 0.0, 0.3, 0.3]))["pitch"]
    assert found["iae"] == pytest.approx(0.2 * TS)
    assert found["ise"] == pytest.approx(0.04 * TS)
    # The step is in row 2; the only error is there, at no time since.
    assert found["itae"] == 0.0
    late = metrics(_result([0.0, 0.0, 0.3, 0.1, 0.3], [0.0, 0.0, 0.3, 0.3, 0.3]))["pitch"]
    assert late["itae"] == pytest.approx(0.2 * TS * TS)
    assert late["rms_error_deg"] == pytest.approx(math.degrees(0.2 / math.sqrt(5)))
    # The last quarter after the step, rounded towards more: of 8 rows after row 2 the last two.
    tail = np.full(10, 0.3)
    tail[7], tail[8] = 0.0, 0.4
    steady = metrics(_result(tail, [0.0, 0.0] + [0.3] * 8))["pitch"]["steady_rms_deg"]
    assert steady == pytest.approx(math.degrees(0.1 / math.sqrt(2)))


def test_missing_samples_hold_the_one_before_in_a_step_response() -> None:
    response = np.array([np.nan, 0.0, 0.5, np.nan, 1.0, 1.0])
    full = np.array([0.0, 0.0, 0.5, 0.5, 1.0, 1.0])
    one, two = (metrics(_result(0.5 * y, np.full(6, 0.5)))["pitch"] for y in (response, full))
    assert [one[name] for name in ("rise_s", "settling_s", "overshoot_pct")] == [
        two[name] for name in ("rise_s", "settling_s", "overshoot_pct")
    ]
    nothing = metrics(_result(np.full(6, np.nan), np.full(6, 0.5)))["pitch"]
    # An error that was never measured is none that is zero.
    assert all(value is None for value in nothing.values())


def test_a_limit_holds_up_to_itself() -> None:
    rows = check_limits({"a": {"rise_s": 1.0}}, {"a.rise_s": 1.0})
    assert rows[0]["holds"] is True
    assert check_limits({"a": {"rise_s": 1.0 + 1e-12}}, {"a.rise_s": 1.0})[0]["holds"] is False
    for wrong in (True, math.nan):
        with pytest.raises(SettingsError):
            check_limits({"a": {"rise_s": 1.0}}, {"a.rise_s": wrong})


def test_slack_and_motor_limits_at_their_borders() -> None:
    motor, tension = np.array([0.0, 6.0, 6.0 + 1e-6, -7.0]), np.array([1e-3, 1.01e-3, 0.0, 5.0])
    found = metrics(_result(np.zeros(4), np.zeros(4), motor_setpoint_2=motor, tension_3=tension))["motors"]
    assert found["limit_violation_s"] == pytest.approx(2 * TS)
    assert found["slack_s"] == pytest.approx(2 * TS)
    assert found["max_rad"] == 7.0
    assert found["max_rate_rad_s"] == pytest.approx((13.0 + 1e-6) / TS)


def test_what_nobody_feeds_holds_its_usual_value_and_what_comes_after_a_constant_is_converted() -> None:
    """`healthy` and `enabled` are 1 where nobody says otherwise; a constant among the inputs ends nothing."""
    seen: list[list[float]] = []

    def controlled(_state: list[float], u: Any) -> list[float]:
        seen.append([float(value) for value in u])
        return [0.0, 0.0, 0.0]

    inputs = (
        Port(name="healthy"), Port(name="measurement_valid"), Port(name="enabled"),
        Port(name="pitch_reference", unit="deg"), *ports("roll_reference", "pitch", "roll"),
    )  # fmt: skip
    controller = FunctionPart("controller", inputs, SETPOINTS, controlled)
    run_loop(Loop(plant=lag_plant(), controller=controller, reference=StepReference(pitch=0.1), duration=0.1))
    np.testing.assert_allclose(seen[0], [1.0, 1.0, 1.0, math.degrees(0.1), 0.0, 0.0, 0.0], rtol=1e-12)
