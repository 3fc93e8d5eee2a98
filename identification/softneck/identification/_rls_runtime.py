"""ARX over the redefined inputs, one axis beside the other (Eq. 23); arrays: H, drive, T, a, b, delay."""

import numpy as np

from softneck.identification._narx_runtime import narx_advance, narx_observe


def rls_output(arrays: tuple[np.ndarray, ...], state: np.ndarray, axis: int) -> float:
    """Return y(k+1) = -a y(k+1-i) + b u(k+1-delay-j) of one axis."""
    h = int(arrays[0][0])
    T = arrays[2]
    a = arrays[3]
    b = arrays[4]
    delay = int(arrays[5][axis])
    y = 0.0
    for i in range(a.shape[1]):
        y -= a[axis, i] * state[6 * h + 2 * i + axis]
    for j in range(b.shape[1]):
        back = 3 * (delay + j)
        redefined = 0.0
        for m in range(3):
            redefined += T[axis, m] * state[back + m]
        y += b[axis, j] * redefined
    return y


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
