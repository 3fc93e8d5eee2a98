"""Training of a neural state space: Levenberg-Marquardt over windows that grow to the whole free run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions

from ._contraction import Contraction
from ._levenberg import levenberg
from ._nss_problem import FUNCTIONS, Records, Shape, free_run, observed

# Windows [s], from one sample over the neck's time constant to many of them; the whole free run comes last.
WINDOWS = (0.0, 0.2, 1.0, 5.0, None)
# A row is learnt from every so often [s]: a quarter of the neck's time constant.
_EVERY = 0.06
# Weights that no contraction binds, in their order behind its parameters.
_FREE = ("B", "G", "h", "C", "c")


@dataclass
class BestMap:
    """The best parameters so far by the free run on the hold-out; `stop` ends the search and keeps them."""

    hold_out: Records
    tell: Callable[[str], None]
    stop: Callable[[], bool]
    theta: Vector | None = None
    fit: float = -np.inf

    def see(self, training: Training, theta: Vector, cost: float, what: str) -> bool:
        """Judge parameters; return whether to go on."""
        Y, _ = free_run(training.shape, training.weights(theta), self.hold_out)
        fit = self.hold_out.fit(Y)
        if self.theta is None or fit > self.fit:
            self.theta, self.fit = theta, fit
        self.tell(f"{what}, loss {cost:.4g}, hold-out {self.fit:.1f} %")
        return not self.stop()


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """What one start is trained with.

    Attributes:
        shape: of the map.
        contraction: whose parameters give A, E, F and D.
        gain: (n, 2) of the observer that starts windows.
        records: rows to learn from.
        decay: weight of the squared distance to `base` beside the squared errors of scaled outputs.
        base: what parameters are drawn to: the linear model, with neurons that see no inputs.
    """

    shape: Shape
    contraction: Contraction
    gain: Matrix
    records: Records
    decay: float
    base: Vector

    def search(self, theta: Vector, seconds: float | None, iterations: int, best: BestMap, what: str) -> Vector:
        """Minimise the errors of free runs over windows of `seconds`, each started by the observer; None is one run."""
        records, functions = self.records, load_functions(FUNCTIONS)
        n, q = self.shape.states, self.shape.neurons
        begin, states = records.first.astype(np.int64), np.zeros((1, n))
        if seconds is not None:
            # A window starts from a measured state: the shortest foretells one sample from it.
            length = max(round(seconds / records.sample_time), 2)
            states = observed(self.shape, self.weights(theta), records, self.gain)
            begin[(begin == 0) & (np.arange(begin.size) % length == 0)] = 2
        chosen = np.flatnonzero(records.settled)[:: max(round(_EVERY / records.sample_time), 1)]
        rows = np.full(begin.size, -1, dtype=np.int64)
        rows[chosen] = np.arange(chosen.size)
        y = records.outputs[chosen].ravel()
        there = np.isfinite(y)
        Y, seen_states = np.empty(records.outputs.shape), np.empty((begin.size, n))
        J = np.empty((y.size, int(self.shape.vector_size)))
        still, unseen = np.zeros((n, 2)), np.full(records.outputs.shape, np.nan)

        def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
            parameters = self.base + w
            call = (self.weights(parameters), n, q, records.inputs, begin, states)
            if derivatives:
                functions.nss_sensitivities(*call, rows, Y, J)
                J[~there] = 0.0
            else:
                functions.nss_free(*call, still, unseen, seen_states, Y)
            error = np.where(there, y - Y[chosen].ravel(), 0.0)
            return error, self.chained(parameters, J) if derivatives else None

        def seen(w: Vector, cost: float) -> bool:
            return best.see(self, self.base + w, cost, what)

        found = levenberg(errors, theta - self.base, iterations=iterations, decay=self.decay, seen=seen)
        return self.base + found

    def weights(self, theta: Vector) -> Vector:
        """Return the map's weights for all parameters: those of the contraction, then B, G, h, C and c."""
        at = self.contraction.size
        arrays = self.contraction.matrices(theta[:at])
        for name in _FREE:
            shape = self.shape.shapes[name]
            size = int(np.prod(shape))
            arrays[name] = theta[at : at + size].reshape(shape)
            at += size
        return self.shape.vector(arrays)

    def chained(self, theta: Vector, J: Matrix) -> Matrix:
        """Return derivatives by all parameters from `J` (rows, w), those by the weights."""
        columns = self.shape.columns(J)
        by = self.contraction.derivatives(theta[: self.contraction.size])
        inner = np.hstack([columns[name] for name in by])
        chain = np.hstack([derivative.reshape(self.contraction.size, -1) for derivative in by.values()])
        return np.hstack([inner @ chain.T, *(columns[name] for name in _FREE)])


def random_start(
    linear: dict[str, Matrix], shape: Shape, contraction: Contraction, rng: np.random.Generator
) -> tuple[Vector, Vector]:
    """Return parameters whose neurons do nothing yet: the linear model's, and random F, G and h; and their base."""
    n, p, q = shape.states, shape.inputs, shape.neurons
    F = rng.standard_normal((q, n)) / np.sqrt(n + p)
    sees = np.concatenate([rng.standard_normal(q * p) / np.sqrt(n + p), 0.5 * rng.standard_normal(q)])
    head = np.concatenate([contraction.start(linear["A"], F), linear["B"].ravel()])
    tail = np.concatenate([linear["C"].ravel(), linear["c"]])
    return np.concatenate([head, sees, tail]), np.concatenate([head, np.zeros_like(sees), tail])


def train_start(training: Training, theta: Vector, best: BestMap, iterations: Sequence[int], name: str) -> None:
    """Train one start over all windows; `best` keeps what runs free best."""
    for seconds, steps in zip(WINDOWS, iterations, strict=True):
        if steps and not (best.theta is not None and best.stop()):
            what = (
                "whole free run" if seconds is None else f"windows of {max(seconds, training.records.sample_time):g} s"
            )
            theta = training.search(theta, seconds, steps, best, f"{name}, {what}")
