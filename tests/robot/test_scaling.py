"""The door between SI and scaled quantities: its maps are inverse, and no unit or pace shows behind it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.robot import Robot
from softneck.robot._scaling import Scaling
from softneck.signals import Recording
from softneck.signals.recording._recording import scale_recording

SIZES = st.floats(1e-6, 1e6)


def robot_of(unit: str, shown: str, low: float, high: float, motors: int = 2) -> Robot:
    return Robot.from_dict({
        "name": "stage", "motors": {"names": [f"m{j}" for j in range(motors)], "unit": unit, "setpoint_min": low,
                                    "setpoint_max": high},
        "outputs": {"names": ["x"], "unit": shown}, "directions": {"kind": "identified"},
    })  # fmt: skip


@given(SIZES, st.floats(-1e3, 1e3), SIZES, SIZES)
@settings(max_examples=100, deadline=None)
def test_the_maps_are_inverse(unit: float, rest: float, output: float, second: float) -> None:
    scaling = Scaling(motor_unit=unit, motor_rest=np.array([rest, 0.0]), output_unit=np.array([output]),
                      output_rest=np.array([rest]), second=second)  # fmt: skip
    U, Y = np.array([[1.0, -2.0], [0.5, 3.0]]), np.array([[0.1], [-0.7]])
    # Rounding at the size of the largest number that takes part.
    atol = 1e-15 * (abs(rest) + 1.0) / min(unit, output)
    np.testing.assert_allclose(scaling.scale_motors(scaling.unscale_motors(U)), U, rtol=1e-12, atol=atol)
    np.testing.assert_allclose(scaling.scale_outputs(scaling.unscale_outputs(Y)), Y, rtol=1e-12, atol=atol)
    assert scaling.scale_seconds(scaling.unscale_seconds(3.0)) == pytest.approx(3.0, rel=1e-14)


def test_the_neck_s_maps_are_the_identity_with_any_limits() -> None:
    for robot in (Robot.preset(), Robot.from_dict({"extends": "neck", "motors": {"setpoint_max": 3.0}})):
        assert Scaling.of(robot, set_points=np.ones((2, 3)), outputs=np.ones((2, 2)), time_constant=7.0).is_identity


@pytest.mark.parametrize(("motor", "shown"), [("kPa", "deg"), ("bar", "rad"), ("psi", "deg")])
def test_scaled_data_are_the_same_to_the_bit_in_every_unit(motor: str, shown: str) -> None:
    rng = np.random.default_rng(1)
    U, Y = rng.uniform(0.0, 2e5, (300, 2)), rng.uniform(-0.5, 0.5, (300, 1))
    per, out = {"kPa": 1e3, "bar": 1e5, "psi": 6894.757293168361, "Pa": 1.0}, {"deg": np.pi / 180.0, "rad": 1.0}

    def scaled(unit: str, display: str, slower: float) -> Recording:
        robot = robot_of(unit, display, 0.0, 2e5 / per[unit])
        # Through the numbers of a file in that unit and back.
        rows = ((U / per[unit]) * per[unit], (Y / out[display]) * out[display])
        recording = Recording.from_arrays(*rows, sample_time=0.01 * slower, robot=robot)
        return scale_recording(recording, Scaling.of(robot, set_points=rows[0], outputs=rows[1],
                                                      time_constant=0.1 * slower))  # fmt: skip

    one, other = scaled("Pa", "rad", 1.0), scaled(motor, shown, 1000.0)
    np.testing.assert_array_equal(one.set_points, other.set_points)
    np.testing.assert_array_equal(one.outputs, other.outputs)
    assert one.sample_time == pytest.approx(other.sample_time, rel=1e-12)
