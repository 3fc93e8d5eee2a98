"""One linear difference equation (Eq. 23) over the histories of `_narx_runtime`."""

import numpy as np


def arx_output(
    redefinition: np.ndarray, a: np.ndarray, b: np.ndarray, delay: int, history: int, state: np.ndarray, axis: int
) -> float:
    """Return y(k+1) = -a y(k+1-i) + b u(k+1-delay-j) of one axis; `a` (na,) and `b` (nb,) may be empty."""
    y = 0.0
    for i in range(a.shape[0]):
        y -= a[i] * state[6 * history + 2 * i + axis]
    for j in range(b.shape[0]):
        back = 3 * (delay + j)
        redefined = 0.0
        for m in range(3):
            redefined += redefinition[axis, m] * state[back + m]
        y += b[j] * redefined
    return y
