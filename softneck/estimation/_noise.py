"""Noise levels from recordings: those under which the filter's innovations are most likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector
from softneck.runtime import load_functions, sized_name
from softneck.signals import Recording

from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE, KALMAN_REJECTIONS, KalmanArrays
from ._nonlinear import NonlinearObserver
from ._offline import check_recording, input_rows, measured_angles

# Rows at the start of each run that are not scored: there the filter is still uncertain of everything.
SETTLE = 50
# An outlier is further than so many robust standard deviations from the median of its neighbours and itself.
_OUTLIER = 6.0
# Levels are searched within two powers of ten of where the search starts: smooth data would like none at all, and a
# filter without noise trusts one measurement for good.
_DECADES = 2.0
_STEP = 0.15
# Measured rows below which three levels cannot be told apart.
_LEAST_ROWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFit:
    """Noise levels that a recording supports.

    Attributes:
        observer: the filter with these levels.
        names: of the levels.
        noise: standard deviations, in the units of the filter's form.
        start: where the search began.
        log_likelihood: per measurement, before and after.
        rows: measurements used.
        outliers: measurements left out.
        at_bound: names of levels that ran to the end of their range: the data do not tell them.
    """

    observer: KalmanObserver | NonlinearObserver
    names: tuple[str, ...]
    noise: tuple[float, float, float]
    start: tuple[float, float, float]
    log_likelihood: tuple[float, float]
    rows: int
    outliers: int
    at_bound: tuple[str, ...]


def fit_noise(
    observer: KalmanObserver | NonlinearObserver,
    recordings: Recording | Sequence[Recording],
    *,
    fixed: Sequence[str] = (),
) -> NoiseFit:
    """Return the noise levels of greatest likelihood (Schweppe 1965; Anderson and Moore 1979, sec. 10.3).

    The cost is the sum of log det S_k + e_k' S_k^-1 e_k over the innovations, minimised over the logarithms of the
    three levels by the simplex of Nelder and Mead. Outliers are taken out beforehand (Hampel 1974), since a gate
    inside the search would reward a filter that refuses everything.

    Where the model is wrong its error is not white, and the likeliest levels may leave the measurement no noise at all:
    then hold that of the sensor.

    Args:
        observer: the filter, with the levels to start from.
        recordings: of its sample time.
        fixed: names of levels that stay as they are.

    Raises:
        SettingsError: a name in `fixed` that is not a level, or all of them.
        DataError: another sample time, missing channels, or fewer than 200 measurements.
    """
    free = _free(observer.noise_names, fixed)
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    runs = [run for recording in given for run in recording.runs()]
    for run in runs:
        check_recording(observer, run)
    cost = cost_of(observer, runs)
    if cost.rows < _LEAST_ROWS:
        raise DataError(
            f"noise levels need at least {_LEAST_ROWS} measurements after the first {SETTLE} rows of each run; "
            f"got {cost.rows}. Record longer."
        )
    start = np.log10(observer.noise)
    found, least, at_bound = _likeliest(cost, start, free)
    noise = np.array(observer.noise)
    noise[free] = 10.0 ** found[free]
    levels = (float(noise[0]), float(noise[1]), float(noise[2]))
    return NoiseFit(
        observer=observer.with_noise(levels, sensor="data"),
        names=observer.noise_names,
        noise=levels,
        start=observer.noise,
        log_likelihood=(-0.5 * cost.of(start), -0.5 * least),
        rows=cost.rows,
        outliers=cost.outliers,
        at_bound=tuple(name for name, held in zip(observer.noise_names, at_bound, strict=True) if held),
    )


def _free(names: Sequence[str], fixed: Sequence[str]) -> np.ndarray:
    """Return which levels are estimated (3,); refuse an unknown name, and nothing left to estimate."""
    unknown = sorted(set(fixed) - set(names))
    if unknown or len(set(fixed)) == len(names):
        what = f"`{unknown[0]}` is not a noise level" if unknown else "no noise level is left to estimate"
        raise SettingsError(f"{what}; this filter has {', '.join(names)}.")
    return np.array([name not in fixed for name in names])


def _likeliest(cost: Cost | WalkCost, start: Vector, free: np.ndarray) -> tuple[Vector, float, np.ndarray]:
    """Return the decadic logarithms of the levels, their cost, and which ran to the end of their range (3,)."""
    from scipy.optimize import minimize

    bounds = [(level - _DECADES, level + _DECADES) for level in start[free]]

    def of(levels: Vector) -> float:
        whole = start.copy()
        whole[free] = levels
        return cost.of(whole)

    # A first step of its own: scipy's is a part of the logarithm, none at all for a level of 1.
    simplex = np.vstack([start[free], start[free] + _STEP * np.eye(int(free.sum()))])
    options = {"xatol": 1e-3, "fatol": 1e-5, "initial_simplex": simplex}
    found = minimize(of, start[free], method="Nelder-Mead", bounds=bounds, options=options)
    whole, at_bound = start.copy(), np.zeros(start.size, dtype=bool)
    whole[free] = found.x
    # A hundredth of a decade: where the simplex stops.
    at_bound[free] = [min(x - low, high - x) < 0.01 for x, (low, high) in zip(found.x, bounds, strict=True)]
    return whole, float(found.fun), at_bound


def cost_of(observer: KalmanObserver | NonlinearObserver, runs: Sequence[Recording]) -> Cost | WalkCost:
    """Return the cost of an observer's noise levels over runs."""
    return WalkCost(observer, runs) if isinstance(observer, NonlinearObserver) else Cost(observer, runs)


class Cost:
    """The cost of levels over all runs, per measurement."""

    def __init__(self, observer: KalmanObserver, runs: Sequence[Recording]) -> None:
        motors, outputs = len(observer.robot.motors.names), len(observer.robot.outputs.names)
        self._functions = load_functions(sized_name("softneck.estimation._likelihood_runtime", motors, outputs))
        self._told = 2 * outputs + 2
        arrays = dict(zip(KalmanArrays.names(), observer.arrays, strict=False))  # without steady gains
        arrays["constants"] = constants = arrays["constants"].copy()
        # No gate, no force, no frozen sensor: the likelihood is of all that was measured.
        constants[KALMAN_GATE] = constants[KALMAN_REJECTIONS] = np.inf
        constants[KALMAN_FROZEN] = 0.0
        self._arrays = tuple(arrays.values())
        self._size = int(self._functions.state_size(self._arrays))
        self._tables: list[Matrix] = []
        self.outliers = 0
        for run in runs:
            z, spoilt = _without_outliers(run)
            self.outliers += spoilt
            self._tables.append(input_rows(observer, run, z))
        self.rows = sum(self._run(table, observer.noise)[1] for table in self._tables)

    def of(self, levels: Vector) -> float:
        """Return minus twice the log likelihood per measurement at 10 to the power of `levels`, but for a constant."""
        noise = tuple(float(level) for level in 10.0**levels)
        return sum(self._run(table, noise)[0] for table in self._tables) / self.rows

    def _run(self, table: Matrix, noise: Sequence[float]) -> tuple[float, int]:
        state, outputs, parameters = np.zeros(self._size), np.zeros(self._told), np.array(noise)
        self._functions.initialise(self._arrays, parameters, state, outputs)
        return self._functions.kalman_cost(self._arrays, parameters, state, table, SETTLE)


def _without_outliers(run: Recording) -> tuple[Matrix, int]:
    """Return the measured outputs (time, outputs) with NaN for outliers, and how many there were."""
    z = measured_angles(run)
    spoilt = outliers(z)
    z[spoilt] = np.nan
    return z, int(spoilt.sum())


class WalkCost:
    """The same over a nonlinear model, which runs free: once, and what it misses is judged as a walk."""

    def __init__(self, observer: NonlinearObserver, runs: Sequence[Recording]) -> None:
        self._cost = load_functions("softneck.estimation._walk_likelihood_runtime").walk_cost
        self._start = observer.start**2
        self._tables: list[tuple[Matrix, np.ndarray, Vector]] = []
        self.outliers = 0
        for run in runs:
            z, spoilt = _without_outliers(run)
            self.outliers += spoilt
            angles, fastest = observer.free_run(run)
            self._tables.append((z - angles, np.asarray(np.isfinite(z).all(axis=1)), fastest))
        self.rows = sum(int(came[SETTLE:].sum()) for _, came, _ in self._tables)

    def of(self, levels: Vector) -> float:
        """Return minus twice the log likelihood per measurement at 10 to the power of `levels`, but for a constant."""
        noise, rest, ratio = (float(level) for level in 10.0**levels)
        costs = (
            self._cost(missed, came, rest**2 + (ratio * fastest) ** 2, noise**2, self._start, SETTLE)
            for missed, came, fastest in self._tables
        )
        return float(sum(costs)) / self.rows


def outliers(z: Matrix) -> np.ndarray:
    """Return which measurements (time,) stand apart from both neighbours that came."""
    spoilt = np.zeros(len(z), dtype=bool)
    came = np.flatnonzero(np.isfinite(z).all(axis=1))
    if came.size < 3:
        return spoilt
    y = z[came]
    middle = np.median(np.stack([y[:-2], y[1:-1], y[2:]]), axis=0)
    distance = np.abs(y[1:-1] - middle)
    # Scale from the changes between neighbours: 1.4826 times a median is a normal standard deviation. A noise-free
    # recording has none, and no outliers.
    scale = 1.4826 * np.median(np.abs(np.diff(y, axis=0)), axis=0)
    spoilt[came[1:-1]] = (distance > _OUTLIER * np.maximum(scale, 1e-12)).any(axis=1)
    return spoilt
