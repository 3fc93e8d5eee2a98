"""The virtual neck obeys mechanics: energy, statics, symmetry, convergence, and stays finite."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._mechanics_runtime import NeckBody, neck_constants, neck_load, neck_rates, neck_substeps
from softneck.plant._neck_runtime import VirtualNeckArrays
from softneck.runtime import Block, State

from ..oracles.neck_energy import body, free_lengths, neck_energy, potential_energy

# Where the plant's outputs are in its port order.
TENSIONS = slice(10, 13)
# And the parts of its state.
AT = NeckBody.parts(VirtualNeckArrays(VirtualNeck(NeckParameters.paper()).block().arrays))
MOVING = slice(0, AT["free"].start)


def quiet(**changes: float) -> NeckParameters:
    """A symmetric neck with a perfect sensor."""
    straight = {"stiffness_asymmetry": 0.0, "rest_pitch": 0.0, "rest_roll": 0.0, "encoder_counts": 0.0}
    return NeckParameters.paper().without_noise().replace(**{**straight, **changes})


def inputs(rows: int, motors: np.ndarray | tuple[float, float, float], payload: float = 0.0) -> np.ndarray:
    U = np.zeros((rows, 8))
    U[:, :3], U[:, 3] = motors, payload
    return U


@pytest.mark.slow
def test_energy_never_rises_when_the_neck_is_let_go() -> None:
    block = VirtualNeck(quiet()).block(sample_time=0.001)
    # Tendons paid out: nothing actuates. A push leans the neck, and lets go.
    slack, _ = block.run(block.initial_state(), inputs(2000, (-6.0, -6.0, -6.0)))
    U = inputs(1000, (-6.0, -6.0, -6.0))
    U[:, 4], U[:, 5] = 4.0, -1.5
    state, Y = block.run(slack, U)
    assert np.hypot(*Y[-1, :2]) > 0.15
    assert not Y[-1, TENSIONS].any()
    energies = [neck_energy(state).total]
    for _ in range(1500):
        state, y = block.step(state, U[0] * [1, 1, 1, 1, 0, 0, 1, 1])
        assert not y[TENSIONS].any()
        energies.append(neck_energy(state).total)
    # Rounding of sums of about 1 J.
    assert np.diff(energies).max() < 1e-13
    assert energies[0] - energies[-1] > 1e-3


def test_the_gain_goes_with_the_winch_and_hardly_with_the_bending_stiffness() -> None:
    """Tendons prescribe lengths: stiffness counts by how far they stretch; docs/tutorials/design_study.md says so."""
    block = VirtualNeck(NeckParameters.paper().without_noise()).block()

    def gain(**changes: float) -> float:
        _, Y = block.run(block.initial_state(**changes), inputs(400, (4.0 / 3.0, -2.0 / 3.0, -2.0 / 3.0)))
        return (Y[-1, 0] - Y[0, 0]) / 2.0

    # The sine of a tilt of 12 deg, and friction of the tendons.
    assert gain(winch_radius=0.009) / gain(winch_radius=0.006) == pytest.approx(1.5, rel=0.02)
    assert gain(bending_stiffness=0.8) / gain(bending_stiffness=0.45) == pytest.approx(1.0 - 0.047, abs=0.005)


@pytest.mark.parametrize("payload", [0.0, 1.0])
def test_energy_never_rises_with_locked_winches(payload: float) -> None:
    block = VirtualNeck(quiet()).block()
    start, _ = block.run(block.initial_state(), inputs(200, (1.5, -0.5, 0.4)))
    c, load = neck_constants(start.parameters), neck_load(start.parameters, payload, 0.0, 0.0, 0.0, 0.0)
    free = tuple(free_lengths(start).tolist())
    drives = slice(AT["position"].start, AT["integral"].stop)

    def locked(_: float, x: np.ndarray) -> np.ndarray:
        dx = np.array(neck_rates(tuple(x.tolist()), (0.0, 0.0, 0.0), free, c, load))
        dx[drives] = 0.0
        return dx

    x0 = start.values[MOVING].copy()
    x0[0:2] += 0.15
    x0[5] = 0.3
    x0[11:14] = 0.0
    solution = solve_ivp(locked, (0.0, 0.4), x0, method="LSODA", rtol=1e-9, atol=1e-12, max_step=1e-3)
    values = [np.concatenate([x, start.values[MOVING.stop :]]) for x in solution.y.T]
    E = [neck_energy(State(v, start.parameters, start.outputs), payload=payload).total for v in values]
    # The integrator's tolerance, 1e-9 of about 1 J per step.
    assert np.diff(E).max() < 2e-9
    assert E[0] - E[-1] > 1e-3


@pytest.mark.parametrize("payload", [0.0, 1.0])
@pytest.mark.parametrize(
    "motors", [(0.0, 0.0, 0.0), (2.0, -1.0, -1.0), (3.0, 0.0, 0.0), (0.8, 1.9, -1.2), (-1.0, -1.5, -0.5)]
)
def test_statics_are_the_minimum_of_potential_energy(motors: tuple[float, float, float], payload: float) -> None:
    # Hysteresis remembers how the neck got here, so it is off; friction vanishes with speed.
    # The link is stiff enough to carry 1 kg by itself: a buckled neck has many minima.
    parameters = quiet(
        hysteresis_torque=0.0, gear_friction=0.0, rest_pitch=0.02, stiffness_asymmetry=0.1, stiffness_angle=0.4,
        bending_stiffness=1.2,
    )  # fmt: skip
    block = VirtualNeck(parameters).block()
    state, Y = block.run(block.initial_state(), inputs(1000, motors, payload))
    x = body(state)
    positions, free = x["position"], x["free"]
    found = minimize(
        lambda q: potential_energy(parameters, q * [1, 1, 0.01], positions, free, payload=payload),
        np.zeros(3),
        method="BFGS",
        options={"gtol": 1e-9, "xrtol": 1e-12},
    )
    # BFGS by differences finds the minimum to about sqrt(eps) of 0.3 rad, and 20 s settle to 1e-7.
    np.testing.assert_allclose([*x["b"], *x["s"]], found.x * [1, 1, 0.01], atol=3e-6)
    assert Y[-1, 13] == x["s"]


def test_a_third_of_a_turn_turns_the_answer() -> None:
    # The link's stiffer plane, which is not one of symmetry, turns with it.
    block = VirtualNeck(quiet(stiffness_asymmetry=0.3, stiffness_angle=0.2)).block()
    turned = VirtualNeck(quiet(stiffness_asymmetry=0.3, stiffness_angle=0.2 + 2 * np.pi / 3)).block()
    rng = np.random.default_rng(3)
    t = np.arange(300) * 0.02
    motors = np.column_stack(
        [2.0 * np.sin(w * t + f) for w, f in zip((1.0, 2.3, 3.1), rng.uniform(0, 6, 3), strict=True)]
    )
    _, here = block.run(block.initial_state(), inputs(300, motors))
    _, there = turned.run(turned.initial_state(), inputs(300, np.roll(motors, 1, axis=1)))
    # Normals, not angles: pitch and roll are projections and do not turn linearly.
    turn = np.array([[np.cos(a := 2 * np.pi / 3), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    # Rounding, grown by the chatter of tendons between slack and taut.
    np.testing.assert_allclose(_normals(here[:, :2]) @ turn.T, _normals(there[:, :2]), atol=1e-9)
    np.testing.assert_allclose(np.roll(here[:, TENSIONS], 1, axis=1), there[:, TENSIONS], atol=1e-7)


def _normals(angles: np.ndarray) -> np.ndarray:
    n = np.column_stack([np.tan(angles), np.ones(len(angles))])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def smooth_run(substeps: int) -> np.ndarray:
    """End state of a manoeuvre without slack, wall or limits, at 20 ms / `substeps`."""
    block = smooth_block(0.02 / substeps)
    return block.run(block.initial_state(), smooth_inputs())[0].values[MOVING]


def smooth_block(step: float) -> Block:
    # Pretension keeps the tendons taut; slow smoothing speeds make friction smooth on the scale of a step.
    parameters = quiet(pretension=3.0, guide_speed=0.1, gear_friction=0.0, speed_bandwidth=60.0, hysteresis_torque=0.0)
    return VirtualNeck(parameters.replace(drive_latency=0.0)).block(internal_step=step)


def smooth_inputs() -> np.ndarray:
    t = np.arange(20) * 0.02
    return inputs(20, np.column_stack([0.05 * np.sin(3 * t), 0.04 * t, -0.05 * t]))


def test_halving_the_step_converges_at_order_four() -> None:
    exact = smooth_run(320)
    errors = [np.abs(smooth_run(n) - exact).max() for n in (20, 40, 80)]
    # Order 4 divides the error by 16; the modes at the edge of the step's reach leave 10 to 24.
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert ((ratios > 10) & (ratios < 24)).all(), (errors, ratios)


def test_the_integrator_agrees_with_scipy_on_a_smooth_manoeuvre() -> None:
    block = smooth_block(0.001)
    state = block.initial_state()
    c = neck_constants(state.parameters)
    load = neck_load(state.parameters, 0.0, 0.0, 0.0, 0.0, 0.0)
    free = tuple(free_lengths(state).tolist())
    x = state.values[MOVING].copy()
    for u in smooth_inputs():
        command = tuple(u[:3].tolist())
        solution = solve_ivp(
            lambda _, x, command=command: neck_rates(tuple(x.tolist()), command, free, c, load),
            (0.0, 0.02), x, method="DOP853", rtol=1e-9, atol=1e-12,
        )  # fmt: skip
        x = solution.y[:, -1]
    mine = smooth_run(20)
    # Angles to 1e-8 rad, a hundred-thousandth of the smallest noise; the fastest states are speeds.
    for name in ("b", "s", "position", "filtered"):
        np.testing.assert_allclose(mine[AT[name]], x[AT[name]], atol=1e-8)
    np.testing.assert_allclose(mine, x, atol=1e-5)


STIFF = {
    "high tension": ({"pretension": 10.0, "tendon_stiffness": 5e4, "bending_stiffness": 3.0}, (3.0, 3.0, 3.0), 0.0),
    "full compression": ({"axial_stiffness": 60.0, "compression_limit": 0.01}, (6.0, 6.0, 6.0), 0.0),
    "steps of 6 rad": ({}, (6.0, -6.0, -6.0), 0.0),
    "steps of 6 rad, strong drives": ({"current_limit": 0.144, "position_gain": 100.0}, (6.0, 6.0, -6.0), 0.0),
    "1 kg": ({}, (2.0, -1.0, -1.0), 1.0),
    "stiff tendons, light platform": ({"tendon_stiffness": 2e5, "platform_mass": 0.02}, (6.0, -6.0, 0.0), 0.0),
    "heavy damping": ({"bending_damping": 10.0, "tendon_damping": 500.0}, (4.0, -2.0, -2.0), 1.0),
    "fast friction": ({"guide_friction": 0.5, "guide_speed": 5e-4}, (4.0, -2.0, -2.0), 0.0),
}


@pytest.mark.parametrize("name", STIFF)
def test_stiff_cases_stay_finite_and_tendons_never_push(name: str) -> None:
    changes, motors, payload = STIFF[name]
    block = VirtualNeck(quiet(**changes)).block()
    U = np.vstack([inputs(60, motors, payload), inputs(60, tuple(-m for m in motors), payload), inputs(60, motors)])
    _, Y = block.run(block.initial_state(), U)
    assert np.isfinite(Y).all()
    assert Y[:, TENSIONS].min() >= 0.0
    assert np.abs(Y[:, :2]).max() < np.pi / 2
    assert Y[:, 13].max() < block_limit(block) + 0.02


def block_limit(block: Block) -> float:
    return next(port.start for port in block.parameters if port.name == "compression_limit")


def test_stiff_necks_take_more_substeps_and_soft_ones_do_not() -> None:
    def count(parameters: NeckParameters) -> int:
        q = np.append(parameters.vector(), 0.0)
        return neck_substeps(neck_constants(q), neck_load(q, 0.0, 0.0, 0.0, 0.0, 0.0), 0.02, 20)

    assert count(NeckParameters.paper()) == count(NeckParameters.lab()) == 20
    assert count(quiet(tendon_stiffness=2e5)) > 30


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    U = inputs(200, (1.0, 0.0, -1.0))
    runs = []
    for seed in (5, 5, 6):
        block = VirtualNeck(NeckParameters.paper()).block(noise_seed=seed)
        runs.append(block.run(block.initial_state(), U)[1])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0][:, 2] != runs[2][:, 2]).all()
    # The seed moves the sensor, never the neck.
    np.testing.assert_array_equal(runs[0][:, :2], runs[2][:, :2])
