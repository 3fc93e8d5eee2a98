"""The neck as a plant: the public ports, signs, recordings, batches; compiled and plain Python agree."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import load_runtime
from softneck.signals import Excitation, signal

NECK = VirtualNeck(NeckParameters.paper())


def test_the_ports_are_those_of_the_public_face() -> None:
    block = NECK.block()
    assert [port.name for port in block.inputs] == [
        "motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3", "payload", "push_x", "push_y",
        "base_tilt_pitch", "base_tilt_roll",
    ]  # fmt: skip
    assert [port.name for port in block.outputs] == [
        "pitch", "roll", "pitch_measured", "roll_measured", "pitch_rate_measured", "roll_rate_measured",
        "measurement_valid", "motor_position_1", "motor_position_2", "motor_position_3",
        "tension_1", "tension_2", "tension_3", "compression",
    ]  # fmt: skip
    assert [port.name for port in block.parameters] == [*NeckParameters.names(), "noise_seed"]
    assert [port.name for port in block.outputs if port.boolean] == ["measurement_valid"]


@pytest.mark.parametrize(
    ("column", "value", "axis"),
    [(0, 2.0, 0), (1, 2.0, 1), (2, -2.0, 1), (4, 5.0, 0), (5, 5.0, 1), (6, 0.1, 0), (7, 0.1, 1)],
    ids=["motor 1", "motor 2", "motor 3", "push x", "push y", "base pitch", "base roll"],
)
def test_pitch_and_roll_rise_with_what_should_raise_them(column: int, value: float, axis: int) -> None:
    block = NECK.block()
    U = np.zeros((150, 8))
    U[:, column] = value
    rest = block.initial_state()
    _, Y = block.run(rest, U)
    assert Y[-1, axis] > rest.outputs[axis] + 0.015
    assert Y[-1, 2 + axis] > rest.outputs[2 + axis] + 0.015


def test_cocontraction_compresses_and_pulls_but_does_not_lean() -> None:
    block = VirtualNeck(NeckParameters.paper().replace(rest_pitch=0.0, rest_roll=0.0)).block()
    U = np.zeros((150, 8))
    U[:, :3] = 1.0
    rest = block.initial_state()
    _, Y = block.run(rest, U)
    assert Y[-1, 13] > rest.outputs[13] + 1e-3
    assert (Y[-1, 10:13] > rest.outputs[10:13]).all()
    assert np.abs(Y[-1, :2]).max() < 1e-9


def test_compiled_and_plain_python_agree() -> None:
    block = VirtualNeck(NeckParameters.lab().replace(dropout_rate=2.0)).block(noise_seed=3)
    start = block.initial_state()
    U = np.zeros((40, 8))
    U[:, :3] = np.random.default_rng(0).uniform(-2, 2, (40, 3))
    _, compiled = block.run(start, U)
    runtime = load_runtime(block.runtime, compiled=False)
    x, plain = start.values.copy(), np.zeros((40, 14))
    for u, y in zip(U, plain, strict=True):
        runtime.step(block.arrays, start.parameters, x, u, y)
    # Two libraries' sin and exp differ in the last bit; the quantised columns then by one step.
    np.testing.assert_allclose(plain[:, [0, 1, 10, 11, 12, 13]], compiled[:, [0, 1, 10, 11, 12, 13]], atol=1e-9)
    np.testing.assert_allclose(plain, compiled, atol=2e-4)


def test_a_set_point_beyond_the_limit_is_clamped_as_a_drive_would() -> None:
    block = NECK.block()
    U = np.zeros((100, 8))
    U[:, 0] = 6.0
    beyond = U.copy()
    beyond[:, 0] = 60.0
    far, further = (block.run(block.initial_state(), u)[1] for u in (U, beyond))
    np.testing.assert_array_equal(far, further)


def test_a_recording_starts_settled_and_repeats_to_the_bit() -> None:
    held = Excitation("held", np.arange(100) * 0.02, np.tile([1.0, -0.5, 0.3], (100, 1)))
    still = record(held, NECK, noise=False)
    # 4 s to settle leave the hysteresis creeping by less than a hundredth of a degree in 2 s.
    assert np.ptp(np.degrees(still.outputs), axis=0).max() < 0.01
    one, two = (record(signal("eq22", duration=4.0), NECK, seed=9) for _ in range(2))
    for name, values in one.channels.items():
        np.testing.assert_array_equal(values, two.channels[name])
    np.testing.assert_array_equal(one.set_points, signal("eq22", duration=4.0).set_points)


def test_noise_is_what_a_noisy_recording_adds() -> None:
    clean, noisy = (record(signal("sine"), NECK, seed=4, noise=noise) for noise in (False, True))
    error = noisy.outputs - clean.outputs
    # 3,000 independent samples: 3 standard errors are 4 %.
    assert error.std() == pytest.approx(np.radians(0.05), rel=0.04)
    np.testing.assert_array_equal(noisy.motor_positions, clean.motor_positions)


def test_lost_samples_are_missing_in_a_recording() -> None:
    neck = VirtualNeck(NeckParameters.paper().replace(dropout_rate=2.0))
    recording = record(signal("steps"), neck, seed=1)
    lost = np.isnan(recording.outputs).any(axis=1)
    assert 0 < lost.sum() < 0.6 * len(recording)
    assert np.isfinite(recording.motor_positions).all()


@pytest.mark.parametrize(
    ("sample_time", "steps"), [(0.001, 1), (0.003, 3), (0.02, 20), (0.1, 100), (0.0015, 2), (0.0208954, 21)]
)
def test_internal_steps_fit_any_sample_time_and_stay_within_a_millisecond(sample_time: float, steps: int) -> None:
    # Column 1 of the setup is the number of steps; of times that 1 ms divides it is their quotient.
    assert NECK.block(sample_time=sample_time).arrays[0][0][1] == steps


def test_a_sample_time_estimated_from_a_log_simulates_as_finely_as_any_other() -> None:
    U = np.zeros((50, 8))
    U[:, 0] = 1.5
    blocks = [NECK.block(sample_time=0.0208954, internal_step=step) for step in (0.001, 0.0001)]
    Y, fine = (block.run(block.initial_state(), U)[1][:, :2] for block in blocks)
    # rad: set-points arrive at a whole internal step, up to 1 ms late, while the neck moves at 1 rad/s.
    np.testing.assert_allclose(Y, fine, atol=1e-3)
    assert np.abs(fine).max() > 0.1
