"""A linear state space with an observer gain; arrays: H, drive, A (n, n), B (n, 3), K (n, 2), [delay, source].

`x(k+1) = A x(k) + B u(k - delay) + K (y(k) - x(k)[:2])`: the first two states are pitch and roll. `source` 1 takes
motor positions for u, 0 set-points. The state stands where `_narx_runtime` keeps its histories of outputs (n <= 2H).
"""

import numpy as np

from softneck.identification.models._narx_runtime import narx_advance


def lss_observe(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray) -> None:
    """Take in what is known at t_k: outputs and motors, measured where they are, and the histories of u and m."""
    h = int(arrays[0][0])
    now = 8 * h
    measured = parameters[2] > 0.5
    for j in range(2):
        if measured and np.isfinite(inputs[3 + j]):
            state[now + 3 + j] = inputs[3 + j]
    for j in range(3):
        if arrays[1][j, 1] == 0.0:
            state[now + j] = inputs[j]
        if measured and np.isfinite(inputs[5 + j]):
            state[now + j] = inputs[5 + j]
    state[3 : 3 * h] = state[: 3 * h - 3].copy()
    state[3 * h + 3 : 6 * h] = state[3 * h : 6 * h - 3].copy()
    state[:3] = inputs[:3]
    state[3 * h : 3 * h + 3] = state[now : now + 3]


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample."""
    lss_observe(arrays, parameters, state, inputs)
    h = int(arrays[0][0])
    n = arrays[2].shape[0]
    first = 6 * h
    u = 3 * int(arrays[5][0]) + 3 * h * int(arrays[5][1])
    e0 = state[8 * h + 3] - state[first]
    e1 = state[8 * h + 4] - state[first + 1]
    ahead = np.zeros(n)
    for i in range(n):
        value = arrays[4][i, 0] * e0 + arrays[4][i, 1] * e1
        for j in range(n):
            value += arrays[2][i, j] * state[first + j]
        for j in range(3):
            value += arrays[3][i, j] * state[u + j]
        ahead[i] = value
    state[first : first + n] = ahead
    narx_advance(arrays, parameters, state, ahead[0], ahead[1], outputs)
