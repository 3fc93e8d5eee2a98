"""Indirect adaptive control: it learns what is true, its safeguards hold, and unlearnt it is a linear controller."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import SettingsError, load
from softneck.design import AdaptiveSettings, LinearController, VaryingController, uncertain_plant
from softneck.design.linear._controller import AxisController, ReferenceFilter, assemble
from softneck.design.linear._pi import Gains
from softneck.design.varying import _adaptive
from softneck.design.varying._adaptive_runtime import AdaptiveArrays, AdaptiveState
from softneck.estimation import AxisPlant, LinearNeck
from softneck.identification import Recursion
from softneck.loop import BlockPart, Loop, LoopResult, run_loop
from softneck.robot import Robot
from softneck.runtime import Block, State, load_runtime
from softneck.signals import redefine

from .test_pi import POLE, TS, B, DelayedNeck, neck

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

DEG = math.radians(1.0)
NOMINAL = B / (1.0 - POLE)
LEARNT = ("theta", "U", "D", "tally")


def following_axis(gains: Gains, plant: AxisPlant, delay: int, leak_time: float) -> AxisController:
    """Return `v = r/G0 + K (ym - y) + s`, `s+ = s + K Ts/Ti (ym - y)`, `ym = z^-d (1 - a)/(z - a) r`.

    The static gain G0 and the pole a are the plant's: if it is as modelled, y follows ym, the feedback rests, and the
    response is that of the plant with its input filtered as the reference is (Astrom and Hagglund 2006, Advanced PID
    Control, sec. 5.4). Loop and margins are those of the PI alone.

    Conditioning: the model gets what the motors can do instead of what was asked, so that it waits for a limited
    input; the integral besides leaks what is beyond a limit, over `leak_time`.

    States: s, the model's lag, its delay line. All mean the same for all gains.

    Args:
        gains: K and Ti.
        plant: of order one, or of any with the slowest pole taken.
        delay: of the model beyond its first sample [samples].
        leak_time: [s].
    """
    Ts = plant.sample_time
    a = float(np.abs(np.roots(plant.denominator)).max(initial=0.0))
    forward, K, rate = 1.0 / plant.static_gain, gains.gain, gains.gain * Ts / gains.integral_time
    n = 2 + delay
    A = np.zeros((n, n))
    A[0, 0], A[1, 1] = 1.0, a
    A[0, -1] += rate
    for i in range(2, n):
        A[i, i - 1] = 1.0
    Br, By, C, L = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((1, n)), np.zeros((n, 1))
    Br[1], By[0] = 1.0 - a, -rate
    C[0, 0], C[0, -1] = 1.0, K
    L[0], L[1] = Ts / leak_time, (1.0 - a) / forward
    return AxisController(A=A, Br=Br, By=By, C=C, Dr=forward, Dy=-K, L=L)


@cache
def controller(gain_range: float = 0.5, **learning: float) -> VaryingController:
    """Return the controller with other numbers of what is learnt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_adaptive, "LEARNING", replace(_adaptive.LEARNING, **{"start_covariance": 50.0, **learning}))
        return AdaptiveSettings(lead_limit=12.0, gain_range=gain_range).design(neck())


def memory(block: Block, values: np.ndarray, name: str, axis: int) -> np.ndarray:
    """What an axis remembers under `name`."""
    return values[AdaptiveState.parts(AdaptiveArrays(block.arrays))[name]].reshape(2, -1)[axis]


def estimated(block: Block, values: np.ndarray, axis: int) -> tuple[float, float]:
    """Pole a and static gain that were learnt."""
    theta = memory(block, values, "theta", axis)
    return -theta[0], theta[1] / (1.0 + theta[0])


def estimate(part: BlockPart, axis: int) -> tuple[float, float]:
    return estimated(part.block, part._state, axis)


class Square:
    """Both axes up and down, at times of their own."""

    def __call__(self, time: float, /) -> tuple[float, float, float]:
        return 10.0 * DEG * (1.0 if time // 3.0 % 2 else -1.0), 8.0 * DEG * (1.0 if time // 2.0 % 2 else -1.0), 0.0


def squares(
    part: BlockPart, *, gain: float = 1.0, noise_deg: float = 0.0, duration: float = 18.0, adapt: float = 1.0
) -> LoopResult:
    plant = DelayedNeck(gain=gain, noise_deg=noise_deg)
    parameters = {"adapt": adapt}
    return run_loop(
        Loop(plant=plant, controller=part, reference=Square(), duration=duration, controller_parameters=parameters)
    )


@pytest.mark.parametrize("gain", [0.6, 1.4])
def test_without_noise_it_finds_the_plant(gain: float) -> None:
    part = BlockPart(controller(dead_zone=0.0).block())
    squares(part, gain=gain)
    for axis in range(2):
        a, static = estimate(part, axis)
        # Clean data of the very structure: what the weak start pulls is left, 1 / (50 * information).
        assert a == pytest.approx(POLE, abs=1e-4)
        assert static == pytest.approx(gain * NOMINAL, rel=1e-3)


def test_with_noise_it_comes_near_and_the_response_becomes_that_of_the_true_plant() -> None:
    part = BlockPart(controller().block())
    learning = squares(part, gain=1.4, noise_deg=0.02, duration=24.0)
    a, static = estimate(part, 0)
    # 0.02 deg on steps of 20 deg, and a bias of least squares with noisy regressors.
    assert a == pytest.approx(POLE, abs=5e-3)
    assert static == pytest.approx(1.4 * NOMINAL, rel=0.03)
    known = AdaptiveSettings(lead_limit=12.0).design(neck(gain=1.4))
    truth = squares(BlockPart(known.block()), gain=1.4, noise_deg=0.02, duration=24.0, adapt=0.0)
    nominal = squares(BlockPart(controller().block()), gain=1.4, noise_deg=0.02, duration=24.0, adapt=0.0)
    last = slice(-300, None)
    errors = [np.std((run["pitch"] - truth["pitch"])[last]) for run in (learning, nominal)]
    assert errors[0] < 0.25 * errors[1]


def test_no_step_overshoots_while_it_learns() -> None:
    part = BlockPart(controller().block())
    result = squares(part, gain=0.6, noise_deg=0.02)
    # The nominal loop keeps within 1 % at this gain, and gains that change move no motor by themselves.
    assert np.abs(np.degrees(result["pitch"])).max() < 10.3


def test_what_it_learns_is_what_the_kit_s_recursion_learns() -> None:
    """The regression written out with plain filters, run through `softneck.identification.Recursion`."""
    learning = _adaptive.LEARNING
    part = BlockPart(controller(excitation=0.0, distrust=100.0, pole_range=3.0, start_covariance=1.0).block())
    result = squares(part, gain=1.2, noise_deg=0.05, duration=6.0)
    y = result["pitch_measured"] if "pitch_measured" in result.signals else result["pitch"]
    u = redefine(np.column_stack([result[f"motor_setpoint_{j}"] for j in (1, 2, 3)]))[:, 0]
    f = math.exp(-learning.band * TS)
    bands = []
    for x in (y, u):
        first, second, band = 0.0, 0.0, np.zeros(x.size)
        for k in range(1, x.size):
            first = f * first + x[k] - x[k - 1]
            second = f * second + first
            band[k] = second
        bands.append(band)
    filled = math.floor(4 + 2.0 / (1.0 - f)) + 1
    rows = np.arange(filled, y.size)
    Phi = np.column_stack([-bands[0][rows - 1], bands[1][rows - 5]])
    recursion = Recursion(
        parameters=2, forgetting=learning.forgetting, covariance_bound=learning.covariance_bound,
        dead_zone=learning.dead_zone, poles=1, start_covariance=1.0,
    )  # fmt: skip
    found = recursion.run(recursion.initial_state([-POLE, B]), Phi, bands[0][rows])[0].theta
    theta = memory(part.block, part._state, "theta", 0)
    # The same rows in the same order, filtered twice: rounding, unless a guard acted that the recursion has not.
    np.testing.assert_allclose(theta, found, rtol=1e-6)


def linear(settings: AdaptiveSettings) -> LinearController:
    """The controller of the nominal plant as a linear one."""
    found = settings.design(neck()).design["pitch"]
    K, Ti = found["kappa"] / B, TS / (1.0 - POLE)
    plant = AxisPlant(np.array([B]), np.array([1.0, -POLE]), 4, TS)
    axis = following_axis(Gains(K, Ti), plant, 4, _adaptive.LEARNING.leak_time)
    time = settings.reference_time or 0.0
    arrays = assemble(
        (axis, axis),
        filters=(ReferenceFilter(time),) * 3,
        constants=np.array([TS]),
        redefinition=uncertain_plant(neck()).redefinition,
    )
    return LinearController(
        kind="pi", sample_time=TS, order="sequential", design={}, arrays=arrays, limits=settings.limits(Robot.preset())
    )  # fmt: skip


def test_without_learning_it_is_a_linear_controller() -> None:
    settings = AdaptiveSettings(reference_time=0.06, lead_limit=0.8)
    block, other = settings.design(neck()).block(), linear(settings).block()
    U = 0.2 * np.random.default_rng(0).standard_normal((200, 10))
    U[:, 8:] = 1.0
    # From rest, where both start alike.
    U[0, :8] = 0.0
    ours = block.run(block.initial_state(adapt=0.0), U)[1]
    same = other.run(other.initial_state(), U)[1]
    # exp(-5.293 * 0.02) is found back from a polynomial's root.
    np.testing.assert_allclose(ours, same, atol=1e-9)


def fuzz(rows: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    U = np.column_stack([0.4 * rng.standard_normal((rows, 8)), rng.random((rows, 2)) > 0.02]).astype(float)
    U[rows // 2 :, 3:5] *= 100.0 if seed % 2 else 1e-3
    return U


@pytest.mark.slow
@given(seed=st.integers(0, 1000))
def test_whatever_comes_the_estimate_is_in_its_box_and_gains_move_slowly(seed: int) -> None:
    block = controller(gain_rate=0.5).block()
    box = AdaptiveArrays(block.arrays).box
    state = block.initial_state()
    before = [memory(block, state.values, "used", axis).copy() for axis in range(2)]
    for u in fuzz(120, seed):
        state, P = block.step(state, u)
        assert np.isfinite(P).all()
        for axis in range(2):
            a, gain = estimated(block, state.values, axis)
            # One division and one product of rounding.
            assert box[axis, 0] * (1 - 1e-9) <= a <= box[axis, 1] * (1 + 1e-9)
            assert box[axis, 2] * (1 - 1e-9) <= gain <= box[axis, 3] * (1 + 1e-9)
            used = memory(block, state.values, "used", axis).copy()
            lags, gains = (1.0 - used[0], 1.0 - before[axis][0]), (used[1], before[axis][1])
            assert abs(lags[0] / lags[1] - 1.0) <= 0.5 * TS * (1 + 1e-9)
            # b = gain (1 - a): both may move at once.
            assert abs(gains[0] / gains[1] - 1.0) <= (1.0 + 0.5 * TS) ** 2 - 1.0 + 1e-9
            before[axis] = used


def learnt(block: Block, state: State) -> np.ndarray:
    return np.concatenate([memory(block, state.values, name, axis) for name in LEARNT for axis in range(2)])


def test_nothing_is_learnt_at_rest_within_the_dead_zone_or_while_stopped() -> None:
    block = controller().block()
    quiet = 1e-5 * np.random.default_rng(1).standard_normal((200, 10))
    quiet[:, 8:] = 1.0
    start = learnt(block, block.initial_state())
    np.testing.assert_array_equal(learnt(block, block.run(block.initial_state(), quiet)[0]), start)
    stopped = fuzz(200, 2)
    stopped[:, 9] = 0.0
    np.testing.assert_array_equal(learnt(block, block.run(block.initial_state(), stopped)[0]), start)
    blind = fuzz(200, 2)
    blind[:, 8] = 0.0
    np.testing.assert_array_equal(learnt(block, block.run(block.initial_state(), blind)[0]), start)


def test_an_estimate_that_predicts_worse_than_the_nominal_plant_is_dropped() -> None:
    part = BlockPart(controller(gain_range=0.8).block())
    squares(part, gain=1.7, duration=12.0)
    _, static = estimate(part, 0)
    assert static > 1.5 * NOMINAL
    values = part._state.copy()
    # The payload is taken off: the plant is the nominal one again, and what was learnt is wrong at once.
    block = part.block
    plant = DelayedNeck(gain=1.0, noise_deg=0.0)
    plant.start(0.0, {})
    state = State(values, block.initial_state().parameters, np.zeros(3))
    angles, motors, dropped = np.zeros(2), np.zeros(3), False
    for k in range(300):
        reference = Square()(k * TS)
        state, P = block.step(state, np.array([*reference, *angles, *motors, 1.0, 1.0]))
        answer = plant.advance(k * TS, P)
        angles, motors = answer[:2], P
        _, static = estimated(block, state.values, 0)
        dropped = dropped or abs(static / NOMINAL - 1.0) < 1e-9
    assert dropped
    assert static == pytest.approx(NOMINAL, rel=0.1)


def test_compiled_and_plain_agree_and_pause_and_resume_is_one_run() -> None:
    block = controller().block()
    U = fuzz(150, 4)
    whole = block.run(block.initial_state(), U)[1]
    state, first = block.run(block.initial_state(), U[:60])
    np.testing.assert_array_equal(np.vstack([first, block.run(state, U[60:])[1]]), whole)
    state, Y = block.initial_state(), np.zeros((150, 3))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    # A recursion adds its rounding up, and small products are summed in another order.
    np.testing.assert_allclose(Y, whole, atol=1e-8)


@given(motors=st.tuples(*[st.floats(-5.0, 5.0)] * 3), pitch=st.floats(-0.6, 0.6), roll=st.floats(-0.6, 0.6))
def test_it_starts_without_a_bump(motors: tuple[float, float, float], pitch: float, roll: float) -> None:
    block = controller().block()
    state = block.initial_state()
    u = np.array([pitch, roll, float(np.mean(motors)), pitch, roll, *motors, 1.0, 1.0])
    for _ in range(5):
        state, P = block.step(state, u)
        np.testing.assert_allclose(P, motors, atol=1e-9)


def test_a_saved_controller_is_the_same(tmp_path: Path) -> None:
    made = controller()
    made.save(tmp_path / "a.npz")
    again = load(tmp_path / "a.npz", role="controller")
    assert again.summary() == made.summary()
    assert "largest Ms of the nominal gains in the box" in made.summary()
    U = fuzz(60, 5)
    runs = [item.block().run(item.initial_state(adapt=1.0), U)[1] for item in (made, again)]
    np.testing.assert_array_equal(runs[0], runs[1])


def test_jacobi_designs_for_two_samples_more() -> None:
    first, second = (AdaptiveSettings(order=order).design(neck()).design["pitch"] for order in ("sequential", "jacobi"))
    assert second["dead_time_s"] == pytest.approx(first["dead_time_s"] + 2 * TS)
    assert second["kappa"] < first["kappa"]


def test_the_loop_of_every_redesign_keeps_what_was_asked() -> None:
    settings = AdaptiveSettings()
    kappa = settings.design(neck()).design["pitch"]["kappa"]
    w = np.geomspace(0.01, math.pi / TS, 20_000)
    z = np.exp(1j * w * TS)
    L = kappa * z**-4 / (z - 1.0)
    assert np.abs(1.0 / (1.0 + L)).max() <= settings.max_sensitivity * 1.001
    crossing = int(np.flatnonzero(np.abs(L) >= 1.0)[-1])
    assert abs(np.angle(-L[crossing])) >= settings.phase_margin - 1e-2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain_range": 1.0}, "`gain_range` must be between 0 and 0.9"),
        ({"order": "other"}, "`order` must be one of"),
        ({"max_sensitivity": 3.5, "phase_margin": 0.3, "gain_range": 0.9}, "not stable at a corner of the box"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        AdaptiveSettings(**settings).design(neck())


def test_a_plant_of_two_poles_is_refused_with_the_remedy() -> None:
    axis = control.TransferFunction([0.01], [1.0, -1.7, 0.72], TS)
    with pytest.raises(SettingsError, match="takes a plant of one pole and a dead time; this one is of order 2"):
        AdaptiveSettings().design(LinearNeck(pitch=axis, roll=axis))


def test_several_models_are_refused() -> None:
    with pytest.raises(SettingsError, match="one model or a family; got 2 models"):
        AdaptiveSettings().design([neck(), neck()])  # pyright: ignore[reportArgumentType]
