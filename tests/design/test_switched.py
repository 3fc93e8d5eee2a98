"""The controller that the estimated payload chooses: no bumps, no hurry, a slow reference on an unknown neck."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import SettingsError, load
from softneck.design import VaryingController
from softneck.design.linear._tuning import Gains
from softneck.design.varying._switched import SwitchedSettings, _closed
from softneck.design.varying._switched_runtime import SwitchedArrays, SwitchedState
from softneck.estimation import axis_plant
from softneck.runtime import load_runtime

from .test_scheduled import TS, neck, scheduled

MODELS = [neck(5.2, 5.3), neck(4.6, 4.0), neck(4.0, 3.0)]
PAYLOADS = (0.0, 0.5, 1.0)
CONTROLLER = SwitchedSettings(payloads=PAYLOADS).design(MODELS)


def inputs(rows: int, payload: float | np.ndarray = 0.0, changed: float | np.ndarray = 0.0) -> np.ndarray:
    """References, angles and motors that wander, then what the estimator says."""
    rng = np.random.default_rng(0)
    U = np.cumsum(0.01 * rng.standard_normal((rows, 8)), axis=0)
    return np.column_stack([U, np.ones((rows, 2)), np.broadcast_to(payload, rows), np.broadcast_to(changed, rows)])


def states(controller: VaryingController, U: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the set-points and the parts of the state after each row."""
    block, rows = controller.block(), []
    state, kept = block.initial_state(), []
    for u in U:
        state, P = block.step(state, u)
        rows.append(P)
        kept.append(state.values)
    parts = SwitchedState.parts(SwitchedArrays(block.arrays))
    return np.array(rows), {name: np.array(kept)[:, part] for name, part in parts.items()}


def test_equal_models_make_one_controller_whatever_the_payload() -> None:
    controller = SwitchedSettings(payloads=(0.0, 1.0)).design([neck(), neck()])
    alone = scheduled([neck(), neck()], [0.0, 40.0])
    U = inputs(300, np.where(np.arange(300) % 120 < 60, 0.0, 1.0))
    ours = controller.block().run(controller.initial_state(), U)[1]
    same = alone.block().run(alone.initial_state(), U[:, :10])[1]
    # Corrections of the integral that are nothing but rounding.
    np.testing.assert_allclose(ours, same, atol=1e-9)


def test_a_switch_asks_for_what_the_old_controller_would_have() -> None:
    U = inputs(400)
    switched = inputs(400, np.where(np.arange(400) >= 200, 1.0, 0.0))
    (P, x), (Q, _) = states(CONTROLLER, switched), states(CONTROLLER, U)
    assert (x["chosen"][:200] == 0.0).all()
    assert (x["chosen"][200:] == 2.0).all()
    np.testing.assert_array_equal(P[:200], Q[:200])
    # At the switch the same but for rounding; afterwards another controller acts.
    np.testing.assert_allclose(P[200], Q[200], atol=1e-9)
    assert np.abs(P[230:] - Q[230:]).max() > 1e-3


def test_switches_wait_for_the_dwell_time_and_for_the_margin() -> None:
    restless = np.where(np.arange(600) % 2 == 0, 0.0, 1.0)
    _, x = states(CONTROLLER, inputs(600, restless))
    at = np.flatnonzero(np.diff(x["chosen"][:, 0]))
    assert len(at) > 3
    assert np.diff(at).min() >= round(CONTROLLER.design["dwell_s"] / TS)
    # 0.25 kg is the middle; by a margin of a tenth of 0.5 kg beyond it is another payload.
    for payload, chosen in ((0.29, 0.0), (0.31, 1.0)):
        said = np.where(np.arange(200) < 100, 0.0, payload)
        assert states(CONTROLLER, inputs(200, said))[1]["chosen"][-1] == chosen


def test_an_unknown_neck_slows_the_reference_and_a_known_one_lets_it_catch_up() -> None:
    U = inputs(900, 0.0, np.where((np.arange(900) >= 100) & (np.arange(900) < 300), 1.0, 0.0))
    U[:, :2] = np.where(np.arange(900) < 120, 0.0, 0.2)[:, None]
    _, x = states(CONTROLLER, U)
    most = SwitchedSettings().slow_rate * TS
    moves = np.abs(np.diff(x["asked"], axis=0))
    assert moves.max() <= most * (1.0 + 1e-9)
    np.testing.assert_array_equal(x["asked"][-1], U[-1, :2])
    assert x["slow"][-1] == 0.0
    # Without `changed` what is asked for is passed on to the bit.
    np.testing.assert_array_equal(states(CONTROLLER, inputs(50))[1]["asked"], inputs(50)[:, :2])


def test_no_sequence_of_switches_by_the_dwell_time_drives_the_frozen_loop_off() -> None:
    """Independent of the Lyapunov functions: the spectral radius of random products of loops and resets."""
    rng = np.random.default_rng(1)
    dwell = max(round(CONTROLLER.design["dwell_needed_s"] / TS), 1)
    pairs = [pair[0] for pair in CONTROLLER.design["gains"]]
    for model in MODELS:
        plant = axis_plant(model, "pitch").delayed(0.08)
        loops = [_closed(Gains(**gains), plant, 0) for gains in pairs]
        for _ in range(20):
            order = rng.permutation(np.tile(np.arange(3), 4))
            whole = np.eye(len(loops[0]))
            for here, there in zip(order, np.roll(order, -1), strict=True):
                reset = np.eye(len(whole))
                reset[0, 1] += pairs[there]["gain"] - pairs[here]["gain"]
                whole = reset @ np.linalg.matrix_power(loops[here], dwell) @ whole
            assert np.abs(np.linalg.eigvals(whole)).max() < 1.0


def test_compiled_plain_paused_and_from_a_file_agree(tmp_path: Path) -> None:
    block = CONTROLLER.block()
    U = inputs(300, np.repeat([0.0, 1.0, 0.4], 100), np.repeat([0.0, 0.0, 1.0], 100))
    compiled = block.run(block.initial_state(), U)[1]
    state, Y = block.initial_state(), np.zeros((300, 3))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    # Products of small matrices may be summed in another order.
    np.testing.assert_allclose(Y, compiled, atol=1e-11)
    paused, first = block.run(block.initial_state(), U[:150])
    np.testing.assert_array_equal(np.vstack([first, block.run(paused, U[150:])[1]]), compiled)
    CONTROLLER.save(tmp_path / "switched.npz")
    again = load(tmp_path / "switched.npz", role="controller")
    np.testing.assert_array_equal(again.block().run(again.initial_state(), U)[1], compiled)
    assert again.summary() == CONTROLLER.summary()


@pytest.mark.parametrize(
    ("models", "payloads", "message"),
    [
        (MODELS[:1], (0.0,), "at least two models"),
        (MODELS[:2], (0.0, 0.0), "no two alike"),
        (MODELS, (0.0, 1.0), "got 3 and 2"),
        (MODELS[:2], (0.0, -1.0), "payloads"),
        ([neck(1.0, 5.0), neck(60.0, 5.0)], (0.0, 1.0), "are not stable at 1 kg"),
        ([neck(), neck(sample_time=0.01)], (0.0, 1.0), "different sample times"),
    ],
)
def test_what_cannot_be_switched_says_so(models: list, payloads: tuple[float, ...], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        replace(SwitchedSettings(), payloads=payloads).design(models)
