"""`lqgsyn` and `loopsyn` on plants of any number of inputs and outputs, against python-control and theorems."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import loopsyn, lqgsyn

SIZES = [(1, 1), (2, 2), (3, 2), (2, 3), (4, 1)]


def plant(inputs: int, outputs: int, dt: float, *, seed: int = 0, states: int = 5) -> Any:
    """Return a stable plant at random."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((states, states))
    values = np.linalg.eigvals(A)
    A = 0.8 * A / np.abs(values).max() if dt else A - (0.5 + values.real.max()) * np.eye(states)
    B, C = rng.standard_normal((states, inputs)), rng.standard_normal((outputs, states))
    return control.StateSpace(A, B, C, np.zeros((outputs, inputs)), dt)


def of_lags(dt: float, inputs: int = 2) -> Any:
    """Return a plant of two outputs without zeros outside: each moved most by its own input."""
    B = np.array([[5.0, 1.0, 0.5], [0.5, 3.0, 1.0], [1.0, 2.0, 0.3]])[:, :inputs]
    C = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, -0.1]])
    G = control.StateSpace(np.diag([-5.0, -3.0, -8.0]), B, C, np.zeros((2, inputs)))
    return control.sample_system(G, dt) if dt else G


def closed(G: Any, K: Any) -> Any:
    """Return the loop from references to outputs."""
    one: Any = control.StateSpace([], [], [], np.eye(G.noutputs), G.dt)
    return control.feedback(G * K, one)


@pytest.mark.parametrize("dt", [0.0, 0.05])
@pytest.mark.parametrize(("inputs", "outputs"), SIZES)
def test_the_loops_poles_are_those_of_regulator_and_filter(inputs: int, outputs: int, dt: float) -> None:
    """The separation principle, with gains that python-control finds."""
    G = plant(inputs, outputs, dt)
    loop = closed(G, lqgsyn(G, control_weight=0.3, input_noise=2.0, load_rate=0.7))
    F = (control.dlqr if dt else control.lqr)(G.A, G.B, G.C.T @ G.C, 0.3 * np.eye(inputs))[0]
    k, loads = G.nstates, min(inputs, outputs)
    near = (1.0 if dt else 0.0) + 1e-3
    L = np.eye(inputs) if inputs <= outputs else np.linalg.svd(G(near, squeeze=False).real)[2][:outputs].T
    Aa = np.block([[G.A, G.B @ L], [np.zeros((loads, k)), (np.eye(loads) if dt else np.zeros((loads, loads)))]])
    Ca = np.hstack([G.C, np.zeros((outputs, loads))])
    noise = np.zeros((k + loads, k + loads))
    noise[:k, :k], noise[k:, k:] = 4.0 * G.B @ G.B.T, 0.49 * (dt or 1.0) * np.eye(loads)
    M = (control.dlqe if dt else control.lqe)(Aa, np.eye(k + loads), Ca, noise, np.eye(outputs))[0]
    expected = np.concatenate([np.linalg.eigvals(G.A - G.B @ F), np.linalg.eigvals(Aa - M @ Ca)])
    found = np.linalg.eigvals(loop.A)
    # Coefficients, for nearly equal poles change places; two Riccati equations of order 8 at 1e-10.
    np.testing.assert_allclose(np.poly(found), np.poly(expected), rtol=1e-6, atol=1e-6)
    assert np.abs(found).max() < 1.0 if dt else found.real.max() < 0.0


@pytest.mark.parametrize("dt", [0.0, 0.05])
@pytest.mark.parametrize(("inputs", "outputs"), [size for size in SIZES if size[0] >= size[1]])
def test_no_offset_is_left_where_there_are_inputs_for_it(inputs: int, outputs: int, dt: float) -> None:
    G = plant(inputs, outputs, dt, seed=3)
    # Of integrators that rounding leaves at 1e-15.
    np.testing.assert_allclose(np.atleast_2d(closed(G, lqgsyn(G)).dcgain()), np.eye(outputs), atol=1e-6)


@pytest.mark.parametrize("dt", [0.0, 0.02])
@pytest.mark.parametrize("inputs", [2, 3])
def test_each_loop_follows_the_target(inputs: int, dt: float) -> None:
    """Glover and McFarlane: singular values of G K are within gamma of the target where that is large or small."""
    G = of_lags(dt, inputs)
    found = loopsyn(G, control.TransferFunction([3.0], [1.0, 0.0]))
    for w in (0.03, 0.1, 0.3):
        at = np.exp(1j * w * dt) if dt else 1j * w
        ratios = np.linalg.svd((G * found.controller)(at), compute_uv=False) * w / 3.0
        assert ratios.min() > 1.0 / (1.05 * found.gamma)
        assert ratios.max() < 1.05 * found.gamma
    loop = closed(G, found.controller)
    poles = np.linalg.eigvals(loop.A)
    assert np.abs(poles).max() < 1.0 if dt else poles.real.max() < 0.0


def test_a_target_for_each_output_is_taken() -> None:
    G = of_lags(0.0)
    each = control.append(*(control.ss(control.TransferFunction([c], [1.0, 0.0])) for c in (1.0, 4.0)))
    found = loopsyn(G, each)
    L = (G * found.controller)(0.1j)
    np.testing.assert_allclose(np.abs(np.diag(L)) * 0.1, [1.0, 4.0], rtol=0.5)  # gamma is 1.4


def test_what_cannot_be_is_refused_in_a_line() -> None:
    with pytest.raises(SettingsError, match="at least as many inputs as outputs; got 2 and 3"):
        loopsyn(plant(2, 3, 0.0), 1.0)
    with pytest.raises(SettingsError, match="Gd must be scalar or have 2 inputs and outputs"):
        loopsyn(of_lags(0.0), control.append(*[control.ss(control.TransferFunction([1.0], [1.0, 1.0]))] * 3))
    same = of_lags(0.0)
    twin = control.StateSpace(same.A, same.B, np.vstack([same.C[0], same.C[0]]), same.D)
    with pytest.raises(SettingsError, match="not moved apart from each other"):
        loopsyn(twin, control.TransferFunction([3.0], [1.0, 0.0]))
    outside = control.ss(control.TransferFunction([-1.0, 2.0], [1.0, 4.0, 3.0]))
    with pytest.raises(SettingsError, match="zero at 2 outside"):
        loopsyn(control.append(outside, outside), control.TransferFunction([1.0], [1.0, 0.0]))
    hidden = control.StateSpace(np.diag([1.0, -1.0]), [[0.0], [1.0]], [[1.0, 1.0]], [[0.0]])
    with pytest.raises(SettingsError, match="no LQG controller stabilises"):
        lqgsyn(hidden)
    with pytest.raises(SettingsError, match=r"`control_weight` must be a number or symmetric, \(2, 2\)"):
        lqgsyn(plant(2, 2, 0.0), control_weight=np.eye(3))
    with pytest.raises(SettingsError, match="`output_weight` must be positive definite"):
        lqgsyn(plant(2, 2, 0.0), output_weight=0.0)
