"""Levenberg-Marquardt for a network with two tanh layers and one linear output, with exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from softneck.core import DataError, Matrix, Progress, Vector

# Marquardt's factors: bold after success, careful after failure (Hagan and Menhaj 1994).
_SHRINK, _GROW, _MAX_DAMPING = 0.2, 4.0, 1e10


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Weights of z -> tanh(W1 z + b1) -> tanh(W2 h + b2) -> w3 h + b3."""

    W1: Matrix
    b1: Vector
    W2: Matrix
    b2: Vector
    w3: Vector
    b3: float

    def vector(self) -> Vector:
        """All weights behind each other."""
        return np.concatenate([self.W1.ravel(), self.b1, self.W2.ravel(), self.b2, self.w3, [self.b3]])

    def like(self, weights: Vector) -> Layers:
        """The network of these shapes with other weights."""
        shapes = [self.W1.shape, self.b1.shape, self.W2.shape, self.b2.shape, self.w3.shape]
        edges = np.cumsum([int(np.prod(shape)) for shape in shapes])
        W1, b1, W2, b2, w3 = (p.reshape(s) for p, s in zip(np.split(weights[:-1], edges[:-1]), shapes, strict=True))
        return Layers(W1, b1, W2, b2, w3, float(weights[-1]))

    def output(self, Z: Matrix) -> Vector:
        """Return the outputs (rows,) for inputs (rows, n)."""
        return np.tanh(np.tanh(Z @ self.W1.T + self.b1) @ self.W2.T + self.b2) @ self.w3 + self.b3


def random_layers(n: int, hidden: tuple[int, int], rng: np.random.Generator) -> Layers:
    """Return starting weights scaled to the width of the layer before (Glorot and Bengio 2010)."""
    h1, h2 = hidden
    return Layers(
        rng.standard_normal((h1, n)) / np.sqrt(n),
        0.5 * rng.standard_normal(h1),
        rng.standard_normal((h2, h1)) / np.sqrt(h1),
        0.5 * rng.standard_normal(h2),
        rng.standard_normal(h2) / np.sqrt(h2),
        0.0,
    )


def jacobian(layers: Layers, Z: Matrix) -> tuple[Vector, Matrix]:
    """Return the outputs (rows,) and their derivatives by all weights (rows, weights)."""
    H1 = np.tanh(Z @ layers.W1.T + layers.b1)
    H2 = np.tanh(H1 @ layers.W2.T + layers.b2)
    D2 = (1.0 - H2**2) * layers.w3
    D1 = (D2 @ layers.W2) * (1.0 - H1**2)
    rows = Z.shape[0]
    J = np.hstack(
        [
            (D1[:, :, None] * Z[:, None, :]).reshape(rows, -1),
            D1,
            (D2[:, :, None] * H1[:, None, :]).reshape(rows, -1),
            D2,
            H2,
            np.ones((rows, 1)),
        ]
    )
    return H2 @ layers.w3 + layers.b3, J


def train(
    start: Layers, Z: Matrix, target: Vector, *, iterations: int, decay: float, progress: Progress
) -> tuple[Layers, list[float]]:
    """Minimise `|target - output|^2 + decay |w|^2`; return the network and its cost after each iteration.

    Raises:
        DataError: the cost is not finite, so that the data cannot be learnt from.
    """
    w, damping = start.vector(), 1e-2
    output, J = jacobian(start, Z)
    cost = _cost(target - output, w, decay)
    if not np.isfinite(cost):
        raise DataError("the network's first error is not finite; look for wild values in the recording.")
    history = [cost]
    for iteration in range(iterations):
        progress(iteration / iterations, f"cost {cost:.4g}")
        A, g = J.T @ J, J.T @ (target - output) - decay * w
        trial, trial_cost = w, cost
        while trial_cost >= cost and damping < _MAX_DAMPING:
            trial = w + _solve(A, g, decay + damping)
            trial_cost = _cost(target - start.like(trial).output(Z), trial, decay)
            damping *= _SHRINK if trial_cost < cost else _GROW
        if trial_cost >= cost:
            break
        w, cost, damping = trial, trial_cost, max(damping, 1e-9)
        history.append(cost)
        output, J = jacobian(start.like(w), Z)
    return start.like(w), history


def _solve(A: Matrix, g: Vector, damping: float) -> Vector:
    try:
        return cho_solve(cho_factor(A + damping * np.eye(g.size)), g)
    except LinAlgError:
        return np.zeros_like(g)


def _cost(error: Vector, w: Vector, decay: float) -> float:
    return float(error @ error + decay * (w @ w))
