"""The map of a neural state space, shared by its runtime and its training.

`x(k+1) = A x(k) + B v(k) + E t`, `t = tanh(F x(k) + G v(k) + D t + h)`, `y(k) = C x(k) + c`; v are the redefined inputs
as they are and behind play operators; D is strictly lower triangular, so that the neurons are found one by one. A, D,
E, F are those of a contraction (see `_contraction`): two free runs under the same inputs draw together, and x is what a
stable linear system makes of bounded inputs and bounded tanh. No free run can diverge.
"""

import math

import numpy as np


def nss_inputs(redefinition: np.ndarray, widths: np.ndarray, m: np.ndarray, plays: np.ndarray, v: np.ndarray) -> None:
    """Move `plays` (c widths,) to the motors `m` (motors,), and fill `v` (c (1 + widths),) for c redefined inputs."""
    count = widths.shape[0]
    for c in range(redefinition.shape[0]):
        # Eq. 9-11.
        value = 0.0
        for j in range(redefinition.shape[1]):
            value += redefinition[c, j] * m[j]
        at = c * (count + 1)
        v[at] = value
        for i in range(count):
            plays[c * count + i] = max(value - widths[i], min(value + widths[i], plays[c * count + i]))
            v[at + 1 + i] = plays[c * count + i]


def nss_loaded(payload: float, v: np.ndarray) -> None:
    """Fill what comes behind the inputs in `v`: each of them times the payload [kg], and the payload."""
    count = (v.shape[0] - 1) // 2
    for j in range(count):
        v[count + j] = payload * v[j]
    v[2 * count] = payload


def nss_next(
    A: np.ndarray,
    B: np.ndarray,
    E: np.ndarray,
    F: np.ndarray,
    G: np.ndarray,
    h: np.ndarray,
    D: np.ndarray,
    x: np.ndarray,
    v: np.ndarray,
    t: np.ndarray,
    ahead: np.ndarray,
) -> None:
    """Fill `ahead` (n,) with the next state, and `t` (neurons,) with the values of tanh."""
    for i in range(h.shape[0]):
        total = h[i]
        for j in range(x.shape[0]):
            total += F[i, j] * x[j]
        for j in range(v.shape[0]):
            total += G[i, j] * v[j]
        # Neurons before this one alone: their values are of this sample already.
        for j in range(i):
            total += D[i, j] * t[j]
        t[i] = math.tanh(total)
    for i in range(x.shape[0]):
        total = 0.0
        for j in range(x.shape[0]):
            total += A[i, j] * x[j]
        for j in range(v.shape[0]):
            total += B[i, j] * v[j]
        for j in range(h.shape[0]):
            total += E[i, j] * t[j]
        ahead[i] = total
