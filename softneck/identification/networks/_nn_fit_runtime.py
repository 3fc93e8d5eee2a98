"""Free runs of one axis of the NLARX network over prepared regressors, with exact derivatives by all weights.

Row k of `Z` (time, n) is the scaled regressor of y(k); its first column, the last output, is filled in here:
`z_0 = shift + gain y` of the scaled output y. Weights stand in the order W1, b1, W2, b2, w3, b3, row by row.
"""

import math

import numpy as np


def nn_scalar(w: np.ndarray, h1: int, h2: int, z: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Return the output for the regressor `z` (n,); the two layers' values go to `first` and `second`."""
    n = z.shape[0]
    at = 0
    for i in range(h1):
        total = w[h1 * n + i]  # offsets stand behind all weights of their layer
        for j in range(n):
            total += w[at] * z[j]
            at += 1
        first[i] = math.tanh(total)
    at = h1 * n + h1
    for i in range(h2):
        total = w[h1 * n + h1 + h2 * h1 + i]
        for j in range(h1):
            total += w[at] * first[j]
            at += 1
        second[i] = math.tanh(total)
    at = h1 * n + h1 + h2 * h1 + h2
    y = float(w[at + h2])
    for i in range(h2):
        y += w[at + i] * second[i]
    return y


def nn_gradient(
    w: np.ndarray,
    h1: int,
    h2: int,
    z: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    back: np.ndarray,
    g: np.ndarray,
) -> float:
    """Fill `g` with the derivatives by all weights; return the derivative by z_0. `back` (h1,) is scratch."""
    n = z.shape[0]
    b1 = h1 * n
    W2 = b1 + h1
    b2 = W2 + h2 * h1
    w3 = b2 + h2
    # Reverse, layer by layer: `back` gathers what each neuron of the first layer does to y by way of the second.
    back[:] = 0.0
    g[w3 + h2] = 1.0
    for i in range(h2):
        g[w3 + i] = second[i]
        # tanh' = 1 - tanh^2, from the value that is known.
        d = (1.0 - second[i] * second[i]) * w[w3 + i]
        g[b2 + i] = d
        for j in range(h1):
            g[W2 + i * h1 + j] = d * first[j]
            back[j] += d * w[W2 + i * h1 + j]
    by_first = 0.0
    for i in range(h1):
        d = (1.0 - first[i] * first[i]) * back[i]
        g[b1 + i] = d
        # Column 0 of W1 belongs to the last output: this is what free runs feed back.
        by_first += d * w[i * n]
        for j in range(n):
            g[i * n + j] = d * z[j]
    return by_first


def nn_free(
    w: np.ndarray, h1: int, h2: int, Z: np.ndarray, starts: np.ndarray, shift: float, gain: float, y: np.ndarray
) -> None:
    """Fill `y` (time,) with free runs; where `starts` is a number the last output is that, a measured one."""
    first = np.empty(h1)
    second = np.empty(h2)
    z = np.empty(Z.shape[1])
    last = 0.0
    for k in range(Z.shape[0]):
        # NaN: the free run goes on from its own output.
        if np.isfinite(starts[k]):
            last = starts[k]
        z[:] = Z[k]
        z[0] = shift + gain * last
        last = nn_scalar(w, h1, h2, z, first, second)
        y[k] = last


def nn_sensitivities(
    w: np.ndarray,
    h1: int,
    h2: int,
    Z: np.ndarray,
    starts: np.ndarray,
    shift: float,
    gain: float,
    thin: int,
    y: np.ndarray,
    J: np.ndarray,
) -> None:
    """As `nn_free`, and row r of `J` (time / thin, weights) is the derivative of y(r thin) along its free run."""
    first = np.empty(h1)
    second = np.empty(h2)
    back = np.empty(h1)
    z = np.empty(Z.shape[1])
    g = np.empty(w.shape[0])
    s = np.zeros(w.shape[0])
    last = 0.0
    for k in range(Z.shape[0]):
        if np.isfinite(starts[k]):
            last = starts[k]
            s[:] = 0.0  # a measurement depends on no weight
        z[:] = Z[k]
        z[0] = shift + gain * last
        last = nn_scalar(w, h1, h2, z, first, second)
        # dy_k = df/dw + df/dy dy_(k-1), with z_0 = shift + gain y.
        slope = gain * nn_gradient(w, h1, h2, z, first, second, back, g)
        for i in range(w.shape[0]):
            s[i] = g[i] + slope * s[i]
        y[k] = last
        if k % thin == 0:
            J[k // thin] = s
