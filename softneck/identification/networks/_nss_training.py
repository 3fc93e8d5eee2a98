"""Training of a neural state space: from the linear output-error model, its states whitened, by Levenberg-Marquardt.

The windows that it is trained over grow to the whole free run.

Maps that contract, by parameters without any bound: whatever training does, two free runs draw together.

`x+ = A x + E t + ...`, `t = tanh(F x + D t + ...)`, D strictly lower triangular: each neuron sees those before it. With
any X and Y, H = X X' + eps I in blocks of n, q and n rows, and a rate r < 1 (Revay, Wang and Manchester 2024,
"Recurrent equilibrium networks", sec. V, contracting and acyclic):

`M = (H11 + H33 / r^2 + Y - Y') / 2`, `L = diag(H22) / 2`, `A = M^-1 H31`, `E = M^-1 H32`, `F = -L^-1 H21`,
`D = -L^-1 tril(H22)`.

The distance of two states under the same inputs, measured by `M' H33^-1 M`, then falls by r in each step: tanh has
slopes from 0 to 1, which H weighs by L (Schur complement and S-procedure).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import Recording, redefine

from ..linear._oe import OutputErrorFit, default_starts, fit_output_error, pole_radius
from ..models._directions import Directions
from ..models._drive import LoadedDrive, drive_start
from ._nn_training import levenberg
from ._nss_problem import FUNCTIONS, Inputs, Records, Shape, free_run, observed

# Keeps H positive definite beyond rounding; its entries are of order one.
_LEAST = 1e-6
# A start this far inside the bound leaves all derivatives alive.
_INSIDE = 1e-3


@dataclass(frozen=True, slots=True)
class Contraction:
    """Parameters of contracting maps.

    Attributes:
        states: n.
        neurons: q.
        rate: r, by which distances fall in each step.
    """

    states: int
    neurons: int
    rate: float

    @property
    def size(self) -> int:
        """Number of parameters: X lower triangular, row by row, then Y below its diagonal."""
        n, side = self.states, 2 * self.states + self.neurons
        return side * (side + 1) // 2 + n * (n - 1) // 2

    def matrices(self, theta: Vector) -> dict[str, Matrix]:
        """Return A (n, n), E (n, q), F (q, n) and D (q, q)."""
        H, M = self._blocks(theta)
        return self._solved(H, M)

    def derivatives(self, theta: Vector) -> dict[str, np.ndarray]:
        """Return the derivatives of A, E, F and D by all parameters, (size, rows, columns) each."""
        n, side = self.states, 2 * self.states + self.neurons
        X, _ = self._parts(theta)
        H, M = self._blocks(theta)
        now = self._solved(H, M)
        rows, columns = np.tril_indices(side)
        dH = np.zeros((self.size, side, side))
        each = np.arange(rows.size)
        # d(X X') by X_ij is e_i x_j' + x_j e_i', x_j the column j.
        dH[each, rows, :] += X[:, columns].T
        dH[each, :, rows] += X[:, columns].T
        dM = (dH[:, :n, :n] + dH[:, -n:, -n:] / self.rate**2) / 2.0
        below = np.tril_indices(n, -1)
        for number, (i, j) in enumerate(zip(*below, strict=True), start=rows.size):
            dM[number, i, j], dM[number, j, i] = 0.5, -0.5
        inverse = np.linalg.inv(M)
        L = np.diag(H)[n:-n] / 2.0
        dL = np.diagonal(dH[:, n:-n, n:-n], axis1=1, axis2=2)[:, :, None] / 2.0
        return {
            "A": inverse @ (dH[:, -n:, :n] - dM @ now["A"]),
            "E": inverse @ (dH[:, -n:, n:-n] - dM @ now["E"]),
            "F": -(dH[:, n:-n, :n] + dL * now["F"]) / L[:, None],
            "D": -(np.tril(dH[:, n:-n, n:-n], -1) + dL * now["D"]) / L[:, None],
        }

    def start(self, A: Matrix, F: Matrix) -> Vector:
        """Return parameters of `A`, whose norm is below the rate, and of neurons that see `F x` and do nothing yet.

        F may be made smaller.
        """
        from scipy.linalg import cholesky

        n, q, r = self.states, self.neurons, self.rate
        # M = I. With H33 = I a norm up to sqrt(2 - 1/r^2) has room; with H33 = |A| r I any norm below r, 2 (1 - |A|/r).
        for h in (1.0, r * float(np.linalg.norm(A, 2))):
            H11 = (2.0 - h / r**2) * np.eye(n)
            room = float(np.linalg.eigvalsh(H11 - A.T @ A / h).min())
            if room > 10.0 * _LEAST:
                break
        # Of the room that A leaves, the neurons take half: `F' L F / 2`.
        weight = room / max(float(np.linalg.norm(F, 2)) ** 2, 1e-12)
        H = np.zeros((2 * n + q, 2 * n + q))
        H[:n, :n], H[n:-n, n:-n], H[-n:, -n:] = H11, 2.0 * weight * np.eye(q), h * np.eye(n)
        H[n:-n, :n], H[-n:, :n] = -weight * F, A
        H = np.tril(H) + np.tril(H, -1).T
        X = cholesky(H - _LEAST * np.eye(len(H)), lower=True)
        return np.concatenate([X[np.tril_indices(len(H))], np.zeros(n * (n - 1) // 2)])

    def _parts(self, theta: Vector) -> tuple[Matrix, Matrix]:
        n, side = self.states, 2 * self.states + self.neurons
        X, Y = np.zeros((side, side)), np.zeros((n, n))
        count = side * (side + 1) // 2
        X[np.tril_indices(side)] = theta[:count]
        Y[np.tril_indices(n, -1)] = theta[count:]
        return X, Y

    def _blocks(self, theta: Vector) -> tuple[Matrix, Matrix]:
        X, Y = self._parts(theta)
        n = self.states
        H = X @ X.T + _LEAST * np.eye(len(X))
        return H, (H[:n, :n] + H[-n:, -n:] / self.rate**2 + Y - Y.T) / 2.0

    def _solved(self, H: Matrix, M: Matrix) -> dict[str, Matrix]:
        n = self.states
        L = np.diag(H)[n:-n, None] / 2.0
        return {
            "A": np.linalg.solve(M, H[-n:, :n]),
            "E": np.linalg.solve(M, H[-n:, n:-n]),
            "F": -H[n:-n, :n] / L,
            "D": -np.tril(H[n:-n, n:-n], -1) / L,
        }


def whitening(A: Matrix, covariance: Matrix, rate: float) -> Matrix:
    """Return T (n, n), lower triangular, so that `T^-1 A T` has a norm below `rate` and states `T^-1 x` are white.

    T is the Cholesky factor of the states' covariance P, where that is a Lyapunov matrix, `P > A P A' / rate^2`; else
    of the smallest change of its driving noise that makes it one.

    Args:
        A: its poles are within `rate`.
        covariance: (n, n) P of the states.
        rate: below 1.
    """
    from scipy.linalg import cholesky, solve_discrete_lyapunov

    scaled = A / rate
    noise = covariance - scaled @ covariance @ scaled.T
    values, vectors = np.linalg.eigh((noise + noise.T) / 2.0)
    floor = _INSIDE * float(np.trace(covariance)) / len(A)
    P = solve_discrete_lyapunov(scaled, (vectors * np.maximum(values, floor)) @ vectors.T)
    return cholesky((P + P.T) / 2.0, lower=True)


# Dead times of the sensor to try [samples]; what is longer hides in the poles.
_DELAYS = (0, 1, 2, 3, 4)
# Of other robots, in the time of a neck [s].
_LATE = (0.0, 0.02, 0.04, 0.06, 0.08, 0.12, 0.2, 0.4)
_WORTH = 1.1
# Co-contraction stiffens, and compresses more slowly than the neck bends [1/s].
_COCONTRACTION_RATE = 1.5
# A pole beyond this remembers for longer than a window [s].
_SLOWEST = 5.0
# A slower pole of the linear model is a drift; training starts from one that is not [s].
_SLOWEST_START = 2.0
# What the observer behind windows takes for granted: errors of state and of output, in parts of their spread.
_STATE_NOISE, _OUTPUT_NOISE = 0.05, 0.01


def linear_start(
    recording: Recording, drive: LoadedDrive, directions: Directions, order: int
) -> tuple[list[OutputErrorFit], int]:
    """Return the output-error models of all axes from simulated motors, and the dead time of the least cost.

    Raises:
        DataError: no stable model.
    """
    axes: list[list[tuple[Vector, Vector]]] = [[] for _ in directions.names]
    for run in recording.runs():
        motors = drive.simulate(run.set_points, drive_start(run))
        U = redefine(motors) if recording.robot.is_neck else motors @ directions.weights.T
        for axis in range(len(axes)):
            if np.isfinite(run.outputs[:, axis]).any():
                axes[axis].append((U[:, axis], run.outputs[:, axis]))
    for axis, runs in enumerate(axes):
        middle = np.nanmean(np.concatenate([y for _, y in runs]))
        rest = np.mean(np.concatenate([u for u, _ in runs]))
        axes[axis] = [(np.ascontiguousarray(u - rest), y - middle) for u, y in runs]
    tried: list[tuple[float, int, list[OutputErrorFit]]] = []
    # In the time of a neck: what starts from time constants starts from the robot's.
    starts = default_starts(order, recording.sample_time / directions.stretch, None)
    for delay in _DELAYS if recording.robot.is_neck else _late(recording.sample_time / directions.stretch):
        fits = [fit_output_error(runs, order, order, delay, starts) for runs in axes]
        found = [fit for fit in fits if fit is not None]
        if len(found) < len(axes):
            continue
        cost = sum(fit.cost / max(_power(runs), 1e-12) for fit, runs in zip(found, axes, strict=True))
        tried.append((cost, delay, found))
    if not tried:
        raise DataError("no stable linear model to start from; record with more excitation.")
    least = min(cost for cost, _, _ in tried)
    # Of another robot the shortest that is as good: a linear model takes what bends for dead time.
    worth = 1.0 if recording.robot.is_neck else _WORTH
    _, delay, fits = next(one for one in tried if one[0] <= worth * least)
    return fits, delay


def largest_rate(sample_time: float) -> float:
    """Return by what at least the distance of two states falls in each step: what was is forgotten in seconds."""
    return float(np.exp(-sample_time / _SLOWEST))


def _late(sample_time: float) -> list[int]:
    """Return dead times to try for another robot, up to twice its time constant."""
    return sorted({round(late / sample_time) for late in _LATE})


def _power(runs: list[tuple[Vector, Vector]]) -> float:
    return float(sum(np.nansum(y**2) for _, y in runs))


def whitened(fits: list[OutputErrorFit], records: Records, made: Inputs, neurons: int) -> tuple[Shape, Vector, Matrix]:
    """Return shape, weights without neurons, and an observer's gain (n, outputs), states of unit covariance.

    States are those of all axes and one for each input that moves none of them (a neck's co-contraction), which no
    output shows yet.
    """
    from scipy.linalg import block_diag, solve_discrete_are

    scales = records.scales
    chain = 1 + made.widths.size
    shares = made.directions.shares(made.redefinition)
    outputs, beside = len(fits), range(made.directions.independent, len(made.redefinition))
    parts = [_observer_form(fit, np.exp(-records.sample_time / _SLOWEST_START)) for fit in fits]
    slow = np.exp(-_COCONTRACTION_RATE * records.sample_time)
    A = np.asarray(block_diag(*(F for F, _ in parts), *(slow for _ in beside)))
    n = len(A)
    B, C = np.zeros((n, scales.inputs.size)), np.zeros((outputs, n))
    at = 0
    for axis, (F, g) in enumerate(parts):
        for c, share in enumerate(shares[axis]):
            B[at : at + len(F), c * chain] = g * share * scales.inputs[c * chain] / scales.outputs[axis]
        C[axis, at] = 1.0
        at += len(F)
    for i, c in enumerate(beside):
        B[at + i, c * chain] = 1.0 - slow
    shape = Shape(n, scales.inputs.size, neurons, outputs)
    w = shape.vector({name: np.zeros(size) for name, size in shape.shapes.items()} | {"A": A, "B": B, "C": C})
    Y, X = free_run(shape, w, records, np.zeros((n, outputs)))
    states = X[records.own]
    P = np.atleast_2d(np.cov(states, rowvar=False))
    L = whitening(A, P, 0.9999 * largest_rate(records.sample_time))
    inverse = np.linalg.inv(L)
    arrays = shape.arrays(w) | {"A": inverse @ A @ L, "B": inverse @ B, "C": C @ L}
    arrays["c"] = np.nanmean((records.outputs - Y)[records.settled], axis=0)
    Q, R = _STATE_NOISE**2 * np.eye(n), _OUTPUT_NOISE**2 * np.eye(outputs)
    P = np.asarray(solve_discrete_are(arrays["A"].T, arrays["C"].T, Q, R))
    gain = P @ arrays["C"].T @ np.linalg.inv(arrays["C"] @ P @ arrays["C"].T + R)
    return shape, shape.vector(arrays), gain


def _observer_form(fit: OutputErrorFit, radius: float) -> tuple[Matrix, Vector]:
    """Return A (n, n) and B (n,) of one axis, its output the first state, its poles drawn within `radius`."""
    drawn = min(1.0, radius / max(pole_radius(fit.f), 1e-9))
    F = np.eye(fit.f.size, k=1)
    F[:, 0] = -fit.f * drawn ** np.arange(1, fit.f.size + 1)
    return F, fit.b


# Windows [s], from one sample over the neck's time constant to many of them; the whole free run comes last.
WINDOWS = (0.0, 0.2, 1.0, 5.0, None)
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
        Y, _ = free_run(training.shape, training.weights(theta), self.hold_out, training.gain)
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
        gain: (n, outputs) of the observer that starts windows.
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
        chosen = records.learnt
        rows = np.full(begin.size, -1, dtype=np.int64)
        rows[chosen] = np.arange(chosen.size)
        y = records.outputs[chosen].ravel()
        there = np.isfinite(y)
        low, high = records.limits.T
        Y, seen_states = np.empty(records.outputs.shape), np.empty((begin.size, n))
        J = np.empty((y.size, int(self.shape.vector_size)))

        def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
            parameters = self.base + w
            call = (self.weights(parameters), n, q, records.inputs, begin, states)
            if derivatives:
                functions.nss_sensitivities(*call, self.gain, records.told, rows, Y, J)
            else:
                functions.nss_free(*call, self.gain, records.told, seen_states, Y)
            shown = np.clip(Y[chosen], low, high).ravel()
            error = np.where(there, y - shown, 0.0)
            if derivatives:
                J[~there | (shown != Y[chosen].ravel())] = 0.0  # what is beyond a sensor's limit is not seen
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
