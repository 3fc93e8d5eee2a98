"""Simulation of one axis of the NLARX network over prepared regressors, with exact derivatives by all weights.

Row k of `Z` (time, n) is the scaled regressor of y(k); its first columns, past outputs by `lags` (f,), are filled in
here: `z_j = shift_j + gain_j y(k - lag_j)` of the scaled output y. Weights stand in the order W1, b1, W2, b2, w3, b3,
row by row.
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
    by: np.ndarray,
) -> None:
    """Fill `g` with the derivatives by all weights, `by` (f,) with those by the first of z; `back` (h1,) is scratch."""
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
    by[:] = 0.0
    for i in range(h1):
        d = (1.0 - first[i] * first[i]) * back[i]
        g[b1 + i] = d
        # The first columns of W1 belong to past outputs: these are what free runs feed back.
        for j in range(by.shape[0]):
            by[j] += d * w[i * n + j]
        for j in range(n):
            g[i * n + j] = d * z[j]


def nn_free(
    w: np.ndarray,
    h1: int,
    h2: int,
    Z: np.ndarray,
    lags: np.ndarray,
    starts: np.ndarray,
    shift: np.ndarray,
    gain: np.ndarray,
    y: np.ndarray,
) -> None:
    """Fill `y` (time,) by simulation; a number in `starts` (time, f) replaces the simulated past output."""
    first = np.empty(h1)
    second = np.empty(h2)
    z = np.empty(Z.shape[1])
    for k in range(Z.shape[0]):
        z[:] = Z[k]
        for j in range(lags.shape[0]):
            # NaN: the simulation continues from its own output.
            past = starts[k, j] if np.isfinite(starts[k, j]) else y[k - lags[j]]
            z[j] = shift[j] + gain[j] * past
        y[k] = nn_scalar(w, h1, h2, z, first, second)


def nn_sensitivities(
    w: np.ndarray,
    h1: int,
    h2: int,
    Z: np.ndarray,
    lags: np.ndarray,
    starts: np.ndarray,
    shift: np.ndarray,
    gain: np.ndarray,
    thin: int,
    y: np.ndarray,
    J: np.ndarray,
) -> None:
    """As `nn_free`, with the derivative of y(r thin) along its simulation in row r of `J` (time / thin, weights)."""
    first = np.empty(h1)
    second = np.empty(h2)
    back = np.empty(h1)
    z = np.empty(Z.shape[1])
    g = np.empty(w.shape[0])
    by = np.empty(lags.shape[0])
    # dy/dw of the last samples: that of y(k) is in row k modulo their number.
    kept = int(lags.max())
    S = np.zeros((kept, w.shape[0]))
    for k in range(Z.shape[0]):
        z[:] = Z[k]
        for j in range(lags.shape[0]):
            past = starts[k, j] if np.isfinite(starts[k, j]) else y[k - lags[j]]
            z[j] = shift[j] + gain[j] * past
        y[k] = nn_scalar(w, h1, h2, z, first, second)
        # dy_k = df/dw + sum_j df/dz_j gain_j dy_(k-lag_j).
        nn_gradient(w, h1, h2, z, first, second, back, g, by)
        for j in range(lags.shape[0]):
            if np.isfinite(starts[k, j]):
                continue  # a measurement depends on no weight
            slope = gain[j] * by[j]
            s = S[(k - lags[j]) % kept]
            for i in range(w.shape[0]):
                g[i] = g[i] + slope * s[i]
        S[k % kept] = g
        if k % thin == 0:
            J[k // thin] = g
