"""What is not a number moves no motor, and nothing of it stays: one sample of it would else end a run for good."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck import load
from softneck.core import Matrix
from softneck.runtime import Block, load_runtime

GOLDEN = Path(__file__).parents[1] / "golden"


def _answers(block: Block, rows: Matrix) -> Matrix:
    # As compiled loops and drives run it; `Block.run` and FMUs refuse such rows.
    runtime, start = load_runtime(block.runtime), block.initial_state()
    y = np.zeros((len(rows), len(block.outputs)))
    runtime.run_steps(block.arrays, start.parameters, start.values.copy(), rows, y)
    return y


@pytest.mark.parametrize("healthy", [0.0, 1.0])
@pytest.mark.parametrize("slot", [0, 3, 5])
@pytest.mark.parametrize("kind", ["pi", "hinf", "adaptive"])
def test_motors_hold_while_an_input_is_not_a_number_and_go_on_behind_it(kind: str, slot: int, healthy: float) -> None:
    controller = load(GOLDEN / f"{kind}.npz", role="controller")
    block = controller.block()
    rows = np.zeros((12, len(block.inputs)))
    rows[:, 0], rows[:, 8:10] = 0.05, 1.0
    rows[6, slot], rows[6, 8] = np.nan, healthy
    y = _answers(block, rows)
    assert np.isfinite(y).all()
    np.testing.assert_array_equal(y[6], y[5])
    assert not np.array_equal(y[8], y[7])  # they move again


@pytest.mark.parametrize("kind", ["pi", "adaptive"])
def test_a_controller_that_begins_without_numbers_begins_where_the_motors_are(kind: str) -> None:
    block = load(GOLDEN / f"{kind}.npz", role="controller").block()
    rows = np.zeros((3, len(block.inputs)))
    rows[:, 5:8], rows[:, 8] = 0.3, 1.0  # healthy, not enabled
    rows[0, 3] = np.nan
    y = _answers(block, rows)
    np.testing.assert_array_equal(y[1:], 0.3)
