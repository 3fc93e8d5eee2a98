"""Many necks at once, on all cores: compiled stepping in threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, load_runtime

from ._neck import INTERNAL_STEP, RUNTIME, VirtualNeck
from ._parameters import NeckParameters


def simulate_batch(
    necks: Sequence[NeckParameters],
    inputs: Matrix,
    *,
    seeds: Sequence[int] | None = None,
    sample_time: float = 0.02,
    internal_step: float = INTERNAL_STEP,
    workers: int | None = None,
) -> Matrix:
    """Simulate many necks from rest; return their outputs, (necks, time, 14) in the block's port order.

    Row k of the result is for t_k+1, as `Block.run` gives it, and equal to it to the bit.

    Args:
        necks: one parameter set each.
        inputs: (time, 8) for all necks, or (necks, time, 8), in the block's port order.
        seeds: of the sensors' noise, one each; 0, 1, 2, ... where None.
        sample_time: [s].
        internal_step: [s].
        workers: threads; all cores where None.

    Raises:
        DataError: inputs of another shape or not finite.
        SettingsError: another number of seeds than of necks, or no neck.
    """
    if not necks:
        raise SettingsError("`necks` is empty; give at least one set of parameters.")
    chosen = list(range(len(necks))) if seeds is None else list(seeds)
    if len(chosen) != len(necks):
        raise SettingsError(f"`seeds` must have one entry per neck ({len(necks)}); got {len(chosen)}.")
    U = np.asarray(inputs, dtype=np.float64)
    if U.ndim == 2:
        U = np.broadcast_to(U, (len(necks), *U.shape))
    if U.ndim != 3 or U.shape[0] != len(necks):
        raise DataError(f"`inputs` must have shape (time, 8) or ({len(necks)}, time, 8); got {np.shape(inputs)}.")

    run_steps = _unlocked_steps()

    def one(index: int) -> Matrix:
        block = VirtualNeck(necks[index]).block(
            noise_seed=chosen[index], sample_time=sample_time, internal_step=internal_step
        )
        start, rows = block.initial_state(), block.checked_inputs(U[index])
        outputs = np.zeros((len(rows), len(block.outputs)))
        run_steps(block.arrays, start.parameters, start.values, rows, outputs)
        return outputs

    # The first run compiles; two threads compiling the same function would do it twice.
    first = one(0)
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        return np.stack([first, *pool.map(one, range(1, len(necks)))])


@cache
def _unlocked_steps() -> Callable[..., None]:
    """Return the runtime's loop such that threads run it at the same time."""
    runtime = load_runtime(RUNTIME)
    if not runtime.compiled:
        return runtime.run_steps
    from numba import njit

    steps = runtime.run_steps

    def unlocked(arrays, parameters, state, inputs, outputs) -> None:  # type: ignore[no-untyped-def]
        steps(arrays, parameters, state, inputs, outputs)

    return njit(nogil=True)(unlocked)
