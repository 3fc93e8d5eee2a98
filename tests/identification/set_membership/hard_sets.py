"""The oracle of set membership, and the data that trees get wrong."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st


def algorithm_1(x: np.ndarray, omega: np.ndarray, y: np.ndarray, gamma: float, epsilon: float) -> tuple[float, float]:
    """Algorithm 1 line by line; omega is (N, n)."""
    f_u, f_l = np.inf, -np.inf
    for k in range(len(y)):
        distance = sum((x[i] - omega[k][i]) ** 2 for i in range(len(x))) ** 0.5
        P_u = y[k] + epsilon + gamma * distance
        P_l = y[k] - epsilon - gamma * distance
        if P_u <= f_u:
            f_u = P_u
        if P_l >= f_l:
            f_l = P_l
    return f_l, f_u


@st.composite
def hard_sets(draw: st.DrawFn, *, least: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """What trees get wrong: clusters, duplicates, collinear points, ties, huge and tiny scales, a few leaves deep."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    rows, n = draw(st.integers(least, 200)), draw(st.integers(1, 11))
    shape = draw(st.sampled_from(["normal", "clusters", "duplicates", "line", "ties", "one point"]))
    W = rng.standard_normal((rows, n))
    if shape == "clusters":
        W = 1e-3 * W + rng.integers(0, 3, (rows, 1)) * 100.0
    elif shape == "duplicates":
        W = W[rng.integers(0, max(rows // 5, 1), rows)]
    elif shape == "line":
        W = rng.standard_normal((rows, 1)) * rng.standard_normal(n)
    elif shape == "ties":
        W = rng.integers(-1, 2, (rows, n)).astype(float)
    elif shape == "one point":
        W = np.tile(W[:1], (rows, 1))
    scale = draw(st.sampled_from([1.0, 1e-100, 1e-9, 1e9, 1e100]))
    y = rng.integers(-2, 3, rows).astype(float) if draw(st.booleans()) else rng.standard_normal(rows)
    return W * scale, y
