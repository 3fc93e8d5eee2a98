"""Free runs of a neural state space over prepared inputs, with exact derivatives by all its weights.

Weights stand in the order A, B, E, F, G, h, D, C, c, row by row, for n states, p inputs and q neurons (see
`_nss_map_runtime`). `begin` (time,) says where a state is set: 1 to zero, 2 to the row of `states`.
"""

import numpy as np

from softneck.identification.networks._nss_map_runtime import nss_inputs, nss_next


def nss_signals(redefinition: np.ndarray, widths: np.ndarray, motors: np.ndarray, V: np.ndarray) -> None:
    """Fill `V` (time, c (1 + widths)) with the inputs along `motors` (time, motors); plays come from zero."""
    plays = np.zeros(redefinition.shape[0] * widths.shape[0])
    for k in range(motors.shape[0]):
        nss_inputs(redefinition, widths, motors[k], plays, V[k])


def nss_free(
    w: np.ndarray,
    n: int,
    q: int,
    V: np.ndarray,
    begin: np.ndarray,
    states: np.ndarray,
    gain: np.ndarray,
    measured: np.ndarray,
    seen: np.ndarray,
    Y: np.ndarray,
) -> None:
    """Fill `Y` (time, outputs) with free runs, and `seen` (time, n) with the states behind them.

    With a `gain` (n, outputs) that is not zero each state is corrected by `gain (measured - y)` first, where `measured`
    (time, outputs) is a number, and `seen` holds what it was corrected to.
    """
    p = V.shape[1]
    m = Y.shape[1]
    edge = np.cumsum(np.array([n * n, n * p, n * q, q * n, q * p, q, q * q, m * n]))  # where the matrices end in w
    A = w[: edge[0]].copy().reshape(n, n)
    B = w[edge[0] : edge[1]].copy().reshape(n, p)
    E = w[edge[1] : edge[2]].copy().reshape(n, q)
    F = w[edge[2] : edge[3]].copy().reshape(q, n)
    G = w[edge[3] : edge[4]].copy().reshape(q, p)
    h = w[edge[4] : edge[5]].copy()
    D = w[edge[5] : edge[6]].copy().reshape(q, q)
    C = w[edge[6] : edge[7]].copy().reshape(m, n)
    c = w[edge[7] :].copy()
    x = np.zeros(n)
    ahead = np.zeros(n)
    t = np.empty(q)
    for k in range(V.shape[0]):
        if begin[k] == 1:
            x[:] = 0.0
        elif begin[k] == 2:
            x[:] = states[k]
        # Before it is corrected: the error of Y is that of a prediction.
        for a in range(m):
            total = c[a]
            for i in range(n):
                total += C[a, i] * x[i]
            Y[k, a] = total
        for a in range(m):
            if np.isfinite(measured[k, a]):  # NaN: nothing measured, the state runs free
                for i in range(n):
                    x[i] += gain[i, a] * (measured[k, a] - Y[k, a])
        seen[k] = x
        nss_next(A, B, E, F, G, h, D, x, V[k], t, ahead)
        x[:] = ahead


def nss_sensitivities(
    w: np.ndarray,
    n: int,
    q: int,
    V: np.ndarray,
    begin: np.ndarray,
    states: np.ndarray,
    gain: np.ndarray,
    measured: np.ndarray,
    rows: np.ndarray,
    Y: np.ndarray,
    J: np.ndarray,
) -> None:
    """As `nss_free`; where `rows` (time,) is r >= 0, J[m r] .. are dy(k)/dw of the m outputs."""
    p = V.shape[1]
    m = Y.shape[1]
    edge = np.cumsum(np.array([n * n, n * p, n * q, q * n, q * p, q, q * q, m * n]))
    A = w[: edge[0]].copy().reshape(n, n)
    B = w[edge[0] : edge[1]].copy().reshape(n, p)
    E = w[edge[1] : edge[2]].copy().reshape(n, q)
    F = w[edge[2] : edge[3]].copy().reshape(q, n)
    G = w[edge[3] : edge[4]].copy().reshape(q, p)
    h = w[edge[4] : edge[5]].copy()
    D = w[edge[5] : edge[6]].copy().reshape(q, q)
    C = w[edge[6] : edge[7]].copy().reshape(m, n)
    c = w[edge[7] :].copy()
    last = int(edge[6])
    inner = w.shape[0] if np.isfinite(measured).any() else last  # C and c move the state only where it is corrected
    x = np.zeros(n)
    ahead = np.zeros(n)
    t = np.empty(q)
    slope = np.empty((n, n))
    R = np.empty((n, q))
    S = np.zeros((n, inner))
    moved = np.zeros((n, inner))
    by = np.empty((m, w.shape[0]))
    for k in range(V.shape[0]):
        if begin[k] == 1:
            x[:] = 0.0
            S[:] = 0.0  # a state that is set depends on no weight
        elif begin[k] == 2:
            x[:] = states[k]
            S[:] = 0.0
        r = rows[k]
        for a in range(m):
            total = c[a]
            for i in range(n):
                total += C[a, i] * x[i]
            Y[k, a] = total
            # Rows that nobody asked for move S all the same, below.
            if r >= 0 or np.isfinite(measured[k, a]):
                line = by[a]
                line[:] = 0.0
                # dy/dw = C dx/dw, and C and c by themselves.
                for i in range(n):
                    weight = C[a, i]
                    for l in range(inner):
                        line[l] += weight * S[i, l]
                    line[last + a * n + i] += x[i]
                line[last + m * n + a] += 1.0
                if r >= 0:
                    J[m * r + a] = line
        for a in range(m):
            if np.isfinite(measured[k, a]):
                for i in range(n):
                    x[i] += gain[i, a] * (measured[k, a] - Y[k, a])
                    for l in range(inner):
                        S[i, l] -= gain[i, a] * by[a, l]
        nss_next(A, B, E, F, G, h, D, x, V[k], t, ahead)
        # R: how the sums into the neurons, those behind each of them included, move the state.
        for i in range(n):
            # The last neuron first: an earlier one moves the state also by way of all behind it (D is triangular).
            for j in range(q - 1, -1, -1):
                total = E[i, j]
                for l in range(j + 1, q):
                    total += R[i, l] * D[l, j]
                R[i, j] = total * (1.0 - t[j] * t[j])  # tanh' = 1 - tanh^2
        # dx(k+1)/dx(k) = A + R F.
        for i in range(n):
            for j in range(n):
                slope[i, j] = A[i, j]
                for l in range(q):
                    slope[i, j] += R[i, l] * F[l, j]
        for i in range(n):
            row = moved[i]
            # dx(k+1)/dw: by way of x(k), then each weight by itself, in the order of w.
            row[:] = 0.0
            for j in range(n):
                weight = slope[i, j]
                for l in range(inner):
                    row[l] += weight * S[j, l]
            for j in range(n):
                row[i * n + j] += x[j]
            for j in range(p):
                row[edge[0] + i * p + j] += V[k, j]
            for j in range(q):
                row[edge[1] + i * q + j] += t[j]
                for l in range(n):
                    row[edge[2] + j * n + l] += R[i, j] * x[l]
                for l in range(p):
                    row[edge[3] + j * p + l] += R[i, j] * V[k, l]
                row[edge[4] + j] += R[i, j]
                for l in range(j):
                    row[edge[5] + j * q + l] += R[i, j] * t[l]
        S, moved = moved, S
        x[:] = ahead
