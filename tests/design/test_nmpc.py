from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load
from softneck.design import NmpcController, NmpcSettings
from softneck.design.predictive._nmpc import NONLINEAR_KINDS
from softneck.design.predictive._nmpc_prepared import disturbance_ahead, estimate_gains
from softneck.design.predictive._nmpc_state_runtime import nmpc_places, nmpc_shift
from softneck.estimation import LinearNeck
from softneck.identification import GreyBox, Model, Network, NeuralStateSpace, Play, Rls
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import load_runtime
from softneck.signals import Recording, signal

from ..data import slow_but


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
        "nss": NeuralStateSpace(neurons=3, starts=1, iterations=3).fit(recording),
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


@pytest.mark.parametrize("kind", slow_but(NONLINEAR_KINDS, ["nn", "play"]))
@pytest.mark.parametrize("limit", [None, 0.1])
def test_converged_it_is_what_ipopt_finds(kind: str, limit: float | None, models: dict[str, Model]) -> None:
    settings = NmpcSettings(
        horizon=12, moves=4, converged=True, slew_limit=4.0, lead_limit=12.0, angle_limit=limit
    )  # fmt: skip
    controller = settings.design(models[kind])
    own, best = BlockPart(controller.block()), controller.part(solver="casadi")
    places = nmpc_places(own.block.arrays, models[kind].block().initial_state().values.size)
    motors = own.start(0.0, {})
    best.start(0.0, {})
    for k in range(30):
        asked = [0.3, 0.1, 0.2] if k < 15 else [-0.2, 0.1, 0.2]
        u = np.array([*asked, 0.05, 0.0, *motors, 1.0, 1.0])
        best.set_state(own.get_state())
        motors = own.advance(0.0, u)
        best.advance(0.0, u)
        if k == 0:
            continue
        found = best.moves.ravel().copy()
        nmpc_shift(own.block.arrays[1], found)
        assert best.status == "Solve_Succeeded"
        # The bound; ipopt itself stops its barrier at 1e-10 of the scaled problem.
        np.testing.assert_allclose(own.memory[1][places[4] : places[5]], found, atol=1e-5)
    assert np.abs(motors).max() > 0.1


# What FMUs and loop files run has derivatives and a solver of its own: an independent method for the same numbers.
@pytest.mark.parametrize("kind", slow_but(NONLINEAR_KINDS, ["play"]))
@pytest.mark.parametrize("others", [{}, {"angle_limit": 0.1, "preview": 0.2}, {"converged": True}], ids=str)
def test_the_block_is_what_casadi_and_daqp_compute(
    kind: str, others: dict[str, float], models: dict[str, Model]
) -> None:
    controller = NmpcSettings(horizon=12, moves=4, slew_limit=6.0, **others).design(models[kind])  # type: ignore[arg-type]
    block, plant = controller.block(), models[kind].block()
    state, own = controller.initial_state(), block.initial_state()
    x, y, motors = plant.initial_state(use_measurement=0.0), np.zeros(2), np.zeros(3)
    rng, statuses = np.random.default_rng(0), set()
    for k in range(80):
        asked = [0.3, -0.1, 0.3] if k < 40 else [-0.3, 0.2, 0.0]
        u = [*asked, *(y + 0.002 * rng.standard_normal(2)), *motors, 1.0, float(not 60 <= k < 64)]
        u += asked[:2] if "preview" in others else []
        state, motors = controller.step(state, u)
        own, out = block.step(own, u)
        statuses.add(state.values[2])
        if k == 0 and kind == "greybox":
            # Its friction has a corner where nothing moves; there rounding decides which side a derivative is of.
            np.testing.assert_allclose(out, motors, atol=1e-3)
            own.values[: state.values.size] = state.values
            continue
        # Both solve to 1e-10; a loop of 80 samples passes a difference on.
        np.testing.assert_allclose(out, motors, atol=1e-7)
        np.testing.assert_allclose(own.values[7 : state.values.size], state.values[7:], atol=1e-6)
        np.testing.assert_array_equal(own.values[[2, 3, 4, 5]], state.values[[2, 3, 4, 5]])
        x, seen = plant.step(x, [*motors, *[math.nan] * 5])
        y = seen[:2]
    assert statuses == ({1.0, 2.0, 4.0} if "angle_limit" in others and kind != "greybox" else statuses)


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


def test_one_iteration_a_sample_ends_where_all_do(network: Model) -> None:
    ends = []
    for converged in (False, True):
        settings = NmpcSettings(horizon=12, moves=4, converged=converged, lead_limit=12.0)
        ends.append(closed_loop(settings.design(network), network, 60, 0.15)[0])
    # Near rest the problem changes less than it is linear: 0.1 deg in the transient, nothing at its end.
    assert np.abs(ends[0] - ends[1]).max() < 2e-3
    np.testing.assert_allclose(ends[0][-1], ends[1][-1], atol=1e-4)


def test_it_reaches_the_reference_and_rejects_a_load(controller: NmpcController, network: Model) -> None:
    angles, said = closed_loop(controller, network, 220, 0.15, load_at=100, load=0.03)
    np.testing.assert_allclose(angles[95], [0.15, 0.0], atol=2e-3)
    np.testing.assert_allclose(angles[-1], [0.15, 0.0], atol=2e-3)
    assert set(said) == {"optimal"}


def test_limits_are_kept(network: Model) -> None:
    controller = NmpcSettings(horizon=12, moves=4, angle_limit=0.12, position_limit=1.5, slew_limit=5.0).design(network)
    state, before = controller.initial_state(), np.zeros(3)
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
        assert np.isfinite(part._values).all()
        assert part.info.status == ("holding" if k >= 45 else "optimal")
    with pytest.raises(DataError, match="finite inputs"):
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
    two.set_state(one.get_state())
    for u in rows[15:]:
        np.testing.assert_array_equal(one.advance(0.0, u), two.advance(0.0, u))
    with pytest.raises(DataError, match="the state has"):
        two.set_state(b"12345678")


def test_disabled_it_holds_and_takes_over_without_a_bump(controller: NmpcController) -> None:
    state, motors = controller.initial_state(), np.array([0.8, -0.2, -0.2])
    out = motors
    for _ in range(5):
        state, out = controller.step(state, [0.3, 0.0, 0.0, 0.05, 0.0, *motors, 1.0, 0.0])
        np.testing.assert_array_equal(out, motors)
    before = out
    filtered = state.values[controller.solver._at["filtered"]]
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
    with pytest.raises(SettingsError, match=r"is over nn, play, greybox, nss; got rls"):
        NmpcSettings().design(Rls().fit(recording))
    with pytest.raises(SettingsError, match="got LinearNeck"):
        NmpcSettings().design(LinearNeck(pitch=None, roll=None))  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="`horizon` must be"):
        NmpcSettings(horizon=0)
    with pytest.raises(SettingsError, match="`slack_weight` must be positive"):
        NmpcSettings(slack_weight=-1.0)
    with pytest.raises(SettingsError, match="for `order=sequential`"):
        NmpcSettings(order="jacobi")
    with pytest.raises(SettingsError, match="`cocontraction_weight` must be positive"):
        NmpcSettings(cocontraction_weight=-1.0)
    with pytest.raises(SettingsError, match="`horizon` must be"):
        NmpcSettings(horizon=10.5)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="nmpc takes 10 finite inputs"):
        controller.step(controller.initial_state(), [0.1] * 7)
    with pytest.raises(SettingsError, match="is not a parameter of nmpc"):
        controller.initial_state(colour=1.0)
