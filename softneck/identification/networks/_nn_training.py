"""Training of one axis of the NLARX network: series-parallel, then over growing windows of free run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._scores import nrmse_fit

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


FUNCTIONS = "softneck.identification.networks._nn_fit_runtime"
# A row is learnt from so often, every third at 20 ms: neighbours say the same, and the time is that of the rows.
_EVERY, _THIN = 0.06, 3
# More are left out only where so many stay.
_FEW = 2000
# Windows of free run: from a few steps over the time constant of 0.2 to many of them.
_WINDOWS = (0.2, 1.0, 5.0)
# Weight of an error of one step beside one of free run, which is some five times larger.
_ONE_STEP_WEIGHT = 5.0


# A network is taken only if its one-step fit on the hold-out is within this of the best seen [points].
_ONE_STEP_LOSS = 0.15
_SETTLED = 25


@dataclass(frozen=True, slots=True, eq=False)
class AxisData:
    """Scaled regressors and targets of one axis, all runs behind each other.

    Attributes:
        measured: (time, n) along logged motors.
        simulated: (time, n) along simulated motors; no row crosses a run's border.
        target: (time,) scaled output, NaN where it was missed.
        first: (time,) whether a run begins here.
        lags: (f,) of the first regressors, past outputs [samples].
        shift, gain: (f,) those from the scaled output, `shift + gain y`.
        window: samples of one scaled second.
        has_time_constant: whether the robot gives its time constant; where it is learned, the simulation alone decides.
        weight: (time,) of an error.
    """

    measured: Matrix
    simulated: Matrix
    target: Vector
    first: np.ndarray
    lags: np.ndarray
    shift: Vector
    gain: Vector
    window: float
    has_time_constant: bool
    weight: Vector

    @property
    def thin(self) -> int:
        """Of so many rows one is learnt from."""
        often, stay = round(_EVERY * self.window), self.target.size // _FEW
        return max(min(often, max(stay, _THIN) if self.has_time_constant else stay), 1)

    def starts(self, length: int) -> Matrix:
        """(time, f) measured past outputs where they are from before a window of `length` samples; NaN elsewhere."""
        return self._past(self._since % length < self.lags[:, None])

    @property
    def _since(self) -> np.ndarray:
        """(time,) samples since the run began."""
        rows = np.arange(self.target.size)
        return rows - np.maximum.accumulate(np.where(self.first, rows, 0))

    def _past(self, known: np.ndarray) -> Matrix:
        """Return the measured past outputs (time, f) where `known` (f, time), and NaN elsewhere."""
        last = (self.measured[:, : self.lags.size] - self.shift) / self.gain
        values = np.where(known.T, last, np.nan)
        # A run whose first samples were missed starts from the mean.
        values[(self._since < self.lags[:, None]).T & ~np.isfinite(values)] = 0.0
        return values

    def one_step_errors(self, layers: Layers) -> list[Vector]:
        """Return the scaled errors of one step of each run; NaN where something was missed."""
        known = np.isfinite(self.measured).all(axis=1)
        errors = np.full(known.size, np.nan)
        errors[known] = self.target[known] - layers.output(self.measured[known])
        return np.split(errors, np.flatnonzero(self.first)[1:])

    def weights_fit(self, layers: Layers) -> tuple[float, float]:
        """Return the one-step and the free-run fit [%], without the first samples of each run."""
        since = self._since
        y = np.where(since >= _SETTLED, self.target, np.nan)
        known = np.isfinite(self.measured).all(axis=1)
        one = np.full(y.size, np.nan)
        one[known] = layers.output(self.measured[known])
        starts = self._past(since < _SETTLED - 1 + self.lags[:, None])
        free = np.empty(y.size)
        sizes = (layers.vector(), layers.b1.size, layers.b2.size)
        load_functions(FUNCTIONS).nn_free(*sizes, self.simulated, self.lags, starts, self.shift, self.gain, free)
        return nrmse_fit(np.where(known, y, np.nan), np.nan_to_num(one)), nrmse_fit(y, free)


def axis_data(
    recording: Recording,
    motors: Matrix,
    axis: int,
    table: Matrix,
    has_time_constant: bool,
    scale: tuple[Matrix, Vector] | None,
    weights: Vector | None = None,
) -> tuple[AxisData, Matrix, Vector]:
    """Return the data of one axis, its input scale (2, n) and output scale (2,).

    Args:
        recording: with logged motors, or those of the drive model.
        motors: (time, motors) simulated [rad].
        axis: of the outputs.
        table: rows (source, channel, lag), past outputs first.
        has_time_constant: whether the robot gives its time constant.
        scale: of other data, to be used again.
        weights: (time,) of errors; None: all alike.
    """
    lag = int(table[:, 2].max())
    X, S, y, first, weight = [], [], [], [], []
    rated = np.ones(len(recording)) if weights is None else weights
    at = 0
    for run in recording.runs():
        part, own = motors[at : at + len(run)], rated[at : at + len(run)]
        at += len(run)
        if len(run) <= lag:
            continue
        rows = len(run)
        for positions, into in ((run.motor_positions, X), (part, S)):
            sources = (run.outputs[:, [axis]], run.set_points, positions)
            columns = [sources[int(s)][lag - int(b) : rows - int(b), int(c)] for s, c, b in table]
            into.append(np.column_stack(columns))
        y.append(run.outputs[lag:, axis])
        first.append(np.arange(rows - lag) == 0)
        weight.append(own[lag:])
    measured, simulated, target = np.concatenate(X), np.concatenate(S), np.concatenate(y)
    if scale is None:
        known = measured[np.isfinite(measured).all(axis=1)]
        seen = target[np.isfinite(target)]
        scale = (
            np.array([known.mean(axis=0), np.maximum(known.std(axis=0), 1e-9)]),
            np.array([seen.mean(), max(float(seen.std()), 1e-9)]),
        )
    (mean, spread), (middle, size) = scale
    fed = table[:, 0] == 0
    data = AxisData(
        measured=(measured - mean) / spread,
        simulated=np.ascontiguousarray((simulated - mean) / spread),
        target=(target - middle) / size,
        first=np.concatenate(first),
        lags=table[fed, 2].astype(np.int64),
        shift=(middle - mean[fed]) / spread[fed],
        gain=size / spread[fed],
        window=1.0 / recording.sample_time,
        has_time_constant=has_time_constant,
        weight=np.concatenate(weight),
    )
    return data, scale[0], scale[1]


@dataclass
class Best:
    """The best network so far by the hold-out; `stop` ends the search and keeps it."""

    hold_out: AxisData
    tell: Callable[[str], None]
    stop: Callable[[], bool]
    layers: Layers | None = None
    one: float = -np.inf
    free: float = -np.inf

    def see(self, layers: Layers, cost: float, what: str) -> bool:
        """Judge a network; return whether to go on."""
        one, free = self.hold_out.weights_fit(layers)
        top = max(self.one, one)
        if self.layers is None or (
            free > self.free and (one > top - _ONE_STEP_LOSS or not self.hold_out.has_time_constant)
        ):
            self.layers, self.free = layers, free
        self.one = top
        self.tell(f"{what}, loss {cost:.4g}, hold-out {self.free:.1f} %")
        return not self.stop()


def train_axis(
    data: AxisData,
    best: Best,
    *,
    hidden: tuple[int, int],
    decays: tuple[float, ...],
    iterations: int,
    refine: int,
    rng: np.random.Generator,
) -> Layers:
    """Return the network with the best free run on the hold-out among all starts and stages.

    Args:
        data: to learn from.
        best: keeps the best, and says when to stop.
        hidden: neurons of the two layers.
        decays: one start each.
        iterations: series-parallel steps of the best start; the others get a third.
        refine: steps over windows of free run.
        rng: of the starts.
    """
    known = np.isfinite(data.measured).all(axis=1) & np.isfinite(data.target)
    rows = np.flatnonzero(known)[:: data.thin]
    Z, target, weight = data.measured[rows], data.target[rows], data.weight[rows]
    ends: list[tuple[float, Layers, float]] = []
    for number, decay in enumerate(decays):
        start = _solved(random_layers(Z.shape[1], hidden, rng), Z, target, weight)
        what = f"start {number + 1}"
        layers = _series_parallel(start, (Z, target, weight), decay, max(iterations // 3, 1), best, what)
        ends.append((best.hold_out.weights_fit(layers)[1], layers, decay))
        if best.stop():
            break
    _, layers, decay = max(ends, key=lambda end: end[0])
    layers = _series_parallel(layers, (Z, target, weight), decay, iterations, best, "series-parallel")
    for seconds in _WINDOWS if refine else ():
        if best.stop():
            break
        length = max(round(seconds * data.window), 2)
        layers = _windows(layers, data, rows, decay, length, max(refine // len(_WINDOWS), 1), best)
    return best.layers or layers


def _solved(layers: Layers, Z: Matrix, target: Vector, weight: Vector) -> Layers:
    """Return the layers with the output layer of least squares: Levenberg-Marquardt starts far closer then."""
    H = np.column_stack([layers.hidden(Z)[1], np.ones(len(Z))]) * weight[:, None]
    # Neurons are much alike at random: a thousandth of the rows keeps the weights of order one.
    w = np.linalg.solve(H.T @ H + 1e-3 * len(H) * np.eye(H.shape[1]), H.T @ (weight * target))
    return replace(layers, w3=w[:-1], b3=float(w[-1]))


def _series_parallel(
    start: Layers, rows: tuple[Matrix, Vector, Vector], decay: float, iterations: int, best: Best, what: str
) -> Layers:
    """Minimise the weighted errors of one step over `rows`: regressors, targets and weights."""
    Z, target, weight = rows

    def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
        if not derivatives:
            return weight * (target - start.like(w).output(Z)), None
        output, J = jacobian(start.like(w), Z)
        return weight * (target - output), weight[:, None] * J

    def seen(w: Vector, cost: float) -> bool:
        return best.see(start.like(w), cost, what)

    return start.like(levenberg(errors, start.vector(), iterations=iterations, decay=decay, seen=seen))


def _windows(
    start: Layers, data: AxisData, rows: np.ndarray, decay: float, length: int, iterations: int, best: Best
) -> Layers:
    """Minimise the errors of free runs over windows, and of one step beside them so that neither is given up."""
    functions = load_functions(FUNCTIONS)
    starts, h1, h2 = data.starts(length), start.b1.size, start.b2.size
    there = np.isfinite(data.target[:: data.thin])
    free = np.empty(data.target.size)
    J = np.empty((there.size, start.vector().size))
    Z, target = data.measured[rows], data.target[rows]
    # Of free runs, then of one step.
    weight = np.concatenate([
        data.weight[:: data.thin][there], (_ONE_STEP_WEIGHT if data.has_time_constant else 1.0) * data.weight[rows]
    ])  # fmt: skip

    def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
        call = (w, h1, h2, data.simulated, data.lags, starts, data.shift, data.gain)
        if not derivatives:
            functions.nn_free(*call, free)
            one, by_one = start.like(w).output(Z), None
        else:
            functions.nn_sensitivities(*call, data.thin, free, J)
            one, by_one = jacobian(start.like(w), Z)
        error = weight * np.concatenate([(data.target - free)[:: data.thin][there], target - one])
        return error, None if by_one is None else weight[:, None] * np.vstack([J[there], by_one])

    def seen(w: Vector, cost: float) -> bool:
        return best.see(start.like(w), cost, f"windows of {length}")

    return start.like(levenberg(errors, start.vector(), iterations=iterations, decay=decay, seen=seen))
