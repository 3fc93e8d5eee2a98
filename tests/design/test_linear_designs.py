"""Each synthesis against the law that defines it, conditioning against theorems."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from softneck.core import SettingsError
from softneck.design import HinfSettings, LqgSettings, PidSettings, PiSettings, fopi
from softneck.design.linear._axis_loop import (
    axis_margins,
    conditioning_gain,
    delayed_form,
    feedback_response,
    make_sweep,
)
from softneck.design.linear._controller import AxisController
from softneck.design.linear._fopi import FractionalPi
from softneck.design.linear._pid import PidGains
from softneck.design.plants._uncertain import StepAndLoad

from ..data import with_starts
from ..oracles.bake_off import bake_off_neck, bake_off_plant, bake_off_plants, block_stepper, exact, run_bake_off

TS = 0.02
PLANT = bake_off_plant()


def axis_of(controller: Any) -> AxisController:
    """Pitch of a controller whose axes are alike."""
    A, Br, By, C, Dr, Dy, L = controller.arrays[4:11]
    n = A.shape[0] // 2
    return AxisController(A=A[:n, :n], Br=Br[:n, :1], By=By[:n, :1], C=C[:1, :n], Dr=Dr[0, 0], Dy=Dy[0, 0], L=L[:n, :1])


@pytest.mark.parametrize(
    "settings",
    [pytest.param(HinfSettings(), marks=pytest.mark.slow), LqgSettings(), PiSettings()],
    ids=["hinf", "lqg", "pi"],
)
@pytest.mark.parametrize("test", [StepAndLoad(), StepAndLoad(reference=0.5, slew_limit=0.1)], ids=["small", "limited"])
def test_the_sweep_of_a_search_is_the_bake_off(settings: Any, test: StepAndLoad) -> None:
    controller = settings.design(bake_off_neck())
    plants = bake_off_plants()[::9]
    axis = axis_of(controller)
    time = controller.design["pitch"]["gains"]["reference_time_s"]
    swept = make_sweep(plants, test=test).run(axis, time, axis.conditioning())
    slow = run_bake_off(block_stepper(with_starts(controller.block(), lead_limit=12.0), test), plants, test)
    # Sums in another order, over 300 samples.
    np.testing.assert_allclose(swept.angles, slow.angles, atol=1e-10)


def test_fopi_is_iso_damped() -> None:
    """Crossover, margin and a flat phase, by the response of the exact-delay plant."""
    for crossover in (1.0, 3.0, 6.0):
        for margin in np.radians([50.0, 70.0, 90.0]):
            found = fopi(PLANT, crossover=crossover, phase_margin=margin)
            w = crossover * np.array([0.99, 1.0, 1.01])
            loop = PLANT.response(w) * found.response(w)
            assert abs(loop[1]) == pytest.approx(1.0, rel=1e-12)
            assert math.pi + np.angle(loop[1]) == pytest.approx(margin, abs=1e-9)
            # Flat to second order: over 2 % of frequency its cubic part leaves less than 1e-4 rad.
            assert abs(np.angle(loop[2] / loop[0])) < 1e-4


def test_fopi_takes_control_systems() -> None:
    from_tf = fopi(PLANT.tf(), crossover=4.0)
    assert from_tf.integral_order == pytest.approx(fopi(PLANT, crossover=4.0).integral_order, rel=1e-9)
    continuous = control.TransferFunction([PLANT.static_gain], [1.0 / 5.293, 1.0])
    assert fopi(continuous, crossover=4.0, phase_margin=1.9).integral > 0.0
    with pytest.raises(SettingsError, match="no integration order"):
        fopi(PLANT, crossover=30.0)
    with pytest.raises(SettingsError, match="needs a control"):
        fopi(2.0, crossover=3.0)


@pytest.mark.parametrize("order", [0.6, 1.0, 1.2, 1.4])
def test_a_fractional_integral_is_realised_with_a_true_integrator(order: float) -> None:
    ideal = FractionalPi(gain=10.0, integral=6.0, integral_order=order, crossover=4.0)
    K = ideal.controller(TS)
    assert np.min(np.abs(K.poles() - 1.0)) == 0.0
    w = np.geomspace(0.4, 20.0, 60)
    error = np.abs(np.asarray(K(np.exp(1j * w * TS))) / ideal.response(w) - 1.0)
    # Oustaloup's ripple at 13 sections over six decades; above 5 times the crossover the bilinear map shows.
    assert error.max() < 5e-3


def test_a_fractional_pi_of_whole_order_is_a_pi() -> None:
    ideal = FractionalPi(gain=2.0, integral=3.0, integral_order=1.0, crossover=4.0)
    K: Any = ideal.controller(TS)
    # Ki/s by Tustin, its gain exact at the crossover: (w Ts/2)/tan(w Ts/2) = 0.9995.
    tustin: Any = control.TransferFunction([TS / 2.0, TS / 2.0], [1.0, -1.0], TS)
    z = np.exp(1j * np.array([0.1, 1.0, 10.0]) * TS)
    np.testing.assert_allclose(K(z), 2.0 * (1.0 + 3.0 * tustin(z)), rtol=6e-4)


def test_pid_gains_are_what_their_equation_says() -> None:
    gains = PidGains(gain=8.0, integral_time=0.2, derivative_time=0.05, filter_time=0.01)
    z = np.exp(1j * np.geomspace(0.1, 150.0, 30) * TS)
    np.testing.assert_allclose(feedback_response(gains.axis(TS), z), gains.response(z, TS), rtol=1e-9)


@pytest.mark.slow
def test_pid_over_the_samples_is_the_best_near_itself() -> None:
    """What is searched for is the worst load; a grid around the answer finds nothing better that keeps the bounds."""
    settings = PidSettings()
    found = settings.design(exact(bake_off_neck())).design["pitch"]
    gains = found["gains"]
    assert found["worst_sensitivity"] <= 2.0
    plants = [bake_off_plant(k) for k in (1.0, 0.8, 1.2)]
    sweep = make_sweep(plants)

    def worst(K: float, Ti: float, Td: float) -> float:
        axis = PidGains(K, Ti, Td, gains["Tf_s"]).axis(TS)
        noise = abs(float(np.real(feedback_response(axis, np.array([-1.0 + 0j]))[0]))) * PLANT.static_gain
        margins = axis_margins(axis, plants, 0).sensitivity
        if noise > settings.noise_gain or margins.max() > settings.max_sensitivity:
            return math.inf
        return float(sweep.run(axis, 0.3, axis.conditioning()).load_rms.max())

    best = worst(0.999 * gains["K"], gains["Ti_s"], gains["Td_s"])
    for K in (0.95, 1.0, 1.05):
        for Ti in (0.9, 1.1):
            for Td in (0.85, 1.15):
                # Nelder and Mead end within 2 % of the least.
                assert worst(K * gains["K"], Ti * gains["Ti_s"], Td * gains["Td_s"]) >= 0.98 * best


def test_lqg_separates() -> None:
    """The loop's poles are those of the regulator and of the filter (Astrom and Wittenmark 1997, sec. 11.4)."""
    controller = LqgSettings().design(exact(bake_off_neck(), spread=0.0))
    rate = controller.design["pitch"]["gains"]["load_rate_rad_s"]
    axis = axis_of(controller)
    A, B, C = delayed_form(PLANT)
    whole = np.block([[A + axis.Dy * np.outer(B, C), np.outer(B, axis.C[0])], [axis.By @ C[None, :], axis.A]])
    found = np.poly(np.linalg.eigvals(whole))
    B1 = B / 1.0
    c = C / PLANT.static_gain
    X = solve_discrete_are(A, B1[:, None], np.outer(c, c), np.array([[0.1]]))
    F = B1 @ X @ A / (0.1 + B1 @ X @ B1)
    Aa, ca = np.block([[A, B[:, None]], [np.zeros((1, 5)), np.ones((1, 1))]]), np.append(c, 0.0)
    Q = np.zeros((6, 6))
    Q[:5, :5], Q[5, 5] = 100.0 * np.outer(B, B), (rate * TS) ** 2
    P = solve_discrete_are(Aa.T, ca[:, None], Q, np.eye(1))
    M = P @ ca / (1.0 + ca @ P @ ca)
    wanted = np.convolve(np.poly(A - np.outer(B1, F)), np.poly(Aa @ (np.eye(6) - np.outer(M, ca))))
    # Characteristic polynomials of order 11: multiple poles at zero make the poles themselves uncertain.
    np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_conditioning_is_hanus_where_its_zeros_are_stable() -> None:
    K = PidSettings().design(bake_off_neck())
    axis = axis_of(K)
    hanus = axis.Br / axis.Dr
    assert np.abs(np.linalg.eigvals(axis.A - hanus @ axis.C)).max() < 1.0
    np.testing.assert_array_equal(conditioning_gain(axis.A, axis.Br, axis.C, axis.Dr), hanus)


@pytest.mark.parametrize("direct", [0.0, 1.0])
def test_conditioning_exists_where_hanus_has_none(direct: float) -> None:
    """No direct gain, or a zero at 1.2: an integrator is stable at its limits all the same."""
    A, B = np.diag([1.0, 0.5]), np.ones((2, 1))
    C = np.array([[0.3, 0.2]]) if direct == 0.0 else np.array([[-0.14, -0.56]])
    if direct:
        zeros = np.linalg.eigvals(A - B @ C / direct)
        assert np.abs(zeros).max() > 1.1
    L = conditioning_gain(A, B, C, direct)
    assert np.abs(np.linalg.eigvals(A - L @ C)).max() < 1.0


def test_a_hidden_integrator_has_no_conditioning() -> None:
    with pytest.raises(SettingsError, match="no conditioning keeps the controller stable"):
        conditioning_gain(np.diag([1.0, 0.5]), np.ones((2, 1)), np.array([[0.0, 1.0]]), 0.0)
