from __future__ import annotations

import math

import control
import numpy as np
import pytest

from softneck.core import Matrix, SettingsError, load
from softneck.identification import Model
from softneck.runtime import State
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..data import ROOT, slow_but

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")
MOTORS = ["motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3"]


def model_of(name: str) -> Model:
    model = load(ROOT / "tests" / "golden" / f"{name}.npz", role="model")
    assert isinstance(model, Model)
    return model


def from_motors(model: Model) -> control.StateSpace:
    """Return `model.ss()` with the motors' set-points as inputs: Eq. 9-11 before it where it has theta_i and phi_i."""
    G = model.ss()
    if G.input_labels == MOTORS:
        return G
    T = redefinition_matrix(np.array(TENDON_ANGLES))[:2]
    return control.StateSpace(G.A, np.asarray(G.B) @ T, G.C, np.zeros((2, 3)), model.sample_time)


# Those whose inputs are the motors' positions see the drives before them, which `ss()` leaves out.
@pytest.mark.parametrize("name", slow_but(["rls", "oe", "rls_mimo"], ["oe"], ["rls"]))
def test_of_a_linear_model_it_is_its_own_system(name: str) -> None:
    model = model_of(name)
    G = model.linearize(at=[0.5, -0.2, 0.1])
    assert (G.dt, G.input_labels) == (model.sample_time, MOTORS)
    assert G.output_labels == ["pitch", "roll", "motor_position_1", "motor_position_2", "motor_position_3"]
    w = np.geomspace(0.1, 100.0, 20)
    seen = G(np.exp(1j * w * model.sample_time))
    expected = from_motors(model)(np.exp(1j * w * model.sample_time))
    if of_positions(model):
        expected = np.einsum("ijk,jlk->ilk", expected, seen[2:])
    # Both resolve some twenty states; near a pole 1e-16 of rounding is amplified by up to 1e4.
    np.testing.assert_allclose(seen[:2], expected, rtol=1e-9, atol=1e-12)


def of_positions(model: Model) -> bool:
    """Return whether a linear model's inputs are motor positions."""
    if "source" in model.arrays:
        return bool(model.arrays["source"][0] == 1.0)
    return "A" in model.arrays and bool(model.arrays["delay"][1] == 1.0)


@pytest.mark.parametrize("name", slow_but(["nn", "play"], ["play"], ["nn"]))
def test_near_rest_a_model_moves_as_its_linear_system(name: str) -> None:
    model = model_of(name)
    # Play operators that were drawn to an edge move in one direction only; at zero they stand in their middle.
    at = {} if name == "play" else {"motor_setpoint_1": 1.0, "motor_setpoint_2": -0.3}
    G, du = model.linearize(at=at), np.linalg.solve(redefinition_matrix(np.array(TENDON_ANGLES)), np.ones(3))
    u = np.array([at.get(name, 0.0) for name in MOTORS])

    def run(h: float) -> Matrix:
        block = model.block()
        state, rows = model.initial_state(use_measurement=0.0), np.full((2000, 8), np.nan)
        rows[:, :3] = u
        state, _ = block.run(state, rows)
        rows[:, :3] = u + h * du
        return block.run(state, rows[:60])[1][:, :2]

    h, z = 1e-6, np.zeros(G.nstates)
    linear = []
    for _ in range(60):
        z = G.A @ z + G.B @ du
        linear.append(G.C[:2] @ z)
    # h times the second derivative, below 10, and 1e-16 / h of rounding.
    np.testing.assert_allclose((run(h) - run(0.0)) / h, linear, atol=1e-5)


def test_the_jacobian_is_what_small_changes_say() -> None:
    model, rng = model_of("play"), np.random.default_rng(0)
    state, u = model.initial_state(pitch_start=0.1), np.zeros(3)
    for _ in range(20):
        u = np.clip(u + rng.normal(0.0, 0.4, 3), -6.0, 6.0)
        state, _ = model.step(state, u)
    J, n = model.jacobian(state, u), state.values.size
    assert [part.shape for part in J] == [(n, n), (n, 3), (6, n), (6, 3)]
    dx, du, h = rng.standard_normal(n), rng.standard_normal(3), 1e-6
    dx[np.abs(state.values) > 1e3] = 0.0  # the generator of random numbers
    ends = [model.step(State(state.values + s * dx, state.parameters, state.outputs), u + s * du) for s in (h, -h)]
    # Polynomials: h^2, and 1e-16 / h of rounding.
    change = (ends[0][0].values - ends[1][0].values) / (2.0 * h)
    quiet = np.abs(state.values) < 1e3
    np.testing.assert_allclose((J.A @ dx + J.B @ du)[quiet], change[quiet], atol=1e-8)
    np.testing.assert_allclose(J.C @ dx + J.D @ du, (ends[0][1] - ends[1][1]) / (2.0 * h), atol=1e-8)


def test_at_a_state_the_motors_stay() -> None:
    model = model_of("oe")
    state = model.initial_state()
    for _ in range(50):
        state, _ = model.step(state, [1.0, 0.0, 0.0])
    G, at_rest = model.linearize(at=state), model.linearize()
    z = np.exp(0.1j)
    # Linear: the same everywhere.
    np.testing.assert_allclose(G(z), at_rest(z), rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "at", "match"),
    [
        ("oe", {"motor_1": 1.0}, r"`motor_1` is not a set-point; `at` takes motor_setpoint_1, "),
        ("oe", [1.0, 2.0], r"`at`"),
        ("oe", [1.0, math.nan, 0.0], r"`at`"),
    ],
)
def test_what_it_cannot_use_is_refused(name: str, at: object, match: str) -> None:
    with pytest.raises((SettingsError, ValueError), match=match):
        model_of(name).linearize(at=at)  # type: ignore[arg-type]
