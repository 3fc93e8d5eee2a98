"""ARX over the redefined inputs, one axis beside the other (Eq. 23); arrays: H, drive, T, a, b, delay."""

import numpy as np

from softneck.identification.linear._arx_runtime import arx_output
from softneck.identification.models._narx_runtime import narx_advance, narx_observe


def rls_output(arrays: tuple[np.ndarray, ...], state: np.ndarray, axis: int) -> float:
    """Return y(k+1) of one axis."""
    delay = int(arrays[5][axis])
    return arx_output(arrays[2], arrays[3][axis], arrays[4][axis], delay, int(arrays[0][0]), state, axis)


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample."""
    narx_observe(arrays, parameters, state, inputs)
    pitch = rls_output(arrays, state, 0)
    roll = rls_output(arrays, state, 1)
    narx_advance(arrays, parameters, state, pitch, roll, outputs)
