"""The least gamma that a data set allows, over all pairs of points (Eq. 16-20; Milanese and Novara 2004)."""

import numpy as np


def least_gammas(points: np.ndarray, values: np.ndarray, slacks: np.ndarray, worst: np.ndarray) -> np.ndarray:
    """Return, for each slack, the least gamma with `|y_i - y_j| <= slack + gamma |w_i - w_j|` for all pairs.

    Args:
        points: (n, N) scaled regressors, one column per row of data.
        values: (N,) outputs.
        slacks: (m,) epsilon for the paper's rule f_u(i) >= y(i), 2 epsilon for Milanese and Novara's.
        worst: (m, 2) is filled with the pair that decides each gamma.

    Returns:
        (m,) gammas; beyond 1e200 where two equal regressors have outputs further apart than the slack.
    """
    n = values.shape[0]
    gammas = np.zeros(slacks.shape[0])
    for i in range(n - 1):
        squared = np.zeros(n - 1 - i)
        for c in range(points.shape[0]):
            gap = points[c, i + 1 :] - points[c, i]
            squared += gap * gap
        distance = np.sqrt(squared)
        rise = np.abs(values[i + 1 :] - values[i])
        for m in range(slacks.shape[0]):
            # 1e-300 and 1e300 keep equal regressors from making 0/0 or infinity; `argmax` would stumble over a NaN.
            needed = np.minimum(np.maximum(rise - slacks[m], 0.0) / np.maximum(distance, 1e-300), 1e300)
            j = int(np.argmax(needed))
            if needed[j] > gammas[m]:
                gammas[m] = needed[j]
                worst[m, 0] = i
                worst[m, 1] = i + 1 + j
    return gammas
