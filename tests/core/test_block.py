"""Blocks: every way to step one is the same recursion, and what cannot be stepped is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block, load_runtime

KINDS = ("rls", "mimo", "oe", "oe2", "nlsm", "residual", "nn", "neck")


@pytest.fixture(scope="session")
def block_of(models: dict) -> Callable[[str], Block]:
    return lambda kind: VirtualNeck(NeckParameters.preset("paper")).block() if kind == "neck" else models[kind].block()


def inputs_of(block: Block, rows: int, seed: int = 0) -> np.ndarray:
    """Inputs within reach of each port: set-points that move, small for all else, some measurements missing."""
    rng = np.random.default_rng(seed)
    U = np.zeros((rows, len(block.inputs)))
    for column, port in enumerate(block.inputs):
        if port.name.startswith("motor_setpoint"):
            U[:, column] = np.cumsum(0.1 * rng.standard_normal(rows))
        elif port.missing:
            U[:, column] = np.where(rng.random(rows) < 0.3, np.nan, 0.02 * rng.standard_normal(rows))
        else:
            U[:, column] = port.start
    return U


@pytest.mark.parametrize("measurement", [0.0, 1.0])
@pytest.mark.parametrize("kind", KINDS)
def test_run_is_step_again_and_again(block_of: Callable[[str], Block], kind: str, measurement: float) -> None:
    block = block_of(kind)
    parameters = {"use_measurement": measurement, "noise_std": 0.01, "noise_seed": 4.0} if kind != "neck" else {}
    start = state = block.initial_state(**parameters)
    U = inputs_of(block, 40)
    end, Y = block.run(start, U)
    stepped = []
    for row in U:
        state, y = block.step(state, row)
        stepped.append(y)
    # The same recursion in the same order: the same bits, whoever loops.
    assert np.array(stepped).tobytes() == Y.tobytes()
    assert state.values.tobytes() == end.values.tobytes()
    np.testing.assert_array_equal(end.outputs, Y[-1])


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_may_be_paused_and_a_state_used_twice(block_of: Callable[[str], Block], kind: str) -> None:
    block = block_of(kind)
    start, U = block.initial_state(), inputs_of(block, 30, seed=1)
    _, whole = block.run(start, U)
    middle, first = block.run(start, U[:13])
    _, second = block.run(middle, U[13:])
    _, again = block.run(middle, U[13:])
    assert np.vstack([first, second]).tobytes() == whole.tobytes()
    assert again.tobytes() == second.tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_compiled_and_plain_python_agree(block_of: Callable[[str], Block], kind: str) -> None:
    block = block_of(kind)
    plain, fast = load_runtime(block.runtime, compiled=False), load_runtime(block.runtime)
    state = block.initial_state()
    U = inputs_of(block, 25, seed=2)
    results = []
    for runtime in (plain, fast):
        x, Y = state.values.copy(), np.zeros((len(U), len(block.outputs)))
        runtime.run_steps(block.arrays, state.parameters, x, U, Y)
        results.append(Y)
    # BLAS and libm may round sums and tanh otherwise than numba's; 25 steps of a stable system amplify eps little.
    np.testing.assert_allclose(results[1], results[0], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("kind", ["rls", "mimo", "oe", "nlsm", "residual", "nn"])
@pytest.mark.parametrize("horizon", [1, 2, 5, 100])
def test_a_horizon_is_a_restart_from_every_row(block_of: Callable[[str], Block], kind: str, horizon: int) -> None:
    block = block_of(kind)
    start = block.initial_state(use_measurement=1.0)
    measured = inputs_of(block, 20, seed=3)
    free = measured.copy()
    free[:, 3:] = np.nan
    got = block.run_horizon(start, measured, free, horizon)
    for k in range(len(measured)):
        known = max(k + 1 - horizon, 0)  # the last row whose measurement may be used
        state, _ = block.run(start, measured[: known + 1])
        _, rest = block.run(state, free[known + 1 : k + 1])
        expected = rest[-1] if len(rest) else state.outputs
        assert got[k].tobytes() == expected.tobytes(), k


def test_one_step_ahead_is_step(block_of: Callable[[str], Block]) -> None:
    block = block_of("rls")
    start = block.initial_state(use_measurement=1.0)
    U = inputs_of(block, 20)
    np.testing.assert_array_equal(block.run_horizon(start, U, U, 1), block.run(start, U)[1])


def test_no_row_is_no_step(block_of: Callable[[str], Block]) -> None:
    block = block_of("rls")
    start = block.initial_state(pitch_start=0.1)
    end, Y = block.run(start, np.zeros((0, 8)))
    assert Y.shape == (0, 6)
    np.testing.assert_array_equal(end.values, start.values)
    np.testing.assert_array_equal(end.outputs, start.outputs)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"noise_std": -0.1}, r"`noise_std` must be between 0 and 0\.5 \[rad\]; got -0\.1"),
        ({"pitch_start": 57.0}, "`pitch_start` must be between"),
        ({"pitch_start": np.nan}, "`pitch_start` must be between"),
        ({"tilt": 1.0}, "`tilt` is not a parameter of rls; it has pitch_start, roll_start, use_measurement"),
    ],
)
def test_a_wrong_parameter_is_named(block_of: Callable[[str], Block], parameters: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        block_of("rls").initial_state(**parameters)


def test_a_row_alone_is_checked_as_in_a_record(block_of: Callable[[str], Block]) -> None:
    block = block_of("rls")
    state = block.initial_state()
    large = np.array([1e200, -1e200, 1e300, *[0.1] * 5])
    stepped, y = block.step(state, large)
    end, Y = block.run(state, large[None])
    np.testing.assert_array_equal(y, Y[0])
    np.testing.assert_array_equal(stepped.values, end.values)
    for wrong in ([np.inf, -np.inf], [np.nan, 0.0]):
        with pytest.raises(DataError, match=r"input `motor_setpoint_1` of rls is"):
            block.step(state, [*wrong, *large[2:]])


def test_wrong_inputs_are_named(block_of: Callable[[str], Block]) -> None:
    block = block_of("rls")
    state = block.initial_state()
    u = np.zeros(8)
    with pytest.raises(DataError, match=r"rls takes 8 inputs \(motor_setpoint_1, .*; got shape \(1, 3\)"):
        block.step(state, u[:3])
    for bad in (np.nan, np.inf):
        with pytest.raises(
            DataError, match=r"input `motor_setpoint_2` of rls is (nan|inf) at row 0; it must be finite"
        ):
            block.step(state, [0, bad, *u[2:]])
    with pytest.raises(DataError, match="input `pitch_measured` of rls is inf"):
        block.step(state, [0, 0, 0, np.inf, *u[4:]])
    block.step(state, [0, 0, 0, *[np.nan] * 5])  # not measured


def test_every_block_fits_its_runtime(block_of: Callable[[str], Block], tmp_path: Path) -> None:
    for kind in KINDS:
        block = block_of(kind)
        names = [port.name for port in (*block.inputs, *block.outputs, *block.parameters)]
        assert len(set(names)) == len(names), kind
        assert all(array.dtype == np.float64 and array.flags.c_contiguous for array in block.arrays)
        assert block.initial_state().outputs.shape == (len(block.outputs),)
