"""What decays to rest does not linger among the subnormal numbers, with which processors are slow."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.fmu.describe._description import exported_block
from softneck.runtime._rest_runtime import REST

from ..data import slow_but
from .every_kind import block_of

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")
KINDS = ("rls", "oe2", "miso", "play", "pi", "hinf", "adaptive")
_LEAST_NORMAL = np.finfo(float).tiny


@pytest.mark.parametrize("kind", slow_but(KINDS, ["rls", "pi"], ["oe2", "miso"]))
def test_a_state_at_rest_holds_no_subnormal_number(kind: str) -> None:
    block = exported_block(block_of(kind))  # as its FMU holds it: a controller with the drives inside
    rng = np.random.default_rng(0)
    at_rest = [port.start for port in block.inputs]
    moved = np.tile(at_rest, (50, 1))
    moved[:, [i for i, port in enumerate(block.inputs) if not port.boolean]] += 0.1 * rng.standard_normal(
        (50, sum(not port.boolean for port in block.inputs))
    )
    state, _ = block.run(block.initial_state(), moved)
    # The slowest pole here, 0.98, needs 35,000 samples from 0.1 to the subnormal numbers.
    state, outputs = block.run(state, np.tile(at_rest, (40_000, 1)))
    for values in (state.values, outputs[-1]):
        size = np.abs(values)
        assert not ((size > 0.0) & (size < _LEAST_NORMAL)).any()


def test_modelled_drives_end_at_a_set_point_of_zero() -> None:
    block = exported_block(block_of("pi"))
    names = [port.name for port in block.inputs]
    rows = np.zeros((10_000, len(names)))
    rows[:, [names.index("healthy"), names.index("enabled")]] = 1.0
    # There and back: a tendon that may not go below 0 is sent to exactly 0.
    rows[:50, 0], rows[50:, 0] = 0.3, -0.3
    state, outputs = block.run(block.initial_state(least_position=0.0), rows)
    assert outputs[49].max() > 0.1
    assert (outputs[-1] == 0.0).any()
    size = np.abs(state.values)
    assert not ((size > 0.0) & (size < _LEAST_NORMAL)).any()


def test_numbers_of_normal_size_are_left_alone_to_the_bit() -> None:
    x = np.random.default_rng(0).standard_normal(10_000) * 10.0 ** np.linspace(-63.0, 300.0, 10_000)
    assert ((x + REST) - REST == x).all()
