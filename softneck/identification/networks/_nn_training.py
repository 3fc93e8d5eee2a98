"""Training of one axis of the NLARX network: series-parallel, then over growing windows of free run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._regressors import PAPER_EQ21
from ..models._scores import nrmse_fit
from ._levenberg import Layers, jacobian, levenberg, random_layers

FUNCTIONS = "softneck.identification.networks._nn_fit_runtime"
# Every third row: at 20 ms neighbours say the same, and the time is that of the rows.
THIN = 3
# Windows of free run [s]: from a few steps over the neck's time constant to many of them.
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
        shift, gain: first regressor from the scaled output, `shift + gain y`.
        window: samples of one second.
    """

    measured: Matrix
    simulated: Matrix
    target: Vector
    first: np.ndarray
    shift: float
    gain: float
    window: float

    def starts(self, length: int) -> Vector:
        """(time,) measured outputs before each window of `length` samples; NaN elsewhere."""
        values = np.full(self.target.size, np.nan)
        since = np.arange(self.target.size) - np.maximum.accumulate(
            np.where(self.first, np.arange(self.target.size), 0)
        )
        here = self.first | (since % length == 0)
        last = (self.measured[:, 0] - self.shift) / self.gain
        values[here] = last[here]
        # A run whose first sample was missed starts from the mean.
        values[self.first & ~np.isfinite(values)] = 0.0
        return values

    def one_step_errors(self, layers: Layers) -> list[Vector]:
        """Return the scaled errors of one step of each run; NaN where something was missed."""
        known = np.isfinite(self.measured).all(axis=1)
        errors = np.full(known.size, np.nan)
        errors[known] = self.target[known] - layers.output(self.measured[known])
        return np.split(errors, np.flatnonzero(self.first)[1:])

    def weights_fit(self, layers: Layers) -> tuple[float, float]:
        """Return the one-step and the free-run fit [%], without the first samples of each run."""
        since = np.arange(self.target.size) - np.maximum.accumulate(
            np.where(self.first, np.arange(self.target.size), 0)
        )
        y = np.where(since >= _SETTLED, self.target, np.nan)
        known = np.isfinite(self.measured).all(axis=1)
        one = np.full(y.size, np.nan)
        one[known] = layers.output(self.measured[known])
        starts = np.where(since < _SETTLED, (self.measured[:, 0] - self.shift) / self.gain, np.nan)
        starts[self.first & ~np.isfinite(starts)] = 0.0
        free = np.empty(y.size)
        call = (layers.vector(), layers.b1.size, layers.b2.size, self.simulated, starts, self.shift, self.gain, free)
        load_functions(FUNCTIONS).nn_free(*call)
        return nrmse_fit(np.where(known, y, np.nan), np.nan_to_num(one)), nrmse_fit(y, free)


def axis_data(
    recording: Recording, motors: Matrix, axis: int, scale: tuple[Matrix, Vector] | None
) -> tuple[AxisData, Matrix, Vector]:
    """Return the data of one axis, its input scale (2, n) and output scale (2,).

    Args:
        recording: with logged motors, or those of the drive model.
        motors: (time, 3) simulated [rad].
        axis: 0 pitch, 1 roll.
        scale: of other data, to be used again.
    """
    lag = int(PAPER_EQ21[:, 2].max())
    X, S, y, first = [], [], [], []
    at = 0
    for run in recording.runs():
        part = motors[at : at + len(run)]
        at += len(run)
        if len(run) <= lag:
            continue
        rows = len(run)
        for positions, into in ((run.motor_positions, X), (part, S)):
            sources = (run.outputs[:, [axis, axis, axis]], run.set_points, positions)
            columns = [sources[int(s)][lag - int(b) : rows - int(b), int(c)] for s, c, b in PAPER_EQ21]
            into.append(np.column_stack(columns))
        y.append(run.outputs[lag:, axis])
        first.append(np.arange(rows - lag) == 0)
    measured, simulated, target = np.concatenate(X), np.concatenate(S), np.concatenate(y)
    if scale is None:
        known = measured[np.isfinite(measured).all(axis=1)]
        seen = target[np.isfinite(target)]
        scale = (
            np.array([known.mean(axis=0), np.maximum(known.std(axis=0), 1e-9)]),
            np.array([seen.mean(), max(float(seen.std()), 1e-9)]),
        )
    (mean, spread), (middle, size) = scale
    data = AxisData(
        measured=(measured - mean) / spread,
        simulated=np.ascontiguousarray((simulated - mean) / spread),
        target=(target - middle) / size,
        first=np.concatenate(first),
        shift=float((middle - mean[0]) / spread[0]),
        gain=float(size / spread[0]),
        window=1.0 / recording.sample_time,
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
        if self.layers is None or (free > self.free and one > top - _ONE_STEP_LOSS):
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
    rows = np.flatnonzero(known)[::THIN]
    Z, target = data.measured[rows], data.target[rows]
    ends: list[tuple[float, Layers, float]] = []
    for number, decay in enumerate(decays):
        start = _solved(random_layers(Z.shape[1], hidden, rng), Z, target)
        layers = _series_parallel(start, Z, target, decay, max(iterations // 3, 1), best, f"start {number + 1}")
        ends.append((best.hold_out.weights_fit(layers)[1], layers, decay))
        if best.stop():
            break
    _, layers, decay = max(ends, key=lambda end: end[0])
    layers = _series_parallel(layers, Z, target, decay, iterations, best, "series-parallel")
    for seconds in _WINDOWS if refine else ():
        if best.stop():
            break
        length = max(round(seconds * data.window), 2)
        layers = _windows(layers, data, rows, decay, length, max(refine // len(_WINDOWS), 1), best)
    return best.layers or layers


def _solved(layers: Layers, Z: Matrix, target: Vector) -> Layers:
    """Return the layers with the output layer of least squares: Levenberg-Marquardt starts far closer then."""
    H = np.column_stack([layers.hidden(Z)[1], np.ones(len(Z))])
    # Neurons are much alike at random: a thousandth of the rows keeps the weights of order one.
    w = np.linalg.solve(H.T @ H + 1e-3 * len(H) * np.eye(H.shape[1]), H.T @ target)
    return replace(layers, w3=w[:-1], b3=float(w[-1]))


def _series_parallel(
    start: Layers, Z: Matrix, target: Vector, decay: float, iterations: int, best: Best, what: str
) -> Layers:
    def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
        if not derivatives:
            return target - start.like(w).output(Z), None
        output, J = jacobian(start.like(w), Z)
        return target - output, J

    def seen(w: Vector, cost: float) -> bool:
        return best.see(start.like(w), cost, what)

    return start.like(levenberg(errors, start.vector(), iterations=iterations, decay=decay, seen=seen))


def _windows(
    start: Layers, data: AxisData, rows: np.ndarray, decay: float, length: int, iterations: int, best: Best
) -> Layers:
    """Minimise the errors of free runs over windows, and of one step beside them so that neither is given up."""
    functions = load_functions(FUNCTIONS)
    starts, h1, h2 = data.starts(length), start.b1.size, start.b2.size
    there = np.isfinite(data.target[::THIN])
    free = np.empty(data.target.size)
    J = np.empty((there.size, start.vector().size))
    Z, target = data.measured[rows], data.target[rows]

    def errors(w: Vector, *, derivatives: bool) -> tuple[Vector, Matrix | None]:
        call = (w, h1, h2, data.simulated, starts, data.shift, data.gain)
        if not derivatives:
            functions.nn_free(*call, free)
            one, by_one = start.like(w).output(Z), None
        else:
            functions.nn_sensitivities(*call, THIN, free, J)
            one, by_one = jacobian(start.like(w), Z)
        error = np.concatenate([(data.target - free)[::THIN][there], _ONE_STEP_WEIGHT * (target - one)])
        return error, None if by_one is None else np.vstack([J[there], _ONE_STEP_WEIGHT * by_one])

    def seen(w: Vector, cost: float) -> bool:
        return best.see(start.like(w), cost, f"windows of {length}")

    return start.like(levenberg(errors, start.vector(), iterations=iterations, decay=decay, seen=seen))
