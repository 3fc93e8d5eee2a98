"""Eq. 4-11 and the tilt's geometry, against what the paper and scipy say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from softneck.core import SettingsError
from softneck.signals import TENDON_ANGLES, motors_from, redefine, redefinition_matrix
from softneck.signals.importing._clocks import pitch_roll

MOTORS = st.lists(st.floats(-6, 6), min_size=3, max_size=3)


@given(motors=MOTORS)
def test_the_lab_neck_gives_the_papers_numbers(motors: list[float]) -> None:
    P1, P2, P3 = motors
    theta_i, phi_i, delta_i = redefine(np.array([motors]))[0]
    assert theta_i == pytest.approx(P1 - 0.5 * (P2 + P3), abs=1e-14)  # Eq. 9
    # Eq. 10 prints sqrt(3)/2 as 0.866: 3e-5 of at most 12 rad.
    assert phi_i == pytest.approx(0.866 * (P2 - P3), abs=4e-4)
    assert delta_i == pytest.approx((P1 + P2 + P3) / 3, abs=1e-14)  # Eq. 11


@given(motors=MOTORS, angles=st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3))
def test_the_inverse_brings_the_motors_back(motors: list[float], angles: list[float]) -> None:
    gamma, P = np.array(angles), np.array([motors])
    T = np.array([np.cos(gamma), np.sin(gamma), np.full(3, 1 / 3)])
    assume(abs(np.linalg.det(T)) > 0.01)
    # 6 rad times eps times the condition number, which the determinant bounds by about 300; tenfold margin.
    np.testing.assert_allclose(motors_from(redefine(P, gamma), gamma), P, rtol=0, atol=6 * 2.2e-16 * 3000)
    np.testing.assert_allclose(redefine(motors_from(P, gamma), gamma), P, rtol=0, atol=6 * 2.2e-16 * 30000)


def test_turning_the_neck_turns_the_inputs() -> None:
    """Tendon angles all turned by psi: (theta_i, phi_i) turn by psi, and co-contraction stays."""
    psi, P = 0.3, np.array([[1.0, -0.4, 0.7]])
    before, after = redefine(P)[0], redefine(P, TENDON_ANGLES + psi)[0]
    turned = Rotation.from_rotvec([0, 0, psi]).apply(before)
    np.testing.assert_allclose(after, turned, rtol=0, atol=1e-14)


@pytest.mark.parametrize("angles", [[0, 0, 1], [0, np.nan, 1], [0, 1]])
def test_angles_that_do_not_span_the_plane_are_refused(angles: list[float]) -> None:
    with pytest.raises(SettingsError, match="three tendon angles that span the plane are needed"):
        redefinition_matrix(np.array(angles))


@pytest.mark.parametrize(("determinant", "spans"), [(1.01e-3, True), (0.99e-3, False)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angles_span_the_plane_down_to_a_determinant_of_a_thousandth(
    determinant: float, spans: bool, sign: float
) -> None:
    # Two at right angles, the third near the first: (sin a + cos a - 1)/3 = a/3 of a small angle a, all but its square.
    angles = np.array([0.0, sign * np.pi / 2.0, sign * 3.0 * determinant * (1.0 + 1.5 * determinant)])
    if spans:
        assert np.linalg.det(redefinition_matrix(angles)) == pytest.approx(-sign * determinant, rel=1e-4)
    else:
        with pytest.raises(SettingsError, match="span the plane"):
            redefinition_matrix(angles)


def test_what_is_zero_but_for_rounding_is_zero() -> None:
    T = redefinition_matrix(np.radians([0.0, 90.0, 180.0]))
    assert (T[0, 1], T[1, 2], T[1, 0]) == (0.0, 0.0, 0.0)
    assert redefinition_matrix(np.array([2e-15, 1.0, 2.0]))[1, 0] == 2e-15


@given(i=st.floats(0, 1.5), o=st.floats(-np.pi, np.pi))
def test_pitch_and_roll_are_the_angles_of_the_tilt_vector(i: float, o: float) -> None:
    """The platform's normal, tilted by scipy about the axis at right angles to the orientation."""
    normal = Rotation.from_rotvec(i * np.array([-np.sin(o), np.cos(o), 0.0])).apply([0.0, 0.0, 1.0])
    pitch, roll = pitch_roll(np.array([i]), np.array([o]))
    # Away from 90 deg the angles are well conditioned: tan(1.5) = 14 times a few ulp.
    assert np.tan(pitch[0]) == pytest.approx(normal[1] / normal[2], rel=1e-12, abs=1e-13)
    assert np.tan(roll[0]) == pytest.approx(-normal[0] / normal[2], rel=1e-12, abs=1e-13)


def test_motor_1_sits_where_pitch_is() -> None:
    pitch, roll = pitch_roll(np.radians([15.0, 15.0]), np.radians([90.0, 180.0]))
    np.testing.assert_allclose(np.degrees(pitch), [15.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(np.degrees(roll), [0.0, 15.0], atol=1e-13)
