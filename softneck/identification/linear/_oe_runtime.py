"""Two transfer functions over the redefined inputs, in free run their own outputs fed back.

Arrays: H, drive, T, a (2, na), b (2, nb), delay (2,), source (1,): 1 takes motor positions for u, 0 set-points.
"""

import numpy as np

from softneck.identification.linear._arx_runtime import arx_output
from softneck.identification.models._narx_runtime import narx_advance, narx_observe


def oe_output(arrays: tuple[np.ndarray, ...], state: np.ndarray, axis: int) -> float:
    """Return y(k+1) of one axis."""
    h = int(arrays[0][0])
    # Motor positions stand H samples of three behind set-points: a source of 1 reads them as if that much older.
    delay = int(arrays[5][axis]) + h * int(arrays[6][0])
    return arx_output(arrays[2], arrays[3][axis], arrays[4][axis], delay, h, state, axis)


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample."""
    narx_observe(arrays, parameters, state, inputs)
    pitch = oe_output(arrays, state, 0)
    roll = oe_output(arrays, state, 1)
    narx_advance(arrays, parameters, state, pitch, roll, outputs)
