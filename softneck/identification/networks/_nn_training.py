"""Training of one axis of the NLARX network: one step ahead (series-parallel), then over growing simulation windows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._regressors import lagged_columns
from ..models._scores import nrmse_fit

# Damping at first, at least, and where the search gives up.
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-2, 1e-9, 1e10

# (w, J) -> errors (rows,) at w; J (rows, w), if there is one, gets the derivatives of the model.
Errors = Callable[[Vector, Matrix | None], Vector]


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
        """Return all weights as one vector."""
        return np.concatenate([self.W1.ravel(), self.b1, self.W2.ravel(), self.b2, self.w3, [self.b3]])

    def like(self, weights: Vector) -> Layers:
        """Return the network of these shapes with other weights."""
        shapes = [self.W1.shape, self.b1.shape, self.W2.shape, self.b2.shape, self.w3.shape]
        edges = np.cumsum([int(np.prod(shape)) for shape in shapes])
        W1, b1, W2, b2, w3 = (p.reshape(s) for p, s in zip(np.split(weights[:-1], edges[:-1]), shapes, strict=True))
        return Layers(W1, b1, W2, b2, w3, float(weights[-1]))

    def layer_values(self, Z: Matrix) -> tuple[Matrix, Matrix]:
        """Return the values of both layers (rows, hidden) for inputs (rows, n)."""
        first = np.tanh(Z @ self.W1.T + self.b1)
        return first, np.tanh(first @ self.W2.T + self.b2)

    def output(self, Z: Matrix) -> Vector:
        """Return the outputs (rows,) for inputs (rows, n)."""
        return self.layer_values(Z)[1] @ self.w3 + self.b3


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


def jacobian(layers: Layers, Z: Matrix, J: Matrix) -> Vector:
    """Return the outputs (rows,), and fill `J` (rows, weights) with their derivatives by all weights."""
    H1, H2 = layers.layer_values(Z)
    D2 = (1.0 - H2**2) * layers.w3
    D1 = (D2 @ layers.W2) * (1.0 - H1**2)
    at = 0
    for by_neuron, inputs in ((D1, Z), (D2, H1)):
        rows, count, n = *by_neuron.shape, inputs.shape[1]
        np.multiply(by_neuron[:, :, None], inputs[:, None, :], out=J[:, at : at + count * n].reshape(rows, count, n))
        at += count * n
        J[:, at : at + count] = by_neuron
        at += count
    J[:, at:-1], J[:, -1] = H2, 1.0
    return H2 @ layers.w3 + layers.b3


def levenberg(
    errors: Errors,
    start: Vector,
    weight: Vector,
    *,
    iterations: int,
    decay: float,
    on_step: Callable[[Vector, float], bool],
) -> Vector:
    """Minimise `|weight errors(w)|^2 + decay |w|^2` over w by Levenberg and Marquardt; return the last w.

    The damping follows the gain of a step over the promised one (Nielsen 1999, IMM-REP-1999-05). `on_step` gets w and
    its cost at the start and after each step; False ends the search.
    """
    w, damping, growth = start, _FIRST_DAMPING, 2.0
    J = np.empty((weight.size, start.size))
    single = np.empty(J.shape, dtype=np.float32)
    error = weight * errors(w, J)

    def total_cost(e: Vector, w: Vector) -> float:
        return float(e @ e + decay * (w @ w))

    cost = total_cost(error, w)
    if not np.isfinite(cost):
        raise DataError("the network's first error is not finite; look for wild values in the recording.")
    if not on_step(w, cost):
        return w
    for _ in range(iterations):
        # The step is damped by far more than single precision rounds, and takes half the time; its slope is exact.
        np.multiply(J, weight[:, None], out=single, casting="same_kind")
        A, g = single.T @ single, J.T @ (weight * error) - decay * w
        while damping < _MAX_DAMPING:
            step = _solve_damped(A, g, decay + damping)
            trial = w + step
            trial_cost = total_cost(weight * errors(trial, None), trial)
            if trial_cost < cost:
                break
            # A cost that is not finite also shortens the step.
            damping, growth = damping * growth, 2.0 * growth
        else:
            break
        gain = (cost - trial_cost) / float(step @ (g + damping * step))
        damping, growth = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), _MIN_DAMPING), 2.0
        w, cost = trial, trial_cost
        if not on_step(w, cost):
            break
        error = weight * errors(w, J)
    return w


def _solve_damped(A: Matrix, g: Vector, damping: float) -> Vector:
    """Solve (A + damping I) x = g; zeros where it is not positive definite."""
    from scipy.linalg import get_lapack_funcs

    factorise, solve = get_lapack_funcs(("potrf", "potrs"), (A,))
    damped = A.copy()
    damped[np.diag_indices(g.size)] += damping
    # A symmetric matrix is its own transpose, which LAPACK takes without a copy.
    factor, failed = factorise(damped.T, lower=1, clean=0, overwrite_a=1)
    return np.zeros_like(g) if failed else solve(factor, g.astype(A.dtype), lower=1)[0].astype(np.float64)


FUNCTIONS = "softneck.identification.networks._nn_fit_runtime"
# Training takes every third row at 20 ms: neighbours are much alike, and the time grows with the rows.
_ROW_STEP_S, _DECIMATION = 0.06, 3
# It leaves out more only where so many rows stay.
_MIN_TRAINING_ROWS = 2000
# Simulation windows [scaled s]: from a few steps over the time constant of 0.2 to many of them.
_WINDOWS_S = (0.2, 1.0, 5.0)
# Weight of a one-step error; those of the simulation are about five times larger.
_ONE_STEP_WEIGHT = 5.0
# A network is taken only if its one-step fit on the hold-out is at most this below the best [points].
_ONE_STEP_LOSS = 0.15
_UNSCORED_ROWS = 25


@dataclass(frozen=True, slots=True, eq=False)
class AxisData:
    """Scaled regressors and targets of one axis, all runs in sequence.

    measured, simulated (time, n): along logged, simulated motors, no row across a run's border; target (time,): NaN
    where missed; first (time,): whether a run begins here; lags (f,): of the first regressors, past outputs [samples],
    which are `shift + gain y`; window: samples of one scaled second; without has_time_constant the simulation alone
    decides.
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
    def decimation(self) -> int:
        """Training takes one of so many rows."""
        step, most = round(_ROW_STEP_S * self.window), self.target.size // _MIN_TRAINING_ROWS
        return max(min(step, max(most, _DECIMATION) if self.has_time_constant else most), 1)

    def starts(self, length: int) -> Matrix:
        """Return past outputs (time, f), measured before each window of `length` samples and NaN in it."""
        return self._past(self._since % length < self.lags[:, None])

    @property
    def _since(self) -> np.ndarray:
        """(time,) samples since the start of the run."""
        rows = np.arange(self.target.size)
        return rows - np.maximum.accumulate(np.where(self.first, rows, 0))

    def _past(self, known: np.ndarray) -> Matrix:
        """Return the measured past outputs (time, f) where `known` (f, time), and NaN elsewhere."""
        last = (self.measured[:, : self.lags.size] - self.shift) / self.gain
        values = np.where(known.T, last, np.nan)
        # A run with its first samples missed starts from the mean.
        values[(self._since < self.lags[:, None]).T & ~np.isfinite(values)] = 0.0
        return values

    def one_step_errors(self, layers: Layers) -> list[Vector]:
        """Return the scaled one-step errors of each run; NaN where a sample was missed."""
        return np.split(self.target - self._predict(layers), np.flatnonzero(self.first)[1:])

    def _predict(self, layers: Layers) -> Vector:
        """Return the one-step predictions (time,); NaN where a regressor was missed."""
        known = np.isfinite(self.measured).all(axis=1)
        one = np.full(known.size, np.nan)
        one[known] = layers.output(self.measured[known])
        return one

    def fits(self, layers: Layers) -> tuple[float, float]:
        """Return the fits [%] of one step and of the simulation, without the first rows of each run."""
        since = self._since
        y = np.where(since >= _UNSCORED_ROWS, self.target, np.nan)
        one = self._predict(layers)
        starts = self._past(since < _UNSCORED_ROWS - 1 + self.lags[:, None])
        free = np.empty(y.size)
        sizes = (layers.vector(), layers.b1.size, layers.b2.size)
        load_functions(FUNCTIONS).nn_free(*sizes, self.simulated, self.lags, starts, self.shift, self.gain, free)
        return nrmse_fit(np.where(np.isfinite(one), y, np.nan), np.nan_to_num(one)), nrmse_fit(y, free)


def axis_data(
    recording: Recording,
    motors: Matrix,
    axis: int,
    table: Matrix,
    has_time_constant: bool,
    scale: tuple[Matrix, Vector] | None,
    weights: Vector | None = None,
) -> tuple[AxisData, Matrix, Vector]:
    """Return the data of one axis, its input scale (2, n) and output scale (2,); None computes the scale.

    The recording has motor positions; `motors` (time, motors) are simulated ones, `weights` (time,) those of errors.
    """
    lag = int(table[:, 2].max())
    X, S, y, first, weight = [], [], [], [], []
    weights = np.ones(len(recording)) if weights is None else weights
    at = 0
    for run in recording.runs():
        span = slice(at, at + len(run))
        at += len(run)
        if len(run) <= lag:
            continue
        X.append(lagged_columns(run, run.motor_positions, axis, table))
        S.append(lagged_columns(run, motors[span], axis, table))
        y.append(run.outputs[lag:, axis])
        first.append(np.arange(len(run) - lag) == 0)
        weight.append(weights[span][lag:])
    if not X:
        longest = max(map(len, recording.runs()))
        raise DataError(
            f"a network remembers {lag} samples of this robot, and the longest run to train or stop on has {longest}; "
            "record longer, or give the robot's `time_constant_s`."
        )
    measured, simulated, target = np.concatenate(X), np.concatenate(S), np.concatenate(y)
    if scale is None:
        x, t = measured[np.isfinite(measured).all(axis=1)], target[np.isfinite(target)]
        inputs = np.array([x.mean(axis=0), np.maximum(x.std(axis=0), 1e-9)])
        scale = inputs, np.array([t.mean(), max(float(t.std()), 1e-9)])
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
    """The best network by the hold-out; `stop` ends the search."""

    hold_out: AxisData
    report: Callable[[str], None]
    stop: Callable[[], bool]
    layers: Layers | None = None
    one: float = -np.inf
    free: float = -np.inf

    def update(self, layers: Layers, cost: float, what: str) -> bool:
        """Compare a network with the best; return whether to continue."""
        one, free = self.hold_out.fits(layers)
        top = max(self.one, one)
        if self.layers is None or (
            free > self.free and (one > top - _ONE_STEP_LOSS or not self.hold_out.has_time_constant)
        ):
            self.layers, self.free = layers, free
        self.one = top
        self.report(f"{what}, loss {cost:.4g}, hold-out {self.free:.1f} %")
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
    """Return the network with the best simulation of the hold-out among all starts, one for each of `decays`.

    Each start gets a third of the `iterations` (series-parallel), the best all, then `refine` steps over windows.
    """
    known = np.isfinite(data.measured).all(axis=1) & np.isfinite(data.target)
    rows = np.flatnonzero(known)[:: data.decimation]
    Z, target, weight = data.measured[rows], data.target[rows], data.weight[rows]
    ends: list[tuple[float, Layers, float]] = []
    for number, decay in enumerate(decays):
        start = _solve_output_layer(random_layers(Z.shape[1], hidden, rng), Z, target, weight)
        what = f"start {number + 1}"
        layers = _series_parallel(start, (Z, target, weight), decay, max(iterations // 3, 1), best, what)
        ends.append((best.hold_out.fits(layers)[1], layers, decay))
        if best.stop():
            break
    _, layers, decay = max(ends, key=lambda end: end[0])
    layers = _series_parallel(layers, (Z, target, weight), decay, iterations, best, "series-parallel")
    for seconds in _WINDOWS_S if refine else ():
        if best.stop():
            break
        length = max(round(seconds * data.window), 2)
        layers = _train_windows(layers, data, rows, decay, length, max(refine // len(_WINDOWS_S), 1), best)
    return best.layers or layers


def _solve_output_layer(layers: Layers, Z: Matrix, target: Vector, weight: Vector) -> Layers:
    """Fit the output layer by least squares, a far better start for Levenberg and Marquardt."""
    H = np.column_stack([layers.layer_values(Z)[1], np.ones(len(Z))]) * weight[:, None]
    # Random neurons are nearly dependent; this regularization keeps the weights of order one.
    w = np.linalg.solve(H.T @ H + 1e-3 * len(H) * np.eye(H.shape[1]), H.T @ (weight * target))
    return replace(layers, w3=w[:-1], b3=float(w[-1]))


def _series_parallel(
    start: Layers, rows: tuple[Matrix, Vector, Vector], decay: float, iterations: int, best: Best, what: str
) -> Layers:
    """Minimise the weighted one-step errors over `rows`: regressors, targets and weights."""
    Z, target, weight = rows

    def errors(w: Vector, J: Matrix | None) -> Vector:
        layers = start.like(w)
        return target - (layers.output(Z) if J is None else jacobian(layers, Z, J))

    def on_step(w: Vector, cost: float) -> bool:
        return best.update(start.like(w), cost, what)

    return start.like(levenberg(errors, start.vector(), weight, iterations=iterations, decay=decay, on_step=on_step))


def _train_windows(
    start: Layers, data: AxisData, rows: np.ndarray, decay: float, length: int, iterations: int, best: Best
) -> Layers:
    """Minimise the simulation errors over windows together with the one-step errors."""
    functions = load_functions(FUNCTIONS)
    starts, h1, h2 = data.starts(length), start.b1.size, start.b2.size
    step = data.decimation
    there = np.isfinite(data.target[::step])
    simulated, free = np.nan_to_num(data.target[::step]), np.empty(data.target.size)
    Z, target, count = data.measured[rows], data.target[rows], there.size
    one_step = _ONE_STEP_WEIGHT if data.has_time_constant else 1.0
    weight = np.concatenate([data.weight[::step] * there, one_step * data.weight[rows]])

    def errors(w: Vector, J: Matrix | None) -> Vector:
        layers, call = start.like(w), (w, h1, h2, data.simulated, data.lags, starts, data.shift, data.gain)
        if J is None:
            functions.nn_free(*call, free)
            one = layers.output(Z)
        else:
            functions.nn_sensitivities(*call, step, free, J[:count])
            one = jacobian(layers, Z, J[count:])
        return np.concatenate([simulated - free[::step], target - one])

    def on_step(w: Vector, cost: float) -> bool:
        return best.update(start.like(w), cost, f"windows of {length}")

    return start.like(levenberg(errors, start.vector(), weight, iterations=iterations, decay=decay, on_step=on_step))
