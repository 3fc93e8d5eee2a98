"""Synthesis against slycot, against theorems, and against what makes it hang or lie."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import hinfsyn, makeweight, mixsyn
from softneck.design.robust import _hinf
from softneck.design.robust._hinf import Synthesis

from ..oracles.bake_off import bake_off_plant

TS = 0.02
PLANT = bake_off_plant()
# In units of its static gain, so that weights are plain numbers.
DISCRETE: Any = PLANT.tf() / PLANT.static_gain
LAG = control.TransferFunction([1.0], [1.0 / 5.293, 1.0])
CONTINUOUS: Any = control.ss(LAG * control.TransferFunction(*control.pade(0.08, 3)))
W1 = makeweight(1e4, 3.0, 0.6)


def by_slycot(P: Any, nmeas: int, ncon: int, *, above: float = 1.05) -> Synthesis:
    """Return what SLICOT's sb10ad, the routine behind python-control's `mixsyn`, makes of a continuous P."""
    slycot = pytest.importorskip("slycot")
    sizes = (P.nstates, P.ninputs, P.noutputs, ncon, nmeas)
    gamma = float(slycot.sb10ad(*sizes, 1e6, P.A, P.B, P.C, P.D, job=1, gtol=1e-5)[0])
    K = slycot.sb10ad(*sizes, above * gamma, P.A, P.B, P.C, P.D, job=4)[1:5]
    return Synthesis(controller=control.StateSpace(*K, 0), gamma=gamma, achieved=math.nan)


def mixsyn_by_slycot(*given: Any) -> Synthesis:
    """Return `mixsyn` of the same generalised plant."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_hinf, "hinfsyn", by_slycot)
        return mixsyn(*given)


def norm_of_mixed(G: Any, K: Any, weights: list[Any], points: int = 2000) -> float:
    """The largest |W1 S; W2 K S; W3 T| on a grid, from the frequency responses alone."""
    if G.dt:
        w = np.geomspace(1e-3, 0.9999 * np.pi / G.dt, points)
        at, at_weights = np.exp(1j * w * G.dt), 2j / G.dt * np.tan(0.5 * w * G.dt)
    else:
        at = at_weights = 1j * np.geomspace(1e-3, 1e4, points)
    g, k = np.asarray(G(at)), np.asarray(K(at))
    parts = [1.0 / (1.0 + g * k), k / (1.0 + g * k), g * k / (1.0 + g * k)]
    sizes = [
        np.abs(part * (W(at_weights) if hasattr(W, "dt") else W)) ** 2
        for W, part in zip(weights, parts, strict=True)
        if W is not None
    ]
    return float(np.sqrt(np.max(np.sum(sizes, axis=0))))


@pytest.mark.parametrize(
    "plant", [DISCRETE, pytest.param(CONTINUOUS, marks=pytest.mark.slow)], ids=["exact_delay", "pade"]
)
@pytest.mark.parametrize("W3", [None, makeweight(0.3, 20.0, 5.0)], ids=["two", "three"])
def test_our_riccati_synthesis_equals_slycot(plant: Any, W3: Any) -> None:
    ours, theirs = mixsyn(plant, W1, 0.2, W3), mixsyn_by_slycot(plant, W1, 0.2, W3)
    # Both searches end within 1e-4 of the least gamma.
    assert ours.gamma == pytest.approx(theirs.gamma, rel=3e-4)
    z = np.exp(1j * np.geomspace(1e-2, 100.0, 50) * TS) if plant.dt else 1j * np.geomspace(1e-2, 100.0, 50)
    # The central controllers at gammas 3e-4 apart.
    np.testing.assert_allclose(ours.controller(z), theirs.controller(z), rtol=2e-2)


@pytest.mark.parametrize("plant", [DISCRETE, CONTINUOUS], ids=["exact_delay", "pade"])
def test_the_norm_is_what_it_says(plant: Any) -> None:
    found = mixsyn(plant, W1, 0.2)
    size = norm_of_mixed(plant, found.controller, [W1, 0.2, None])
    # Built 5 % above gamma; two grids see the peak to 1e-3.
    assert found.gamma <= size * 1.001
    assert size <= 1.05 * found.gamma * 1.001
    assert size == pytest.approx(found.achieved, rel=1e-3)


def test_no_pi_does_better_than_gamma() -> None:
    """gamma is a bound below for every controller: PI controllers stay above it."""
    gamma = mixsyn(DISCRETE, W1, 0.2).gamma
    for gain in (0.3, 0.6, 0.9):
        for time in (0.1, 0.19, 0.4):
            pi: Any = control.TransferFunction([gain, gain * (TS / time - 1.0)], [1.0, -1.0], TS)
            assert norm_of_mixed(DISCRETE, pi, [W1, 0.2, None]) >= gamma


def test_a_known_optimum() -> None:
    """min over K of |K S|: any stable plant has 0; an unstable 1/(s - 1) needs |K S| >= 2 (Glover 1986)."""
    G = control.ss(control.TransferFunction([1.0], [1.0, -1.0]))
    found = mixsyn(G, makeweight(1e-4, (1.0, 1e-5), 1e-6), 1.0)
    # W1 of 1e-4 at most adds at most its square.
    assert found.gamma == pytest.approx(2.0, rel=1e-3)


def test_dt_and_names_are_kept() -> None:
    G = control.TransferFunction(DISCRETE.num, DISCRETE.den, TS, inputs=["theta_i"], outputs=["pitch"])
    K = mixsyn(G, W1, 0.2).controller
    assert (K.dt, K.input_labels, K.output_labels) == (TS, ["pitch"], ["theta_i"])


def test_what_hangs_or_lies_is_refused_in_words() -> None:
    integrator = control.TransferFunction([1.0], [1.0, 0.0])
    slow = makeweight(0.1, 20.0, 3.0)
    strictly_proper = control.TransferFunction([1.0], [1.0, 1.0])
    for given in ((DISCRETE, W1), (DISCRETE, W1, strictly_proper), (CONTINUOUS, W1, None, slow)):  # G itself falls off
        with pytest.raises(SettingsError, match="D12 has not full rank"):
            mixsyn(*given)
    with pytest.raises(SettingsError, match="W1 has an integrator"):
        mixsyn(DISCRETE, integrator, 0.2)
    with pytest.raises(SettingsError, match="W2 is not stable"):
        mixsyn(DISCRETE, W1, control.TransferFunction([1.0, 0.0], [1.0, -1.0]))
    with pytest.raises(SettingsError, match="W3 has more zeros than poles"):
        mixsyn(DISCRETE, W1, 0.2, control.TransferFunction([1.0, 1.0], [1.0]))
    with pytest.raises(SettingsError, match=r"W1 has dt = 0.01 s, the plant dt = 0.02 s"):
        mixsyn(DISCRETE, makeweight(1e3, 3.0, 0.5, dt=0.01), 0.2)
    with pytest.raises(SettingsError, match="at least one weight"):
        mixsyn(DISCRETE)
    with pytest.raises(SettingsError, match="must say its sample time"):
        mixsyn(control.TransferFunction([1.0], [1.0, 0.5], True), W1, 0.2)
    with pytest.raises(SettingsError, match="TransferFunction is needed"):
        mixsyn(3.0, W1, 0.2)


def test_a_measurement_without_input_of_its_own_is_refused() -> None:
    P = control.StateSpace(-np.eye(2), np.eye(2), np.eye(2), [[0.0, 1.0], [0.0, 0.0]], 0)
    with pytest.raises(SettingsError, match="D21 has not full rank"):
        hinfsyn(P, 1, 1)


def test_a_mode_that_no_input_reaches_is_no_solution() -> None:
    A = np.diag([1.0, -1.0])
    B = np.array([[0.0, 0.0], [1.0, 1.0]])
    C = np.array([[1.0, 1.0], [0.0, 0.0], [1.0, 1.0]])
    P = control.StateSpace(A, B, C, [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]], 0)
    with pytest.raises(SettingsError, match="no controller exists"):
        hinfsyn(P, 1, 1)


def _with_measurements(scale: np.ndarray) -> control.StateSpace:
    """A plant with two measurements whose noise comes in by `scale` (2, 2), a generalised plant with D21 = scale."""
    A = np.array([[-1.0, 2.0], [0.5, 0.3]])
    B = np.hstack([[[1.0], [0.4]], np.zeros((2, 2)), [[0.0], [1.0]]])
    C = np.array([[1.0, 0.5], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    D = np.zeros((4, 4))
    D[1, 3] = 2.0
    D[2:, 1:3] = scale
    return control.StateSpace(A, B, C, D, 0)


@pytest.mark.parametrize("D21", [[0.0, 3.0], [0.0, 0.2], [1.2, -0.7]], ids=["3", "0.2", "turned"])
def test_measurement_noise_of_any_size_gives_slycots_controller(D21: list[float]) -> None:
    P: Any = _with_measurements(np.array([D21, [0.0, 0.0]]))
    P = control.StateSpace(P.A, P.B, P.C[:3], P.D[:3], 0)
    ours, theirs = (synthesis(P, 1, 1) for synthesis in (hinfsyn, by_slycot))
    # Both searches end within 1e-4 of the least gamma.
    assert ours.gamma == pytest.approx(theirs.gamma, rel=3e-4)
    s = 1j * np.geomspace(1e-2, 100.0, 30)
    # The central controllers at gammas 3e-4 apart.
    np.testing.assert_allclose(ours.controller(s), theirs.controller(s), rtol=2e-2)


def test_other_units_of_a_measurement_and_of_the_input_change_the_controller_by_them_alone() -> None:
    """y' = M y and u = N u' leave the problem as it is: K' = N^-1 K M^-1, with the same gamma (D12, D21 not 1)."""
    P: Any = _with_measurements(np.diag([0.5, 3.0]))
    M, N = np.array([[3.0, 0.0], [0.4, 0.2]]), 5.0
    A, B, C, D = (np.array(part) for part in (P.A, P.B, P.C, P.D))
    C[2:], D[2:] = M @ C[2:], M @ D[2:]
    B[:, 3:], D[:, 3:] = B[:, 3:] * N, D[:, 3:] * N
    plain = hinfsyn(P, 2, 1)
    scaled = hinfsyn(control.StateSpace(A, B, C, D, 0), 2, 1)
    # The bisection passes through the same gammas; the rest is rounding of two Riccati equations.
    assert scaled.gamma == pytest.approx(plain.gamma, rel=1e-6)
    for s in 1j * np.geomspace(1e-2, 100.0, 10):
        np.testing.assert_allclose(scaled.controller(s), plain.controller(s) @ np.linalg.inv(M) / N, rtol=1e-5)


def several(inputs: int, outputs: int, *, discrete: bool) -> Any:
    """A stable plant of several inputs and outputs with a pole for each pair, every axis a little of each."""
    rng = np.random.default_rng(inputs + 10 * outputs)
    n = max(inputs, outputs) + 1
    A = -np.diag(rng.uniform(2.0, 6.0, n)) + 0.3 * rng.standard_normal((n, n))
    B, C = rng.standard_normal((n, inputs)), rng.standard_normal((outputs, n))
    plant = control.StateSpace(A, B, C, np.zeros((outputs, inputs)), 0)
    return control.sample_system(plant, TS) if discrete else plant


SIZES = [(2, 2, True), (2, 2, False), (3, 2, True), (1, 2, False), (3, 1, False)]


@pytest.mark.parametrize(("inputs", "outputs", "discrete"), SIZES)
def test_mixsyn_of_any_size_equals_slycot(inputs: int, outputs: int, discrete: bool) -> None:
    plant = several(inputs, outputs, discrete=discrete)
    W1, W3 = makeweight(20.0, 1.0, 0.5), makeweight(0.3, 20.0, 5.0)
    ours, theirs = (synthesis(plant, W1, 0.5, W3) for synthesis in (mixsyn, mixsyn_by_slycot))
    # Both searches end within 1e-4 of the least gamma.
    assert ours.gamma == pytest.approx(theirs.gamma, rel=3e-4)
    K = ours.controller
    assert (K.ninputs, K.noutputs, K.dt) == (outputs, inputs, plant.dt)
    closed: Any = control.feedback(plant * K, control.ss([], [], [], np.eye(outputs), plant.dt))  # pyright: ignore[reportArgumentType]
    poles = np.linalg.eigvals(closed.A)
    assert np.all(np.abs(poles) < 1.0) if discrete else np.all(poles.real < 0.0)


def test_mixsyn_of_two_plants_side_by_side_is_that_of_the_worse_one() -> None:
    """gamma of a diagonal problem is the larger of both: what is between the axes is nothing."""
    one, two = LAG, control.TransferFunction([2.0], [0.05, 1.0])
    W1 = makeweight(20.0, 1.0, 0.5)
    apart = [mixsyn(plant, W1, 0.2).gamma for plant in (one, two)]
    both = mixsyn(control.append(control.ss(one), control.ss(two)), W1, 0.2)
    assert both.gamma == pytest.approx(max(apart), rel=3e-4)


def test_weights_of_another_size_are_refused_in_a_line() -> None:
    plant = several(2, 2, discrete=False)
    wide = control.append(LAG, LAG, LAG)
    with pytest.raises(SettingsError, match="W1 must have 2 inputs, or one input and one output; got 3 and 3"):
        mixsyn(plant, wide, 0.2)
