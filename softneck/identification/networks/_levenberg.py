"""Levenberg-Marquardt for a network with two tanh layers and one linear output, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from softneck.core import DataError, Matrix, Progress, Vector

# Marquardt's factors: bold after success, careful after failure (Hagan and Menhaj 1994).
_SHRINK, _GROW, _MAX_DAMPING = 0.2, 4.0, 1e10


class Errors(Protocol):
    """What `levenberg` minimises: errors (rows,) at w and, when asked for, derivatives (rows, w) of the model."""

    def __call__(self, w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]: ...


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

    def hidden(self, Z: Matrix) -> tuple[Matrix, Matrix]:
        """Return the values of both layers (rows, hidden) for inputs (rows, n)."""
        first = np.tanh(Z @ self.W1.T + self.b1)
        return first, np.tanh(first @ self.W2.T + self.b2)

    def output(self, Z: Matrix) -> Vector:
        """Return the outputs (rows,) for inputs (rows, n)."""
        return self.hidden(Z)[1] @ self.w3 + self.b3


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
    H1, H2 = layers.hidden(Z)
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

    def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
        if not derivatives:
            return target - start.like(w).output(Z), None
        output, J = jacobian(start.like(w), Z)
        return target - output, J

    history: list[float] = []

    def seen(_w: Vector, cost: float) -> bool:
        progress(min(len(history) / iterations, 1.0), f"cost {cost:.4g}")
        history.append(cost)
        return True

    w = levenberg(errors, start.vector(), iterations=iterations, decay=decay, seen=seen)
    return start.like(w), history


def levenberg(
    errors: Errors, start: Vector, *, iterations: int, decay: float, seen: Callable[[Vector, float], bool]
) -> Vector:
    """Minimise `|errors(w)|^2 + decay |w|^2` over w by Levenberg and Marquardt; return the last w.

    Args:
        errors: returns the errors and, when asked for, the derivatives of what was subtracted in them.
        start: the first w.
        iterations: at most so many steps.
        decay: weight of the squared parameters.
        seen: called with w and its cost, first of all with the start; False ends the search.

    Raises:
        DataError: the first cost is not finite, so that the data cannot be learnt from.
    """
    w, damping = start, 1e-2
    error, J = errors(w, derivatives=True)
    cost = _cost(error, w, decay)
    if not np.isfinite(cost):
        raise DataError("the network's first error is not finite; look for wild values in the recording.")
    if not seen(w, cost):
        return w
    for _ in range(iterations):
        if J is None:
            raise ValueError("`errors` returned no derivatives")
        A, g = J.T @ J, J.T @ error - decay * w
        trial, trial_cost = w, cost
        # A cost that is not finite is no improvement either: the step is shortened until it is.
        while not trial_cost < cost and damping < _MAX_DAMPING:
            trial = w + _solve(A, g, decay + damping)
            trial_cost = _cost(errors(trial, derivatives=False)[0], trial, decay)
            damping *= _SHRINK if trial_cost < cost else _GROW
        if not trial_cost < cost:
            break
        w, cost, damping = trial, trial_cost, max(damping, 1e-9)
        if not seen(w, cost):
            break
        error, J = errors(w, derivatives=True)
    return w


def _solve(A: Matrix, g: Vector, damping: float) -> Vector:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        return cho_solve(cho_factor(A + damping * np.eye(g.size)), g)
    except LinAlgError:
        return np.zeros_like(g)


def _cost(error: Vector, w: Vector, decay: float) -> float:
    return float(error @ error + decay * (w @ w))
