"""Noise levels by maximum likelihood, and checks of a filter by its innovations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, Matrix, ReprMixin, SettingsError, Vector
from softneck.runtime import load_around_step, load_functions, load_runtime, sized_name
from softneck.signals import Recording

from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE, KALMAN_REJECTIONS, KalmanArrays
from ._nonlinear import NonlinearObserver
from ._offline import check_recording, input_rows, measured_angles, measured_names

# Rows at the start of each run that are not scored: the filter has not converged there.
SETTLE = 50
_LIKELIHOOD = "softneck.estimation._likelihood_runtime"
# An outlier is further than this from the median of itself and its two neighbours [robust standard deviations].
_OUTLIER_DEVIATIONS = 6.0
# Levels are searched within two decades of the start: smooth data would drive them to zero, and a filter without noise
# stops correcting itself.
_SEARCH_DECADES = 2.0
_FIRST_STEP_DECADES = 0.15
# Fewer measured rows do not determine three levels.
_LEAST_ROWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFit:
    """Noise levels that a recording supports.

    `noise` and `start` in the units of the filter's form; log_likelihood: per measurement, before and after; rows,
    outliers: measurements used, left out; at_bound: names of levels at the end of their range, which the data do not
    determine.
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
    three levels by the simplex of Nelder and Mead. Outliers are removed beforehand (Hampel 1974): a gate inside the
    search would reward a filter that rejects everything.

    The errors of a wrong model are not white, and the likelihood may then leave no measurement noise: fix the sensor's
    level in this case.

    Args:
        observer: the filter, with the levels to start from.
        recordings: of its sample time.
        fixed: names of levels that stay as they are.

    Raises:
        SettingsError: a name in `fixed` that is not a level, or all of them.
        DataError: another sample time, missing channels, or fewer than 200 measurements.
    """
    free = _levels_to_estimate(observer.noise_names, fixed)
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
    found, least, at_bound = _maximise_likelihood(cost, start, free)
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


def _levels_to_estimate(names: Sequence[str], fixed: Sequence[str]) -> np.ndarray:
    """Return which levels are estimated (3,); raise SettingsError for an unknown name or none left."""
    unknown = sorted(set(fixed) - set(names))
    if unknown or len(set(fixed)) == len(names):
        what = f"`{unknown[0]}` is not a noise level" if unknown else "no noise level is left to estimate"
        raise SettingsError(f"{what}; this filter has {', '.join(names)}.")
    return np.array([name not in fixed for name in names])


def _maximise_likelihood(cost: Cost | WalkCost, start: Vector, free: np.ndarray) -> tuple[Vector, float, np.ndarray]:
    """Return the decadic logarithms of the levels, their cost, and which ran to the end of their range (3,)."""
    from scipy.optimize import minimize

    bounds = [(level - _SEARCH_DECADES, level + _SEARCH_DECADES) for level in start[free]]

    def of(levels: Vector) -> float:
        whole = start.copy()
        whole[free] = levels
        return cost.of(whole)

    # scipy's own first step is a part of the logarithm: zero for a level of 1.
    simplex = np.vstack([start[free], start[free] + _FIRST_STEP_DECADES * np.eye(int(free.sum()))])
    options = {"xatol": 1e-3, "fatol": 1e-5, "initial_simplex": simplex}
    found = minimize(of, start[free], method="Nelder-Mead", bounds=bounds, options=options)
    whole, at_bound = start.copy(), np.zeros(start.size, dtype=bool)
    whole[free] = found.x
    # The simplex stops within a hundredth of a decade.
    at_bound[free] = [min(x - low, high - x) < 0.01 for x, (low, high) in zip(found.x, bounds, strict=True)]
    return whole, float(found.fun), at_bound


def cost_of(observer: KalmanObserver | NonlinearObserver, runs: Sequence[Recording]) -> Cost | WalkCost:
    """Return the cost of an observer's noise levels over runs."""
    return WalkCost(observer, runs) if isinstance(observer, NonlinearObserver) else Cost(observer, runs)


class Cost:
    """The cost of levels over all runs, per measurement."""

    def __init__(self, observer: KalmanObserver, runs: Sequence[Recording]) -> None:
        motors, outputs = len(observer.robot.motors.names), len(observer.robot.outputs.names)
        runtime = observer.block().runtime
        self._cost = load_around_step(sized_name(_LIKELIHOOD, motors, outputs), "kalman_cost", runtime)
        self._told = 2 * outputs + 2
        arrays = dict(zip(KalmanArrays.names(), observer.arrays, strict=False))  # without steady gains
        arrays["constants"] = constants = arrays["constants"].copy()
        # The gate and the frozen-sensor test are off: the likelihood uses all measurements.
        constants[KALMAN_GATE] = constants[KALMAN_REJECTIONS] = np.inf
        constants[KALMAN_FROZEN] = 0.0
        self._arrays = tuple(arrays.values())
        self._runtime = load_runtime(runtime)
        self._size = int(self._runtime.state_size(self._arrays))
        self._tables: list[Matrix] = []
        self.outliers = 0
        for run in runs:
            z, spoilt = _measurements_without_outliers(run)
            self.outliers += spoilt
            self._tables.append(input_rows(observer, run, z))
        self.rows = sum(self._run(table, observer.noise)[1] for table in self._tables)

    def of(self, levels: Vector) -> float:
        """Return minus twice the log likelihood per measurement, up to a constant; `levels` are log10."""
        noise = tuple(float(level) for level in 10.0**levels)
        return sum(self._run(table, noise)[0] for table in self._tables) / self.rows

    def _run(self, table: Matrix, noise: Sequence[float]) -> tuple[float, int]:
        state, outputs, parameters = np.zeros(self._size), np.zeros(self._told), np.array(noise)
        self._runtime.initialise(self._arrays, parameters, state, outputs)
        return self._cost(self._arrays, parameters, state, table, SETTLE)


def _measurements_without_outliers(run: Recording) -> tuple[Matrix, int]:
    """Return the measured outputs (time, outputs) with NaN for outliers, and how many there were."""
    z = measured_angles(run)
    spoilt = find_outliers(z)
    z[spoilt] = np.nan
    return z, int(spoilt.sum())


class WalkCost:
    """The cost over a nonlinear model: it is simulated once, and its error is a random walk."""

    def __init__(self, observer: NonlinearObserver, runs: Sequence[Recording]) -> None:
        self._cost = load_functions(_LIKELIHOOD).walk_cost
        self._start = observer.walk_start
        self._tables: list[tuple[Matrix, Matrix, Vector]] = []
        self.outliers = 0
        for run in runs:
            z, spoilt = _measurements_without_outliers(run)
            self.outliers += spoilt
            angles, motion, fastest = observer.simulate(run)
            self._tables.append((z - angles, motion, fastest))
        self.rows = sum(int(np.isfinite(missed[SETTLE:]).all(axis=1).sum()) for missed, _, _ in self._tables)

    def of(self, levels: Vector) -> float:
        """Return the cost as `Cost.of` does."""
        noise, rest, ratio = (float(level) for level in 10.0**levels)
        costs = (
            self._cost(missed, motion, rest**2 + (ratio * fastest) ** 2, noise, self._start, SETTLE)
            for missed, motion, fastest in self._tables
        )
        return float(sum(costs)) / self.rows


def find_outliers(z: Matrix) -> np.ndarray:
    """Return which measurements (time,) are far from both neighbours (Hampel 1974)."""
    spoilt = np.zeros(len(z), dtype=bool)
    came = np.flatnonzero(np.isfinite(z).all(axis=1))
    if came.size < 3:
        return spoilt
    y = z[came]
    middle = np.median(np.stack([y[:-2], y[1:-1], y[2:]]), axis=0)
    distance = np.abs(y[1:-1] - middle)
    # 1.4826 times the median change between neighbours is a normal standard deviation.
    scale = 1.4826 * np.median(np.abs(np.diff(y, axis=0)), axis=0)
    spoilt[came[1:-1]] = (distance > _OUTLIER_DEVIATIONS * np.maximum(scale, 1e-12)).any(axis=1)
    return spoilt


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Consistency(ReprMixin):
    """Normalised innovation squared (NIS) e' S^-1 e of the accepted measurements of a recording.

    It is chi-square for a consistent filter, with one degree of freedom for each output.

    Attributes:
        taken: number of accepted measurements.
        inside: share of them within the 95 % band of one value.
        mean: the number of outputs is expected; a larger mean shows too small a covariance.
        mean_band: 95 % interval for the mean of independent values (Bar-Shalom 2001, sec. 5.4.2).
        rejected: measurements that the gate rejected; 1 - `gate_level` of good ones is expected.
    """

    taken: int
    inside: float
    mean: float
    mean_band: tuple[float, float]
    rejected: int

    def summary(self) -> str:
        """Return some lines for people."""
        low, high = self.mean_band
        return (
            f"NIS: {100 * self.inside:.1f} % of {self.taken} in the 95 % band; "
            f"mean {self.mean:.2f}, expected {low:.2f} to {high:.2f}\nrejected by the gate: {self.rejected}"
        )


def consistency(observer: KalmanObserver | NonlinearObserver, recording: Recording) -> Consistency:
    """Return the normalised innovations of a filter against their chi-square bounds, but for 50 rows of each run.

    Raises:
        DataError: no measurements are left, or what `observer.estimate` raises.
    """
    from scipy.stats import chi2

    estimates = observer.estimate(recording)
    counts = np.concatenate([np.arange(len(run)) >= SETTLE for run in recording.runs()])
    rows = np.flatnonzero(counts & estimates.judged)
    nis = estimates.innovation[rows[estimates.accepted[rows]]]
    if nis.size < 2:
        raise DataError(f"no measurements are left after the first {SETTLE} rows of each run; record longer.")
    tails, degrees = np.array([0.025, 0.975]), len(recording.robot.outputs.names)
    low, high = chi2.ppf(tails, degrees)
    mean_low, mean_high = chi2.ppf(tails, degrees * nis.size) / nis.size
    return Consistency(
        taken=nis.size,
        inside=float(np.mean((nis >= low) & (nis <= high))),
        mean=float(np.mean(nis)),
        mean_band=(float(mean_low), float(mean_high)),
        rejected=rows.size - nis.size,
    )


# Five samples of every 25 are withheld: 0.1 s of 0.5 s at 20 ms.
_GAP_PERIOD, _GAP_LENGTH = 25, 5


def look_ahead_error(
    observer: KalmanObserver | NonlinearObserver, recording: Recording, late: float | None = None
) -> float:
    """Return the RMS [SI] between the estimates and later measurements of the same instants.

    Five of every 25 samples are withheld from the filter. Likelihood favours levels that trust every measurement where
    the model is wrong; the gaps and the prediction over the sensor's delay (`late` [s]; None: the filter's) show the
    price. Outliers are not compared. Rows should be others than the noise levels were fitted to. Returns inf if an
    estimate is no finite number.
    """
    late = (observer.lead if late is None else late) / observer.sample_time
    names = measured_names(recording)
    squares = []
    for run in recording.runs():
        row = np.arange(len(run))
        gap = (row >= SETTLE) & (row % _GAP_PERIOD >= _GAP_PERIOD - _GAP_LENGTH)
        z = np.column_stack([run.channels[name] for name in names])
        spoilt = find_outliers(z)
        hidden = {name: np.where(gap, np.nan, run.channels[name]) for name in names}
        estimates = observer.estimate(replace(run, channels={**run.channels, **hidden})).outputs
        clean = np.where(spoilt[:, None], np.nan, z)
        # The measurement `late` samples later, interpolated linearly.
        whole, part = int(late), late - int(late)
        ahead = [np.vstack([clean[n:], np.full((n, clean.shape[1]), np.nan)])[: len(clean)] for n in (whole, whole + 1)]
        later = ahead[0] if part == 0.0 else (1.0 - part) * ahead[0] + part * ahead[1]
        # Without a delay the filter has seen every measurement outside the gaps.
        counted = (gap if late < 1.0 else row >= SETTLE) & np.isfinite(later).all(axis=1)
        squares.append((estimates - later)[counted] ** 2 if gap.any() else later[:0])
    judged = np.concatenate(squares)
    if not judged.size:
        raise DataError(f"runs of more than {SETTLE + _GAP_PERIOD} rows are needed to check a filter; record longer.")
    # A filter that diverged has no error to compare.
    return float(np.sqrt(judged.mean())) if np.isfinite(judged).all() else float("inf")
