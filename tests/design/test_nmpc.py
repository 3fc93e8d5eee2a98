from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import daqp
import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load
from softneck.design import NmpcController, NmpcSettings
from softneck.design.predictive._nmpc import NmpcNumbers
from softneck.design.predictive._nmpc_problem import SLACK_WEIGHT, NonlinearProblem, disturbance_ahead, estimate_gains
from softneck.design.predictive._nmpc_state_runtime import NmpcArrays, NmpcState
from softneck.design.predictive._plant import TAUTNESS_LEVER
from softneck.estimation import LinearNeck
from softneck.identification import GreyBox, Model, Network, Play, Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import State, load_functions, load_runtime
from softneck.signals import Recording, signal

from ..data import ROOT, slow_but

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=1).rows(0, 2000)


@pytest.fixture(scope="module")
def network(recording: Recording) -> Model:
    return Network(hidden=(6, 6), iterations=30).fit(recording)


@pytest.fixture(scope="module")
def models(recording: Recording, network: Model) -> dict[str, Model]:
    return {
        "nn": network,
        "play": Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(recording),
        "greybox": GreyBox(evaluations=3, sensor_delay=2).fit(recording),
    }


@pytest.fixture(scope="module")
def controller(network: Model) -> NmpcController:
    return NmpcSettings(horizon=12, moves=4, lead_limit=12.0).design(network)


def closed_loop(
    controller: NmpcController, plant: Model, rows: int, pitch: float, *, load_at: int = 10**9, load: float = 0.0
) -> tuple[np.ndarray, list[str]]:
    """Return pitch and roll (rows, 2), the plant's free run plus a load on the angles, and what each sample said."""
    block, state = plant.block(), controller.initial_state()
    x, angles, said = block.initial_state(use_measurement=0.0), [], []
    motors, y = np.zeros(3), block.initial_state().outputs[:2]
    for k in range(rows):
        seen = y + (load if k >= load_at else 0.0)
        state, motors = controller.step(state, [pitch, 0.0, 0.0, *seen, *motors, 1.0, 1.0])
        said.append(controller.info(state).status)
        x, out = block.step(x, [*motors, *[math.nan] * 5])
        y = out[:2]
        angles.append(y + (load if k + 1 >= load_at else 0.0))
    return np.array(angles), said


def named(controller: NmpcController, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parts of a controller's state by their names."""
    parts = NmpcState.parts(NmpcArrays(controller.block().arrays))
    return {name: values[place] for name, place in parts.items()}


@dataclass(frozen=True)
class Asked:
    """What a sample is asked, where it decides: the problem's numbers, and the bounds of moves and positions."""

    x: np.ndarray
    held: np.ndarray
    plan: np.ndarray
    target: np.ndarray
    moves: np.ndarray
    common: float
    low: np.ndarray
    high: np.ndarray
    least: np.ndarray
    most: np.ndarray


def asked(controller: NmpcController, p: NonlinearProblem, state: State, u: list[float]) -> Asked:
    """Return what `controller.step(state, u)` is asked; bounds and what is missed are worked out here once more."""
    block = controller.block()
    s: Any = controller.settings
    f, q = load_functions(block.runtime, compiled=False), state.parameters
    found: list[np.ndarray] = []
    decide = f.nmpc_decide
    vars(f)["nmpc_decide"] = lambda _, __, values, ___: found.append(values.copy())
    f.step(block.arrays, q, state.values.copy(), np.array(u), np.zeros(3))
    vars(f)["nmpc_decide"] = decide
    values = found[0]
    x = named(controller, values)
    target, moves = np.empty(2 * s.horizon), np.empty(3 * len(p.starts))
    f.nmpc_asked(block.arrays, values, target, moves)
    target -= missing(controller, values)
    held, b = x["held"], len(p.starts)
    step = q[1] * controller.sample_time
    low, high = np.full(moves.size, -step), np.full(moves.size, step)
    low[:3] = np.clip(np.array(u[5:8]) - q[2] - held, -step, step)
    high[:3] = np.clip(np.array(u[5:8]) + q[2] - held, low[:3], step)
    least = np.minimum(max(-q[0], q[3]), held + high[:3]) - held
    most = np.maximum(q[0], held + low[:3]) - held
    common = float(x["filtered"][2])
    return Asked(x["model"], held, x["plan"], target, moves, common, low, high, np.tile(least, b),
                 np.tile(most, b))  # fmt: skip


def sums_of(starts: tuple[int, ...]) -> np.ndarray:
    """Return the positions after each move, of the moves."""
    return np.kron(np.tril(np.ones((len(starts), len(starts)))), np.eye(3))


def spread(p: NonlinearProblem) -> np.ndarray:
    """Return (3 N, nz): which moves make the set-points of each sample."""
    rows = np.array([[float(start <= i) for start in p.starts] for i in range(p.horizon)])
    return np.kron(rows, np.eye(3))


def answers(controller: NmpcController, p: NonlinearProblem, a: Asked, z: np.ndarray) -> np.ndarray:
    """Return the angles (2 N,) that the model itself makes of the plan `z`."""
    plant = controller.model.block()
    rows = np.full((p.horizon, 8), np.nan)
    rows[:, :3] = a.held + (spread(p) @ z).reshape(-1, 3)
    start = plant.initial_state(use_measurement=0.0)
    return plant.run(State(a.x, start.parameters, start.outputs), rows)[1][:, :2].ravel()


# Derivatives by differences and another solver: nothing of what the controller computes with.
@pytest.mark.usefixtures("plain_steps_of_blocks")
@pytest.mark.parametrize("kind", slow_but(["nn", "play"], ["nn"]))
@pytest.mark.parametrize("angle_limit", slow_but([None, 0.1], [0.1]))
def test_each_sample_is_the_quadratic_program_of_differences(
    kind: str, angle_limit: float | None, models: dict[str, Model]
) -> None:
    settings = NmpcSettings(horizon=12, moves=4, angle_limit=angle_limit)
    controller, plant = settings.design(models[kind]), models[kind].block()
    p, soft = controller.problem(), int(angle_limit is not None)
    nz = 3 * len(p.starts)
    state, motors = controller.initial_state(), np.zeros(3)
    x, y = plant.initial_state(use_measurement=0.0), np.zeros(2)
    rng, statuses = np.random.default_rng(0), set()
    for k in range(40):
        u = [*([0.3, -0.1, 0.3] if k < 20 else [-0.3, 0.2, 0.0]), *(y + 0.002 * rng.standard_normal(2)), *motors, 1, 1]
        a = asked(controller, p, state, u) if k % 2 else None
        state, motors = controller.step(state, u)
        statuses.add(controller.info(state).status)
        if a is not None:
            h = 1e-5
            columns = [(answers(controller, p, a, a.plan + d) - answers(controller, p, a, a.plan - d)) / (2.0 * h)
                       for d in h * np.eye(nz)]  # fmt: skip
            S, Y = np.array(columns).T, answers(controller, p, a, a.plan)
            w = p.weights.ravel()
            common = p.T[2] @ spread(p).reshape(p.horizon, 3, nz)
            H, f = np.zeros((nz + soft, nz + soft)), np.zeros(nz + soft)
            H[:nz, :nz] = 2.0 * (S.T * w @ S + p.move_weight * np.eye(nz))
            H[:nz, :nz] += 2.0 * p.cocontraction_weight * common.T @ common
            f[:nz] = 2.0 * (S.T * w @ (Y - a.target - S @ a.plan) - p.move_weight * a.moves)
            f[:nz] += 2.0 * p.cocontraction_weight * common.sum(axis=0) * (p.T[2] @ a.held - a.common)
            rows, low, high = np.zeros((nz, nz + soft)), [a.low, a.least], [a.high, a.most]
            rows[:, :nz] = sums_of(p.starts)
            if soft:
                weight = SLACK_WEIGHT * float(p.weights[0].max())
                H[-1, -1], f[-1] = 2.0 * weight, 0.1 * weight
                at = np.array([*p.starts[1:], p.horizon]) - 1
                at = np.concatenate([2 * at, 2 * at + 1])
                # What the model misses is in the target; the angles themselves are limited.
                free = (Y - S @ a.plan + missing(controller, state.values))[at]
                upper, lower = np.hstack([S[at], -np.ones((at.size, 1))]), np.hstack([S[at], np.ones((at.size, 1))])
                rows = np.vstack([rows, upper, lower])
                far = np.full(at.size, 1e30)
                low = [a.low, [0.0], a.least, -far, -angle_limit - free]  # type: ignore[operator]
                high = [a.high, [1e30], a.most, angle_limit - free, far]  # type: ignore[operator]
            z, _, flag, _ = daqp.solve(H, f, rows, np.concatenate(high), np.concatenate(low))
            assert flag > 0
            # Differences are right to 1e-9 where no corner is near, the two solvers to 1e-10.
            np.testing.assert_allclose(motors, a.held + z[:3], atol=1e-6)
        x, seen = plant.step(x, [*motors, *[math.nan] * 5])
        y = seen[:2]
    assert statuses <= {"optimal", "softened"}


def missing(controller: NmpcController, values: np.ndarray) -> np.ndarray:
    """Return what the model is expected to miss (2 N,), from what it missed so far."""
    arrays = NmpcArrays(controller.block().arrays)
    level, rate = arrays.gains @ named(controller, values)["missed"].reshape(-1, 2)
    return (np.outer(arrays.future[:, 0], level) + np.outer(arrays.future[:, 1], rate)).ravel()


@pytest.mark.slow
def test_the_block_that_numba_has_not_compiled_is_the_same(network: Model) -> None:
    block = NmpcSettings(horizon=6, moves=2, angle_limit=0.1).design(network).block()
    plain = load_runtime(block.runtime, compiled=False)
    state = block.initial_state()
    values, out = state.values.copy(), np.zeros(3)
    for _ in range(3):
        u = np.array([0.2, 0.1, 0.0, 0.0, 0.0, *out, 1.0, 1.0])
        plain.step(block.arrays, state.parameters, values, u, out)
        state, motors = block.step(state, u)
        # numpy's own products and tanh differ from compiled ones in their last bits.
        np.testing.assert_allclose(out, motors, atol=1e-9)


def test_a_bad_measurement_never_reaches_the_block_either(network: Model) -> None:
    block = NmpcSettings(horizon=6, moves=2).design(network).block()
    step, state = load_runtime(block.runtime).step, block.initial_state()
    values, out = state.values.copy(), np.zeros(3)
    for k in range(60):
        y = math.nan if k >= 20 else 0.0
        step(block.arrays, state.parameters, values, np.array([0.1, 0.0, 0.0, y, 0.0, *out, 1.0, 1.0]), out)
        assert np.isfinite(values).all()
        assert values[2] == (4.0 if k >= 45 else 1.0)


def test_it_reaches_the_reference_and_rejects_a_load(controller: NmpcController, network: Model) -> None:
    angles, said = closed_loop(controller, network, 220, 0.15, load_at=100, load=0.03)
    np.testing.assert_allclose(angles[95], [0.15, 0.0], atol=2e-3)
    np.testing.assert_allclose(angles[-1], [0.15, 0.0], atol=2e-3)
    assert set(said) == {"optimal"}


def test_limits_are_kept(network: Model) -> None:
    controller = NmpcSettings(horizon=12, moves=4, angle_limit=0.12).design(network)
    state, before = controller.initial_state(position_limit=1.5, slew_limit=5.0), np.zeros(3)
    block = network.block()
    x, y, highest = block.initial_state(use_measurement=0.0), np.zeros(2), 0.0
    for _ in range(80):
        state, motors = controller.step(state, [0.5, -0.5, 0.0, *y, *before, 1.0, 1.0])
        assert np.abs(motors).max() <= 1.5
        assert np.abs(motors - before).max() <= 0.1 + 1e-12
        before = motors
        x, out = block.step(x, [*motors, *[math.nan] * 5])
        y = out[:2]
        highest = max(highest, float(np.abs(y).max()))
    # Soft, and checked at the ends of the holds: a little of what a move makes between two of them.
    assert highest < 0.12 + 0.01


def test_a_constant_disturbance_is_found_and_carried_on() -> None:
    a, level, rate = 0.9, 0.05, -0.004
    path = [level]
    rates = [rate]
    for _ in range(20):
        path.append(path[-1] + rates[-1])
        rates.append(a * rates[-1])
    found = estimate_gains(a, 8) @ np.array(path[12:4:-1])
    np.testing.assert_allclose(found, [path[12], rates[12]], atol=1e-12)  # rounding of 8 sums
    np.testing.assert_allclose(disturbance_ahead(a, 8) @ found, path[13:21], atol=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 57.0])
def test_a_bad_measurement_never_reaches_the_solver(controller: NmpcController, bad: float) -> None:
    part = controller.part()
    motors = part.start(0.0, {})
    for k in range(60):
        y = [bad, 0.0] if k >= 20 else [0.0, 0.0]
        motors = part.advance(0.0, np.array([0.1, 0.0, 0.0, *y, *motors, 1.0, 1.0]))
        assert np.isfinite(part.memory[1]).all()
        assert part.info.status == ("holding" if k >= 45 else "optimal")
    with pytest.raises(DataError, match="must be finite"):
        controller.step(controller.initial_state(), [0.1, 0.0, 0.0, bad if bad != 57.0 else math.nan, *[0.0] * 6])


def test_its_state_is_whole(controller: NmpcController) -> None:
    one, two = controller.part(), controller.part()
    rng = np.random.default_rng(3)
    rows = 0.1 * rng.standard_normal((30, 10))
    rows[:, 8:] = 1.0
    one.start(0.0, {})
    for u in rows[:15]:
        one.advance(0.0, u)
    two.start(0.0, {})
    for mine, its in zip(two.memory, one.memory, strict=True):
        mine[:] = its
    for u in rows[15:]:
        np.testing.assert_array_equal(one.advance(0.0, u), two.advance(0.0, u))


def test_disabled_it_holds_and_takes_over_without_a_bump(controller: NmpcController) -> None:
    state, motors = controller.initial_state(), np.array([0.8, -0.2, -0.2])
    out = motors
    for _ in range(5):
        state, out = controller.step(state, [0.3, 0.0, 0.0, 0.05, 0.0, *motors, 1.0, 0.0])
        np.testing.assert_array_equal(out, motors)
    before = out
    filtered = named(controller, state.values)["filtered"]
    state, out = controller.step(state, [*filtered, 0.05, 0.0, *motors, 1.0, 1.0])
    # Asked for what is there: 1e-3 rad is what a model that was not quite at rest moves on by.
    np.testing.assert_allclose(out, before, atol=1e-3)


def test_saved_and_loaded_it_is_the_same(controller: NmpcController, tmp_path: Path) -> None:
    controller.save(tmp_path / "nmpc.npz")
    again = load(tmp_path / "nmpc.npz", role="controller")
    assert isinstance(again, NmpcController)
    assert again.summary() == controller.summary()
    u = [0.1, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]
    one, two = controller.step(controller.initial_state(), u), again.step(again.initial_state(), u)
    np.testing.assert_array_equal(one[1], two[1])


def test_what_it_cannot_use_is_refused(recording: Recording, controller: NmpcController) -> None:
    with pytest.raises(SettingsError, match=r"is over nn, play, greybox; got rls"):
        NmpcSettings().design(Rls().fit(recording))
    with pytest.raises(SettingsError, match="got LinearNeck"):
        NmpcSettings().design(LinearNeck(pitch=None, roll=None))  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="`horizon` must be"):
        NmpcSettings(horizon=0)
    with pytest.raises(SettingsError, match="`horizon` must be"):
        NmpcSettings(horizon=10.5)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="nmpc takes 10 inputs"):
        controller.step(controller.initial_state(), [0.1] * 7)
    with pytest.raises(SettingsError, match="is not a parameter of nmpc"):
        controller.initial_state(colour=1.0)


def test_the_loosest_tendon_gets_what_it_lacks(network: Model) -> None:
    """Asked to lean, the neck is co-contracted until the loosest tendon is as taut as was wished."""
    slack = []
    for wish in (None, 0.4):
        settings = NmpcNumbers(horizon=12, moves=4, lead_limit=12.0, minimum_tautness=wish, reference_time=0.0)
        controller = settings.design(network)
        state, motors = controller.initial_state(), np.zeros(3)
        for _ in range(80):
            y = named(controller, state.values)["angles"]
            state, motors = controller.step(state, [0.15, -0.05, 0.0, *y, *motors, 1.0, 1.0])
        T = NmpcArrays(controller.block().arrays).T
        slack.append(float((motors - TAUTNESS_LEVER * np.array([0.15, -0.05]) @ T[:2]).min()))
    assert slack[0] < 0.0
    # A wish with the weight of co-contraction: tilt and moves give way a little.
    assert slack[1] == pytest.approx(0.4, abs=0.05)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"horizon": 2, "moves": 1}, "`horizon` 2 samples end within the model's dead time"),
        ({"horizon": 100, "moves": 50}, "150 unknowns, and the solver takes at most 120 within a sample"),
        ({"preview": 60.0}, "`preview` 60 s is more than the 100 samples that are remembered"),
        ({"minimum_tautness": 20.0}, "`minimum_tautness` 20 rad and `position_limit` 6 rad contradict"),
    ],
)
def test_horizons_beyond_what_is_solved_are_refused(network: Model, settings: dict[str, Any], match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        NmpcSettings(**settings).design(network)


def test_a_rise_sets_filter_or_bandwidth(network: Model, tmp_path: Path) -> None:
    asked = NmpcSettings(rise_s=0.5, minimum_tautness=0.2).design(network)
    asked.save(tmp_path / "c.npz")
    assert load(tmp_path / "c.npz").settings == asked.settings
    both: Any = [NmpcSettings(rise_s=rise).design(network).settings for rise in (0.5, 0.1)]
    slow, fast = both
    lag = 1.0 / slow.bandwidth
    assert np.log(9.0) * np.hypot(lag, slow.reference_time) == pytest.approx(0.5)
    assert (fast.reference_time, fast.bandwidth) == (0.0, pytest.approx(np.log(9.0) / 0.1))


def test_what_the_observer_is_ahead_is_dead_time_that_nobody_sees(tmp_path: Path) -> None:
    """What a perfect predictor tells is a model whose sensor is two samples quicker."""
    late, less = load(ROOT / "tests" / "golden" / "greybox.npz"), NmpcNumbers(horizon=8, moves=2, lead_limit=12.0)
    delay, period = late.arrays["sensor"]
    sooner = replace(late, arrays={**late.arrays, "sensor": np.array([delay - 2.0, period])})
    # 50 ms are two whole samples.
    replace(less, look_ahead=0.05).design(late).save(tmp_path / "nmpc.npz")
    known, blind, found = load(tmp_path / "nmpc.npz"), less.design(late), {}
    for axis, values in blind.found.items():
        found[axis] = {**values, "delay": values["delay"] - 2}
    said = []
    for controller in (known, replace(less.design(sooner), found=found), blind):
        block, motors = controller.block(), np.zeros(3)
        f, state = load_functions(block.runtime, compiled=False), block.initial_state()
        x, rows = state.values.copy(), []
        for k in range(5):
            f.step(
                block.arrays, state.parameters, x, np.array([0.1, -0.05, 0.2, 0.01 * k, 0.0, *motors, 1.0, 1.0]), motors
            )
            rows.append(motors.copy())
        said.append(np.array(rows))
    # What is left of the model's way to rest, which it is two samples further on; moves are 0.25 rad.
    np.testing.assert_allclose(said[0], said[1], atol=1e-6)
    assert np.abs(said[2] - said[1]).max() > 1e-3
