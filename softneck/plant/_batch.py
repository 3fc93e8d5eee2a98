"""Many necks at once, on all cores: compiled stepping in threads."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from softneck.core import DataError, Matrix, SettingsError

from ._neck import INTERNAL_STEP, VirtualNeck
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
        internal_step: longest [s]; a sample takes equal steps.
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

    def one(index: int) -> Matrix:
        block = VirtualNeck(necks[index]).block(
            noise_seed=chosen[index], sample_time=sample_time, internal_step=internal_step
        )
        # Compiled runtimes hold no GIL, so that threads run at the same time.
        return block.run(block.initial_state(), U[index])[1]

    # The first run compiles; two threads compiling the same function would do it twice.
    first = one(0)
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        return np.stack([first, *pool.map(one, range(1, len(necks)))])
