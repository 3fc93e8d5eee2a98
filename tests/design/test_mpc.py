"""Predictive control: optimal, within its limits, without offset or bumps."""

from __future__ import annotations

import math
from dataclasses import replace

import control
import daqp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from softneck.core import DataError, FileFormatError
from softneck.design import MpcController, MpcSettings
from softneck.design.plants._uncertain import uncertain_plant
from softneck.design.predictive import _mpc_state_runtime as rt
from softneck.design.predictive._plant import scaled_plant
from softneck.design.predictive._settings import MpcNumbers
from softneck.loop import BlockPart, Loop, run_loop
from softneck.loop._references import AheadReference
from softneck.runtime import load_functions, load_runtime

from ..oracles.bake_off import bake_off_neck
from ..references import RotationReference
from .mpc_neck import GAIN, POLE, TS, Neck


@pytest.fixture(scope="module")
def plain() -> MpcController:
    return MpcSettings(bandwidth=8.0).design(bake_off_neck())


@pytest.fixture(scope="module")
def soft() -> MpcController:
    settings = MpcSettings(bandwidth=8.0, angle_limit=0.3, minimum_tautness=-0.25, lead_limit=12.0)
    return settings.design(bake_off_neck())


def thetas(controller: MpcController, count: int, size: float = 0.15) -> np.ndarray:
    """Return (count, n_theta) random parameters, motors anywhere within their limits."""
    rng = np.random.default_rng(5)
    values = size * rng.standard_normal((count, named(controller).K.shape[1]))
    values[:, -5:-2] = rng.uniform(-5.9, 5.9, (count, 3))
    values[:, -2], values[:, -1] = rng.uniform(-1.0, 1.0, count), 1.0
    return values


def named(controller: MpcController) -> rt.MpcArrays:
    return rt.MpcArrays(controller.arrays)


def remembered(neck: Neck, name: str) -> float:
    """Return one number of what the controller remembers."""
    return neck.state.values[rt.MpcState.parts(named(neck.controller))[name]].item()


def bounds(controller: MpcController, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    parameters = controller.initial_state().parameters
    lower, upper = np.empty(len(named(controller).kinds)), np.empty(len(named(controller).kinds))
    functions = load_functions(controller.block().runtime)
    functions.mpc_bounds(controller.arrays, parameters, theta[-5:-2].copy(), theta, lower, upper)
    return lower, upper


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "soft"])
def test_the_runtimes_solver_equals_daqp(kind: str, request: pytest.FixtureRequest) -> None:
    controller: MpcController = request.getfixturevalue(kind)
    f = load_functions("softneck.design.predictive._dual_runtime")
    a = named(controller)
    m = len(a.kinds)
    sign, lam, most = np.zeros(m), np.zeros(m), 0
    for theta in thetas(controller, 150):
        low, high = bounds(controller, theta)
        z0 = a.K @ theta
        assert f.qp_solve(a.G, a.A @ z0, low, high, sign, lam, 500, 1e-10, z0.size) >= 0
        z = z0 - lam @ a.AH
        expected, _, flag, _ = daqp.solve(a.H, a.F @ theta, a.A, high, low, np.zeros(m, dtype=np.int32))
        assert flag > 0
        # daqp's own tolerance is 1e-6 on rows of size 1e-3 to 1; both are far better at their vertices.
        np.testing.assert_allclose(z, expected, atol=1e-8)
        most = max(most, int((lam != 0.0).sum()))
    assert most > 10  # limits were active


@pytest.mark.slow
def test_without_limits_and_blocking_it_is_the_lqr(plain: MpcController) -> None:
    settings = MpcNumbers(bandwidth=8.0, moves=30)
    plant = scaled_plant(uncertain_plant(bake_off_neck()))
    resolved = settings.fill_defaults(plant)
    problem, controller = resolved.problem(plant, 8.0), settings.design(bake_off_neck())
    assert resolved.starts == tuple(range(30))
    T, w = problem.T, problem.move_weight
    A, B, Q = np.eye(5), np.zeros((5, 3)), np.zeros((5, 5))
    A[:2, :2], A[:2, 2:] = POLE * np.eye(2), GAIN * (1.0 - POLE) * T[:2]
    B[:2], B[2:] = A[:2, 2:], np.eye(3)
    Q[:2, :2], Q[2:, 2:] = np.diag(problem.output_weight), problem.cocontraction_weight * np.outer(T[2], T[2])
    P = solve_discrete_are(A, B, Q, w * np.eye(3))
    K = np.linalg.solve(w * np.eye(3) + B.T @ P @ B, B.T @ P @ A)
    gain = named(controller).K
    theta = np.zeros(gain.shape[1])
    theta[:2], theta[-5:-2] = (0.1, -0.2), (0.3, -0.1, 0.5)
    state = np.concatenate([theta[:2], theta[-5:-2]])
    # Thirty steps of a Riccati recursion from its own solution, and a 90 x 90 inverse.
    np.testing.assert_allclose((gain @ theta)[:3], -K @ state, atol=1e-9)


def test_to_lti_is_the_block_while_no_limit_is_active(plain: MpcController) -> None:
    system = plain.to_lti()
    assert system.input_labels == ["pitch_reference", "roll_reference", "pitch", "roll"]
    assert system.output_labels == ["theta_i", "phi_i"]
    rng = np.random.default_rng(3)
    u = 1e-4 * rng.standard_normal((60, 4))
    u[0] = 0.0  # the first sample aligns the state: at rest
    expected = control.forced_response(system, np.arange(60) * TS, u.T).outputs  # pyright: ignore[reportArgumentType]
    state = plain.initial_state()
    motors = np.zeros(3)
    for k in range(60):
        state, motors = plain.step(state, [u[k, 0], u[k, 1], 0.0, u[k, 2], u[k, 3], *motors, 1.0, 1.0])
        # Unit vectors of 1e-3 through sums of 100: 1e-13 relative.
        np.testing.assert_allclose((named(plain).T @ motors)[:2], expected[:, k], atol=1e-12)


@pytest.mark.parametrize(("gain", "load"), [(0.7, 0.0), (1.3, 0.4), (1.0, -0.8)])
def test_no_offset_is_left_by_another_gain_or_a_load(plain: MpcController, gain: float, load: float) -> None:
    neck = Neck(plain, gain=gain, load=load)
    for _ in range(500):
        neck.step(0.15, -0.1)
    np.testing.assert_allclose(neck.y, [0.15, -0.1], atol=1e-5)  # ten seconds at more than 1 rad/s
    assert remembered(neck, "status") == rt.MPC_OPTIMAL


def test_it_takes_over_without_a_bump(plain: MpcController) -> None:
    motors = np.array([1.2, -0.3, 0.4])
    state, out = plain.step(plain.initial_state(), [0.11, -0.05, motors.mean(), 0.11, -0.05, *motors, 1.0, 1.0])
    # The neck is where it is wanted, its motors as well: nothing to do but rounding.
    np.testing.assert_allclose(out, motors, atol=1e-9)
    held, out = plain.step(state, [0.4, 0.0, 0.0, 0.11, -0.05, *motors, 1.0, 0.0])
    np.testing.assert_array_equal(out, state.outputs)  # disabled: held
    assert plain.info(held).status == "holding"


def test_limits_are_kept_and_reported(soft: MpcController) -> None:
    neck, seen, highest = Neck(soft), set(), 0.0
    before = neck.motors
    for k in range(300):
        out = neck.step(0.8 if k < 150 else -0.8, 0.8, cocontraction_reference=3.0)
        assert np.abs(out).max() <= 6.0
        assert np.abs(out - before).max() <= 12.5 * TS + 1e-12
        before = out
        highest = max(highest, float(np.abs(neck.y).max()))
        seen |= {line.split()[0] for line in soft.info(neck.state).active}
    assert {"slew", "angle"} <= seen
    # Soft, and looked at one time constant of the loop ahead: before that the neck may pass it by a degree.
    assert highest <= 0.3 + 0.02
    assert highest < 0.5 * 0.8
    assert remembered(neck, "residual") < 1e-8


def test_a_limit_that_cannot_be_kept_is_softened_and_counted(soft: MpcController) -> None:
    neck = Neck(soft)
    neck.y = np.array([0.6, 0.0])  # beyond the limit of 0.3 rad already
    neck.step(0.0)
    assert soft.info(neck.state).status == "softened"
    assert remembered(neck, "softened") == 1.0
    assert np.isfinite(neck.motors).all()


def test_tendons_stay_taut(soft: MpcController) -> None:
    least = []
    for controller in (soft, MpcSettings(bandwidth=8.0, lead_limit=12.0).design(bake_off_neck())):
        neck = Neck(controller)
        lever = 6.93 * named(controller).T[:2].T
        for _ in range(150):
            neck.step(0.28, 0.0, cocontraction_reference=-0.5)
        least.append((neck.motors - lever @ neck.y).min())
    assert least[0] > -0.25 - 1e-2  # soft: within the price of its slack
    assert least[1] < -0.4  # without the limit co-contraction goes where it was asked


@pytest.mark.slow
def test_out_of_iterations_the_previous_plan_goes_on_and_is_counted() -> None:
    full = MpcSettings(bandwidth=8.0, lead_limit=12.0).design(bake_off_neck())
    short = replace(full, arrays=tuple(array.copy() for array in full.arrays))
    rt.MpcArrays(short.arrays).constants[rt.MPC_BUDGET] = 1
    neck, before = Neck(short), np.zeros(3)
    for k in range(200):
        out = neck.step(0.3 if k % 50 < 25 else -0.3)
        assert np.abs(out - before).max() <= 12.5 * TS + 1e-12
        before = out
    assert remembered(neck, "shifted") > 0
    assert remembered(Neck(full), "shifted") == 0
    # Age counts up the plan: without answers its moves come one after another.
    state = full.initial_state()
    state, _ = full.step(state, [0.05, 0, 0, 0, 0, 0, 0, 0, 1, 1])
    plan = full.info(state).set_points
    starved = tuple(array.copy() for array in full.arrays)
    rt.MpcArrays(starved).constants[[rt.MPC_BUDGET, rt.MPC_TOLERANCE]] = 0, -1.0
    out = np.zeros(3)
    step, values = load_runtime(full.block().runtime).step, state.values.copy()
    for i in range(3):
        inputs = np.array([0.05, 0, 0, 0, 0, *out, 1, 1])
        step(starved, np.array([6.0, 12.5, 12.0, -6.0]), values, inputs, out)
        np.testing.assert_allclose(out, plan[i], atol=1e-12)
    assert values[rt.MpcState.parts(named(full))["shifted"]] == 3


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 57.0])
def test_a_bad_measurement_never_reaches_the_solver(plain: MpcController, bad: float) -> None:
    neck, clean = Neck(plain), Neck(plain)
    for k in range(100):
        clean.step(0.15)
        y = neck.y
        if 10 <= k < 20:
            neck.y = np.array([bad, y[1]])
            neck.step(0.15)
            neck.y = POLE * y + (1.0 - POLE) * GAIN * neck.line[0]
        else:
            neck.step(0.15)
        assert np.isfinite(neck.state.values).all()
    # The model is the plant: what it says meanwhile is as good as the measurement.
    np.testing.assert_allclose(neck.y, clean.y, atol=1e-6)
    for _ in range(60):
        neck.y = np.array([bad, 0.0])
        neck.step(0.3)
    assert plain.info(neck.state).status == "holding"


def test_other_inputs_that_are_not_finite_leave_what_was(plain: MpcController) -> None:
    neck = Neck(plain)
    for _ in range(5):
        neck.step(0.1)
    neck.step(math.nan, math.nan, cocontraction_reference=math.nan)
    assert np.isfinite(neck.state.values).all()
    neck.step(0.1, 0.0, motor_position_1=math.nan)
    assert np.isfinite(neck.state.values).all()
    with pytest.raises(DataError, match="input `pitch` of mpc is nan"):
        plain.step(neck.state, [0.1, 0, 0, math.nan, 0, 0, 0, 0, 1, 1])


@pytest.mark.slow
def test_what_is_known_ahead_is_followed_without_lag() -> None:
    reference = RotationReference(inclination=0.2, frequency=0.19, rise=1.0)
    errors = []
    for preview in (0.0, 0.5):
        controller = MpcNumbers(bandwidth=8.0, preview=preview, reference_time=0.1, lead_limit=12.0).design(
            bake_off_neck()
        )
        neck, error = Neck(controller), 0.0
        for k in range(400):
            ahead = dict(
                zip(("pitch_reference_ahead", "roll_reference_ahead"), reference(k * TS + preview), strict=False)
            )
            neck.step(*reference(k * TS)[:2], **(ahead if preview else {}))
            if k > 200:
                error = max(error, float(np.abs(neck.y - np.array(reference((k + 1) * TS)[:2])).max()))
        errors.append(error)
    assert errors[1] < 0.1 * errors[0]


def test_a_loop_gives_the_reference_ahead() -> None:
    from softneck.plant import NeckParameters, VirtualNeck

    controller = MpcSettings(bandwidth=6.0, preview=0.4).design(bake_off_neck())
    reference = RotationReference(inclination=0.1)
    loop = Loop(
        plant=BlockPart(VirtualNeck(NeckParameters.paper()).block()), controller=controller.part(),
        reference=AheadReference(reference, controller.preview), duration=0.4,
    )  # fmt: skip
    result = run_loop(loop)
    # The same function of time, read twenty samples later.
    np.testing.assert_allclose(
        result.signals["pitch_reference_ahead"], [reference(k * TS + 0.4)[0] for k in range(20)], atol=1e-15
    )


def test_the_part_tells_what_each_sample_decided(soft: MpcController) -> None:
    part, out = soft.part(), np.zeros(3)
    np.testing.assert_array_equal(part.start(0.0, {}), out)
    rng = np.random.default_rng(2)
    for k in range(80):
        u = np.array([0.5 * math.sin(0.1 * k), 0.2, 0.3, *(0.05 * rng.standard_normal(2)), *out, 1.0, 1.0])
        out = part.advance(k * TS, u)
    info = part.info
    assert info.status in ("optimal", "softened")
    assert part.took > 0.0
    assert info.previous_plan == 0
    assert info.set_points.shape == (30, 3)
    assert info.angles.shape == info.reference.shape == (30, 2)


def test_what_is_predicted_comes_true(plain: MpcController) -> None:
    neck = Neck(plain)
    for _ in range(20):
        neck.step(0.15, 0.05)
    # Rest of the plan: without limits, blocking or news each sample's plan is the rest of the one before.
    info = plain.info(neck.state)
    came = []
    for _ in range(9):
        neck.step(0.15, 0.05)
        came.append(neck.y)
    # Five samples of it are decided already; blocking lets the next ones differ a little.
    np.testing.assert_allclose(came[4:7], info.angles[:3], atol=5e-4)


def test_its_state_is_whole(plain: MpcController) -> None:
    one, two = BlockPart(plain.block()), BlockPart(plain.block())
    rng = np.random.default_rng(4)
    rows = 0.3 * rng.standard_normal((40, 10))
    rows[:, 8:] = 1.0
    one.start(0.0, {})
    two.start(0.0, {})
    for u in rows[:20]:
        one.advance(0.0, u)
    for mine, its in zip(two.memory, one.memory, strict=True):
        mine[:] = its
    for u in rows[20:]:
        np.testing.assert_array_equal(one.advance(0.0, u), two.advance(0.0, u))


def test_a_damaged_file_says_which_array_is_wrong(plain: MpcController) -> None:
    arrays = dict(zip(rt.MpcArrays.names(), plain.arrays, strict=True))
    with pytest.raises(FileFormatError, match=r"`K` has shape \(30, \d+\); \(30, \d+\) is needed"):
        MpcController.from_archive({}, arrays | {"K": arrays["K"][:, 1:]})
    with pytest.raises(FileFormatError, match="not finite"):
        MpcController.from_archive({}, arrays | {"constants": np.full(17, np.nan)})
