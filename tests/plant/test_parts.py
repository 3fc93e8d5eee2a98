"""Each part of the neck on its own: geometry, link, tendon, drive, inclinometer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._drive_runtime import drive_rates
from softneck.plant._geometry_runtime import bend_functions, lean_angles, tilt_rotation
from softneck.plant._inclinometer_runtime import InclinometerNoise
from softneck.plant._link_runtime import link_hysteresis, link_weight
from softneck.plant._mechanics_runtime import neck_drive
from softneck.plant._tendon_runtime import tendon_chord, tendon_tension
from softneck.runtime import load_functions
from softneck.runtime._layout import Arrays

L0, RADIUS = 0.107, 0.052
NOISE = InclinometerNoise.parts(Arrays(()))


@pytest.fixture(scope="module")
def sensor() -> Any:
    """The functions of the inclinometer."""
    return load_functions("softneck.plant._inclinometer_runtime")


@pytest.mark.parametrize("beta", [1e-9, 1e-3, 0.0999, 0.1001, 0.5, 1.5])
def test_bend_functions_are_continuous_through_the_straight_neck_and_their_slopes_are_slopes(beta: float) -> None:
    A, B, S, dA, dB, dS = bend_functions(beta * beta)
    assert pytest.approx(2 * math.sin(beta / 2) ** 2, rel=1e-13) == A * beta * beta
    assert pytest.approx(math.sin(beta), rel=1e-13) == B * beta
    assert pytest.approx(2 * math.sin(beta / 2), rel=1e-13) == S * beta
    h = 1e-4
    ahead, behind = bend_functions((beta + h) ** 2), bend_functions((beta - h) ** 2)
    for f, slope in ((0, dA), (1, dB), (2, dS)):
        # A central difference: h^2 / 6 of a third derivative below 1, and eps / h.
        assert slope * beta == pytest.approx((ahead[f] - behind[f]) / (2 * h), abs=1e-8)


@pytest.mark.parametrize("psi", [0.0, 0.7, 2.1, 4.0])
@pytest.mark.parametrize("beta", [0.05, 0.3, 0.9])
def test_the_chord_is_the_labs_formula_and_the_distance_of_its_ends(beta: float, psi: float) -> None:
    s = 0.004
    b1, b2 = beta * math.cos(psi), beta * math.sin(psi)
    L = L0 - s
    for psi_i in (0.0, 2 * math.pi / 3, 4 * math.pi / 3):
        e = (math.cos(psi_i), math.sin(psi_i))
        got = tendon_chord((b1, b2, s, 0.0, 0.0, 0.0), bend_functions(beta**2), e, (L0, RADIUS))[0]
        assert got == pytest.approx(2 * (L / beta - RADIUS * math.cos(psi_i - psi)) * math.sin(beta / 2), rel=1e-13)
        # And as the distance between the two attachments, from rotation matrices alone.
        k = np.array([-math.sin(psi), math.cos(psi), 0.0])
        K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        R = np.eye(3) + math.sin(beta) * K + (1 - math.cos(beta)) * K @ K
        lean = np.array([math.cos(psi), math.sin(psi), 0.0])
        end = L / beta * ((1 - math.cos(beta)) * lean + math.sin(beta) * np.array([0, 0, 1]))
        arm = RADIUS * np.array([*e, 0.0])
        assert got == pytest.approx(float(np.linalg.norm(end + R @ arm - arm)), rel=1e-13)


def test_the_chords_rate_is_the_slope_of_its_length() -> None:
    x, w, h = np.array([0.2, -0.3, 0.01]), np.array([1.1, 0.4, -0.02]), 1e-6

    def chord(q: np.ndarray) -> tuple[float, ...]:
        return tendon_chord((*q.tolist(), *w.tolist()), bend_functions(q[0] ** 2 + q[1] ** 2), (0.6, 0.8), (L0, RADIUS))

    rate, slopes = chord(x)[1], chord(x)[2:]
    # Central differences: eps / h = 2e-10.
    assert rate == pytest.approx((chord(x + h * w)[0] - chord(x - h * w)[0]) / (2 * h), abs=1e-8)
    numeric = [(chord(x + h * d)[0] - chord(x - h * d)[0]) / (2 * h) for d in np.eye(3)]
    np.testing.assert_allclose(slopes, numeric, atol=1e-8)


def test_a_rotated_base_turns_what_the_inclinometer_sees() -> None:
    straight = (0.0, 0.0, 0.0, 0.0)
    f = bend_functions(0.0)
    for pitch, roll in ((0.2, 0.0), (0.0, -0.3)):
        assert lean_angles(straight, f, tilt_rotation(pitch, roll))[:2] == pytest.approx((pitch, roll), abs=1e-14)
    R = np.reshape(tilt_rotation(0.3, -0.4), (3, 3))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    # A bend and a base that lean the same way add up.
    bent = lean_angles((0.1, 0.0, 0.0, 0.0), bend_functions(0.01), tilt_rotation(0.2, 0.0))
    assert bent[0] == pytest.approx(0.3, abs=1e-14)


def test_the_angles_rates_are_their_slopes() -> None:
    R, b, w, h = tilt_rotation(0.1, 0.2), np.array([0.3, -0.2]), np.array([0.7, 0.5]), 1e-6

    def angles(b: np.ndarray) -> np.ndarray:
        return np.array(lean_angles((b[0], b[1], w[0], w[1]), bend_functions(float(b @ b)), R))

    numeric = (angles(b + h * w) - angles(b - h * w))[:2] / (2 * h)
    np.testing.assert_allclose(angles(b)[2:], numeric, atol=1e-8)


def test_gravity_and_push_are_the_slopes_of_their_work() -> None:
    weight, moment, push = 3.0, 0.05, np.array([0.7, -0.4])
    up = np.array(tilt_rotation(0.2, -0.1))[6:9]

    def potential(q: np.ndarray) -> float:
        A, B, *_ = bend_functions(float(q[:2] @ q[:2]))
        L, cosine = L0 - q[2], math.cos(float(np.hypot(q[0], q[1])))
        gravity = up[:2] @ q[:2] * (weight * L * A + moment * B) + up[2] * (weight * L * B + moment * cosine)
        return float(gravity - push @ q[:2] * L * A)

    q, h = np.array([0.25, -0.4, 0.006]), 1e-6
    force = link_weight(
        (q[0], q[1], L0 - q[2]), bend_functions(float(q[:2] @ q[:2])), tuple(up), (weight, moment, *push)
    )
    numeric = [-(potential(q + h * d) - potential(q - h * d)) / (2 * h) for d in np.eye(3)]
    np.testing.assert_allclose(force, numeric, atol=1e-8)


def test_hysteresis_does_not_care_how_fast_it_is_bent_and_its_loop_loses_energy() -> None:
    reach = 0.08

    def loop(seconds: float) -> tuple[np.ndarray, np.ndarray]:
        n = 40_000
        t = np.linspace(0.0, seconds, n + 1)
        b = 0.3 * np.sin(2 * np.pi * t / seconds)
        z, track = (0.0, 0.0), [(0.0, 0.0)]
        for dt, db in zip(np.diff(t), np.diff(b), strict=True):
            rate = link_hysteresis(z[0], z[1], db / dt, 0.0, reach)
            z = (z[0] + dt * rate[0], z[1] + dt * rate[1])
            track.append(z)
        return b, np.array(track)[:, 0]

    b, fast = loop(0.5)
    _, slow = loop(50.0)
    # The same path in b is the same path in z: only rounding of dt differs.
    np.testing.assert_allclose(fast, slow, atol=1e-10)
    assert np.abs(fast).max() <= reach
    assert np.trapezoid(fast, b) > 0.5 * reach * 0.6


def test_a_tendon_pulls_only_and_friction_resists_sliding() -> None:
    c = (2000.0, 5.0, 0.1, 0.01)
    assert tendon_tension(-1e-6, 1.0, 1.0, c) == (0.0, 0.0)
    # A taut tendon that shortens faster than it recovers has lost its tension, not turned into a rod.
    assert tendon_tension(1e-4, -1.0, -1.0, c) == (0.0, 0.0)
    still, at_rest = tendon_tension(1e-3, 0.0, 0.0, c)
    assert still == at_rest == pytest.approx(2.0)
    _, lengthening = tendon_tension(1e-3, 0.0, 1.0, c)
    _, shortening = tendon_tension(1e-3, 0.0, -1.0, c)
    # Far beyond the smoothing speed it is Coulomb's: a tenth of the tension.
    assert (lengthening, shortening) == (pytest.approx(2.2), pytest.approx(1.8))


def drive_run(seconds: float, command: float, pull: float, **changes: float) -> np.ndarray:
    """Positions and speeds of one drive by small Euler steps, (time, 2)."""
    q = np.append(NeckParameters.paper().replace(**changes).vector(), 0.0)
    c, dt = neck_drive(q), 2e-5
    x, rows = [0.0, 0.0, 0.0], []
    for _ in range(round(seconds / dt)):
        acceleration, growth = drive_rates((x[0], x[1], x[2]), command, pull, math.tanh(x[1] / c[9]), c)
        x = [x[0] + dt * x[1], x[1] + dt * acceleration, x[2] + dt * growth]
        rows.append(x[:2])
    return np.array(rows)


@pytest.mark.slow
def test_a_drive_keeps_its_speed_limit_and_holds_its_position_under_load() -> None:
    limit = 8.0
    run = drive_run(2.0, 4.0, 0.02, speed_limit=limit)
    # The speed loop overshoots its set-point by less than a tenth.
    assert run[:, 1].max() < 1.1 * limit
    assert run[-1, 0] == pytest.approx(4.0, abs=2e-3)


@pytest.mark.slow
def test_a_tendon_that_pulls_harder_than_the_current_limit_drives_the_winch_back() -> None:
    torque = neck_drive(np.append(NeckParameters.paper().vector(), 0.0))[4]
    assert drive_run(0.3, 0.0, 1.5 * torque)[-1, 0] < -0.5
    assert drive_run(0.3, 0.0, 0.7 * torque)[-1, 0] > -0.05


def test_the_delay_is_the_delay(sensor: Any) -> None:
    history, Ts = np.zeros(6 * 12), 0.02
    for k in range(40):
        t = k * Ts
        sensor.inclinometer_store(history, (math.sin(3 * t), t, 3 * math.cos(3 * t), 1.0, t, 2 * t))
    now = 39 * Ts
    for delay in (0.0, 0.02, 0.033, 0.1, 0.2):
        pitch, roll, pitch_rate, roll_rate = sensor.inclinometer_delayed(history, delay, Ts)
        # Hermite: Ts^4 / 384 of a fourth derivative of 81.
        assert pitch == pytest.approx(math.sin(3 * (now - delay)), abs=4e-8)
        assert (roll, pitch_rate, roll_rate) == pytest.approx((now - delay, now - delay, 2 * (now - delay)))


@pytest.mark.slow
def test_noise_and_drift_have_the_spread_they_are_asked_for(sensor: Any) -> None:
    generator, noise = np.array([1.0, 2, 3, 4, 5, 6]), np.zeros(9)
    sensor.inclinometer_start(noise, generator, 0.02, 0.0)
    rows = []
    for _ in range(60_000):
        sensor.inclinometer_measure((0.0, 0.0, 0.0, 0.0), noise, generator, (0.02, 0.9, 0.0, 0.9, 0.01, 0.05, 0.0))
        rows.append([noise[NOISE[name]][0] for name in ("bias", "angles", "rates")])
    drift, angle, rate = np.array(rows).T
    # 60,000 samples, the drift's correlated over 20: 3 standard errors are 4 % there and 1 % elsewhere.
    assert drift.std() == pytest.approx(0.02, rel=0.04)
    assert (angle - drift).std() == pytest.approx(0.01, rel=0.01)
    assert rate.std() == pytest.approx(0.05, rel=0.01)
    assert np.corrcoef(drift[1:], drift[:-1])[0, 1] == pytest.approx(0.9, abs=0.01)


def test_dropouts_come_as_often_and_last_as_long_as_asked(sensor: Any) -> None:
    generator, noise = np.array([6.0, 5, 4, 3, 2, 1]), np.zeros(9)
    noise[NOISE["arrives"]] = 1.0
    valid = []
    for _ in range(100_000):
        sensor.inclinometer_dropout(noise, generator, 0.01, 0.2)
        valid.append(noise[NOISE["arrives"]].item())
    lost = 1.0 - np.array(valid)
    starts = int((np.diff(lost) > 0).sum())
    # Mean length 1 / 0.2 = 5 samples; about 950 dropouts, so 3 standard errors are 9 %.
    assert lost.sum() / starts == pytest.approx(5.0, rel=0.1)
    assert lost.mean() == pytest.approx(5.0 / 105.0, rel=0.1)


def test_a_dropped_sample_holds_the_last_one_and_says_so() -> None:
    neck = NeckParameters.paper().replace(dropout_rate=3.0, dropout_time=0.2)
    block = VirtualNeck(neck).block(noise_seed=2)
    U = np.zeros((500, 8))
    U[:, 0] = np.sin(np.arange(500) * 0.02)
    _, Y = block.run(block.initial_state(), U)
    lost = np.flatnonzero(Y[1:, 6] == 0.0) + 1
    assert 20 < lost.size < 480
    np.testing.assert_array_equal(Y[lost, 2:6], Y[lost - 1, 2:6])


def test_encoders_and_angles_come_in_whole_steps() -> None:
    neck = NeckParameters.paper().replace(noise_quantum=1e-3)
    block = VirtualNeck(neck).block()
    U = np.zeros((100, 8))
    U[:, 0] = np.linspace(0, 2, 100)
    _, Y = block.run(block.initial_state(), U)
    for columns, quantum in (((2, 3), 1e-3), ((7, 8, 9), 2 * np.pi / 48490)):
        steps = Y[:, columns] / quantum
        # Rounding of a few thousand steps.
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-8)


@pytest.mark.parametrize("quantum", [1e-3, 0.25])
def test_the_inclinometer_rounds_to_the_nearest_step_without_a_bias(sensor: Any, quantum: float) -> None:
    values = np.arange(-3.299, 4.7, 0.002) * quantum
    shown = np.array([sensor.inclinometer_round(float(value), quantum) for value in values])
    # A whole number of steps, and the nearest one: never further than half a step; rounding is eps of a few steps.
    np.testing.assert_allclose(shown / quantum, np.round(shown / quantum), rtol=0, atol=1e-12)
    assert np.abs(shown - values).max() <= 0.5 * quantum * (1.0 + 1e-12)
    # Over eight whole steps, points symmetric about each, errors cancel but for rounding: floor leaves half a step.
    assert abs((shown - values).mean()) < 1e-9 * quantum
    assert sensor.inclinometer_round(0.123, 0.0) == 0.123
    assert sensor.inclinometer_round(0.123, -1.0) == 0.123


def test_what_the_inclinometer_holds_is_rounded_in_both_axes_and_rates_are_not(sensor: Any) -> None:
    generator, noise = np.array([1.0, 2, 3, 4, 5, 6]), np.zeros(9)
    noise[NOISE["arrives"]] = 1.0
    sensor.inclinometer_measure((0.26, -0.14, 0.26, -0.14), noise, generator, (0.0, 0.9, 0.0, 0.9, 0.0, 0.0, 0.1))
    np.testing.assert_allclose(noise[NOISE["angles"]], [0.3, -0.1], rtol=1e-12)  # rounding of 0.1
    np.testing.assert_allclose(noise[NOISE["rates"]], [0.26, -0.14], rtol=1e-12)
