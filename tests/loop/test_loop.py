"""The order of a cycle, wiring by name, and what stops a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, Vector
from softneck.loop import Loop, run_loop
from softneck.runtime import Port

from ..references import StepReference
from ._parts import POSITIONS, SETPOINTS, FunctionPart, lag_plant, p_controller, ports, relay_observer

STEP = StepReference(pitch=0.2, roll=-0.1, at=0.1)
A, B, GAIN = 0.9, 0.05, 1.0


def expected_pitch(delay: int) -> np.ndarray:
    """The same loop as one scalar recursion, with `delay` samples between what is computed and the motors.

    Both the reference and the angle of the controller are then that much older; an observer in Jacobi order
    delays the angle by one sample more.
    """
    y, u = np.zeros(101), np.zeros(100 + delay)
    for k in range(100):
        u[k + delay] = GAIN * ((0.2 if k >= 5 else 0.0) - y[k])
        y[k + 1] = A * y[k] + B * u[k]
    return y[:100]


def test_sequential_order_uses_the_measurement_of_the_same_sample() -> None:
    result = run_loop(Loop(plant=lag_plant(a=A, b=B), controller=p_controller(gain=GAIN), reference=STEP, duration=2.0))
    # The same operations in the same order: not even rounding differs.
    np.testing.assert_array_equal(result["pitch"], expected_pitch(0))
    assert result.time[0] == 0.0
    assert result.time.size == 100


def test_an_observer_that_passes_on_changes_nothing_in_sequential_order() -> None:
    plain = run_loop(Loop(plant=lag_plant(), controller=p_controller(), reference=STEP, duration=2.0))
    observed = run_loop(
        Loop(plant=lag_plant(), controller=p_controller(), observer=relay_observer(), reference=STEP, duration=2.0)
    )
    for name in ("pitch", "roll", "motor_setpoint_1", "motor_setpoint_2"):
        np.testing.assert_array_equal(observed[name], plain[name])
    np.testing.assert_array_equal(observed["pitch_estimate"], observed["pitch"])


def test_jacobi_order_adds_a_sample_for_the_controller_and_one_for_the_observer() -> None:
    plain = run_loop(
        Loop(plant=lag_plant(a=A, b=B), controller=p_controller(), reference=STEP, duration=2.0, order="jacobi")
    )
    np.testing.assert_array_equal(plain["pitch"], expected_pitch(1))
    observed = run_loop(
        Loop(
            plant=lag_plant(a=A, b=B),
            controller=p_controller(),
            observer=relay_observer(),
            reference=STEP,
            duration=2.0,
            order="jacobi",
        )
    )
    y, u = np.zeros(101), np.zeros(101)
    for k in range(100):
        u[k + 1] = GAIN * ((0.2 if k >= 5 else 0.0) - (y[k - 1] if k else 0.0))
        y[k + 1] = A * y[k] + B * u[k]
    np.testing.assert_array_equal(observed["pitch"], y[:100])


def test_the_observer_sees_the_setpoints_held_until_now() -> None:
    observer = relay_observer()
    result = run_loop(
        Loop(plant=lag_plant(), controller=p_controller(), observer=observer, reference=STEP, duration=1.0)
    )
    seen = np.array([inputs[0] for _, inputs in observer.calls])
    assert seen[0] == 0.0
    np.testing.assert_array_equal(seen[1:], result["motor_setpoint_1"][:-1])


def test_a_slower_controller_holds_its_setpoints() -> None:
    controller = p_controller(sample_time=0.06)
    result = run_loop(Loop(plant=lag_plant(), controller=controller, reference=STEP, duration=1.2))
    assert [time for time, _ in controller.calls] == pytest.approx([0.06 * i for i in range(20)], abs=1e-12)
    u = result["motor_setpoint_1"].reshape(-1, 3)
    np.testing.assert_array_equal(u, np.repeat(u[:, :1], 3, axis=1))


def test_a_slower_plant_shows_its_outputs_only_when_they_are_valid() -> None:
    result = run_loop(
        Loop(plant=lag_plant(sample_time=0.04), controller=p_controller(sample_time=0.02), reference=STEP, duration=1.0)
    )
    y = result["pitch"].reshape(-1, 2)
    np.testing.assert_array_equal(y[:, 0], y[:, 1])
    changed = np.flatnonzero(result["pitch"])[0]
    # The step at 0.1 s (row 5) is used by the plant's step at row 6, whose outputs are valid two rows later.
    assert changed == 8


@pytest.mark.parametrize("order", ["sequential", "jacobi"])
def test_a_second_run_of_the_same_loop_is_bit_equal(order: str) -> None:
    loop = Loop(
        plant=lag_plant(),
        controller=p_controller(),
        observer=relay_observer(),
        reference=STEP,
        duration=1.0,
        order=order,
    )
    first, second = run_loop(loop), run_loop(loop)
    for name, values in first.signals.items():
        np.testing.assert_array_equal(second[name], values)


def test_units_are_converted() -> None:
    controller = p_controller()
    degrees = tuple(Port(name=p.name, unit="deg") for p in controller.inputs)
    in_degrees = FunctionPart(
        "controller", degrees, SETPOINTS, lambda _, u: [math.radians(u[0] - u[2]), math.radians(u[1] - u[3]), 0.0]
    )
    plain = run_loop(Loop(plant=lag_plant(), controller=controller, reference=STEP, duration=1.0))
    converted = run_loop(Loop(plant=lag_plant(), controller=in_degrees, reference=STEP, duration=1.0))
    # Two roundings of the conversion per sample, kept small by a stable loop.
    np.testing.assert_allclose(converted["pitch"], plain["pitch"], rtol=1e-13)


def test_plant_constants_reach_the_plant_by_name() -> None:
    plant = lag_plant(extra=(Port(name="payload", unit="kg"), Port(name="push_x", unit="N", start=0.25)))
    run_loop(Loop(plant=plant, controller=p_controller(), reference=STEP, duration=0.1, plant_inputs={"payload": 0.5}))
    np.testing.assert_array_equal(plant.calls[0][1][3:], [0.5, 0.25])


def test_a_part_with_the_parameter_takes_motor_positions_unless_told_otherwise() -> None:
    controller = p_controller()
    loop = Loop(plant=lag_plant(), controller=controller, reference=STEP, duration=1.0)
    assert not loop.parameters["controller"]
    controller.parameters = (Port(name="use_motor_positions", boolean=True),)  # type: ignore[attr-defined]
    assert loop.parameters["controller"] == {"use_motor_positions": 1.0}
    told = replace(loop, controller_parameters={"use_motor_positions": 0.0, "lead_limit": 1.0})
    assert told.parameters["controller"] == {"use_motor_positions": 0.0, "lead_limit": 1.0}
    further = replace(loop, controller=p_controller(), others={"filter": controller})
    assert further.parameters["filter"] == {"use_motor_positions": 1.0}


def test_progress_ends_at_one_and_parts_are_closed() -> None:
    seen: list[float] = []
    plant = lag_plant()
    run_loop(Loop(plant=plant, controller=p_controller(), reference=STEP, duration=4.0), report=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert plant.closed == 1


def failing_plant() -> FunctionPart:
    def advance(state: list[float], u: np.ndarray) -> list[float]:
        state.append(0.0)
        return [math.nan if len(state) > 5 else 0.0, 0.0, 0.0, 0.0, 0.0]

    return FunctionPart("plant", SETPOINTS, ports("pitch", "roll") + POSITIONS, advance)


def test_nan_stops_the_run_and_names_part_variable_and_time() -> None:
    plant = failing_plant()
    with pytest.raises(DataError, match=r"output `pitch` of the plant became nan in the step at t = 0\.1 s"):
        run_loop(Loop(plant=plant, controller=p_controller(), reference=STEP, duration=1.0))
    assert plant.closed == 1


def test_a_missing_measurement_needs_an_observer() -> None:
    def advance(state: list[float], u: np.ndarray) -> list[float]:
        return [math.nan, 0.0, 0.0, 0.0, 0.0]

    outputs = ports("pitch_measured", "roll_measured", missing=True) + POSITIONS
    plant = FunctionPart("plant", SETPOINTS, outputs, advance)
    with pytest.raises(DataError, match=r"input `pitch` of the controller is nan .*put an observer between"):
        run_loop(Loop(plant=plant, controller=p_controller(), reference=STEP, duration=1.0))


def test_sample_times_that_do_not_divide_are_refused() -> None:
    loop = Loop(plant=lag_plant(), controller=p_controller(sample_time=0.03), reference=STEP, duration=1.0)
    with pytest.raises(SettingsError, match=r"do not divide: plant 0\.02 s, controller 0\.03 s"):
        run_loop(loop)


def test_an_input_that_nothing_feeds_is_named() -> None:
    controller = FunctionPart("controller", ports("tension_1"), SETPOINTS, lambda *_: [0.0, 0.0, 0.0])
    with pytest.raises(SettingsError, match="nothing feeds input `tension_1` of the controller"):
        run_loop(Loop(plant=lag_plant(), controller=controller, reference=STEP, duration=1.0))


def test_a_controller_without_a_motor_is_named() -> None:
    controller = FunctionPart("controller", ports("pitch"), SETPOINTS[:2], lambda *_: [0.0, 0.0])
    with pytest.raises(SettingsError, match="nothing feeds input `motor_setpoint_3` of the plant"):
        run_loop(Loop(plant=lag_plant(), controller=controller, reference=STEP, duration=1.0))


def test_an_observer_without_the_angle_is_not_bypassed() -> None:
    observer = FunctionPart("observer", ports("roll_measured"), ports("roll"), lambda *_: [0.0])
    loop = Loop(plant=lag_plant(), controller=p_controller(), observer=observer, reference=STEP, duration=1.0)
    with pytest.raises(
        SettingsError, match=r"nothing feeds input `pitch` of the controller; .*`pitch` of the observer"
    ):
        run_loop(loop)


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"payloda": 1.0}, "`payloda` is not an input of the plant"),
        ({"motor_setpoint_1": 1.0}, "two writers"),
    ],
    ids=["unknown", "two_writers"],
)
def test_wrong_plant_constants_are_refused(constants: dict[str, float], message: str) -> None:
    loop = Loop(plant=lag_plant(), controller=p_controller(), reference=STEP, duration=1.0, plant_inputs=constants)
    with pytest.raises(SettingsError, match=message):
        run_loop(loop)


def test_units_that_do_not_fit_are_refused() -> None:
    inputs = tuple(Port(name=p.name, unit="N") for p in p_controller().inputs)
    controller = FunctionPart("controller", inputs, SETPOINTS, lambda *_: [0.0, 0.0, 0.0])
    with pytest.raises(SettingsError, match=r"`pitch_reference` of the reference is in \[rad\] but .* in \[N\]"):
        run_loop(Loop(plant=lag_plant(), controller=controller, reference=STEP, duration=1.0))


def test_unknown_signal_is_named() -> None:
    result = run_loop(Loop(plant=lag_plant(), controller=p_controller(), reference=STEP, duration=0.1))
    with pytest.raises(DataError, match="no signal `yaw`"):
        result["yaw"]
    assert result.units["pitch"] == "rad"


@pytest.mark.parametrize(
    ("setting", "message"), [({"order": "random"}, "`order` must be one of"), ({"duration": 0.0}, "`duration`")]
)
def test_wrong_loop_settings_are_refused(setting: dict[str, object], message: str) -> None:
    fields = {"plant": lag_plant(), "controller": p_controller(), "reference": STEP, "duration": 1.0, **setting}
    with pytest.raises(SettingsError, match=message):
        Loop(**fields)


@dataclass(frozen=True)
class Counted:
    """A ramp that counts the samples that it gave; equal ones have one size."""

    size: float
    repeats: bool
    calls: list[float] = field(default_factory=list, compare=False)

    def __call__(self, time: float, /) -> tuple[float, ...]:
        self.calls.append(time)
        return self.size * time, -self.size, 0.0


def test_samples_are_kept_of_references_that_repeat_and_of_no_others() -> None:
    def run(reference: Counted, duration: float = 0.4) -> Vector:
        loop = Loop(plant=lag_plant(), controller=p_controller(), reference=reference, duration=duration)
        return run_loop(loop)["pitch_reference"]

    once, again, other, plain = Counted(0.2, True), Counted(0.2, True), Counted(0.3, True), Counted(0.2, False)
    expected = run(plain)
    assert len(plain.calls) == 20
    assert (run(once) == expected).all()
    assert (run(again) == expected).all()
    assert not again.calls
    assert (run(other) == [0.3 * (k * 0.02) for k in range(20)]).all()  # the same product
    assert run(again, 0.6).size == 30  # another length is no part of the kept one
    assert run(plain).size == 20
    assert len(plain.calls) == 40
