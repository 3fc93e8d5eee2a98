"""Whether the filter's own covariances are true: normalised innovations and errors against chi-square bounds.

And how well it bridges what its sensor misses: a check on rows that its noise levels were not fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, Vector
from softneck.core._shown import Shown
from softneck.signals import Recording

from ._kalman import KalmanObserver
from ._likelihood import outliers
from ._nonlinear import NonlinearObserver
from ._offline import Estimates, measured_names

# Samples averaged for a curve that shows where a filter is too sure: half a second at 100 Hz.
_WINDOW = 50


@dataclass(frozen=True, slots=True, eq=False)
class Squares:
    """Normalised squares of one quantity, of a consistent filter chi-square with a degree of freedom for each output.

    Attributes:
        time: (n,) [s] of the samples that count.
        values: (n,).
        band: both ends of the two-sided interval of `level` for one sample.
        inside: part of the values within the band; `level` is expected.
        mean: the number of outputs is expected; more: the filter is too sure of itself.
        mean_band: interval of `level` for the mean of n independent values (Bar-Shalom 2001, sec. 5.4.2).
        average: (n,) running mean over `window` values.
        average_band: interval of `level` for one value of `average`.
        window: values averaged.
    """

    time: Vector
    values: Vector
    band: tuple[float, float]
    inside: float
    mean: float
    mean_band: tuple[float, float]
    average: Vector
    average_band: tuple[float, float]
    window: int


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Consistency(Shown):
    """NIS and NEES of a filter over a recording.

    Attributes:
        level: of all bands.
        nis: e' S^-1 e of every measurement that was taken in; outliers would drown what it says of the noise levels.
        nees: (x - xhat)' P^-1 (x - xhat) of all outputs; None where the truth is not known.
        rejected: measurements that the gate refused; of good ones it refuses 1 - `gate_level`.
        autocorrelation: (20,) of the NIS at lags 1 to 20; of white innovations 95 % stay within +-1.96/sqrt(n).
    """

    level: float
    nis: Squares
    nees: Squares | None
    rejected: int
    autocorrelation: Vector

    def summary(self) -> str:
        """Return some lines for people."""
        lines = []
        for name, squares in (("NIS", self.nis), ("NEES", self.nees)):
            if squares is None:
                continue
            low, high = squares.mean_band
            lines.append(
                f"{name}: {100 * squares.inside:.1f} % of {squares.values.size} in the {100 * self.level:g} % band; "
                f"mean {squares.mean:.2f}, expected {low:.2f} to {high:.2f}"
            )
        lines.append(f"rejected by the gate: {self.rejected}")
        return "\n".join(lines)


def consistency(
    observer: KalmanObserver | NonlinearObserver, recording: Recording, *, level: float = 0.95, settle: int = 50
) -> Consistency:
    """Return NIS, and NEES where the recording knows the true angles beside the measured ones.

    Truth is `pitch`, `roll` of a recording that has `pitch_measured`, `roll_measured` as well, as `simulate` logs it.

    Args:
        observer: the filter.
        recording: of its sample time.
        level: of the bands.
        settle: rows at the start of each run that do not count.

    Raises:
        DataError: no measurements are left, or what `observer.estimate` raises.
    """
    if not 0.0 < level < 1.0:
        raise DataError(f"`level` must be between 0 and 1; got {level:g}.")
    estimates = observer.estimate(recording)
    counts = np.concatenate([np.arange(len(run)) >= settle for run in recording.runs()])
    rows = np.flatnonzero(counts & estimates.judged)
    if np.count_nonzero(estimates.accepted[rows]) < 2:
        raise DataError(f"no measurements are left after the first {settle} rows of each run; record longer.")
    taken = rows[estimates.accepted[rows]]
    nis = estimates.innovation[taken]
    return Consistency(
        level=level,
        nis=_squares(estimates.time[taken], nis, level, len(recording.robot.outputs.names)),
        nees=_nees(observer, recording, estimates, counts, level),
        rejected=rows.size - taken.size,
        autocorrelation=_autocorrelation(nis),
    )


def _nees(
    observer: KalmanObserver | NonlinearObserver,
    recording: Recording,
    estimates: Estimates,
    counts: np.ndarray,
    level: float,
) -> Squares | None:
    names = recording.robot.outputs.names
    if not all(f"{axis}_measured" in recording.channels for axis in names):
        return None
    parts, times = [], []
    start = 0
    lead = observer.lead / observer.sample_time
    for run in recording.runs():
        rows = slice(start, start + len(run))
        # The covariance is that of the instant of the measurement: the truth of then.
        place = np.maximum(np.arange(len(run)) - lead, 0.0)
        truth = np.column_stack([np.interp(place, np.arange(len(run)), column) for column in run.outputs.T])
        e = truth - estimates.aligned[rows]
        squares = np.einsum("ki,ki->k", e, np.linalg.solve(estimates.covariance[rows], e[:, :, None])[:, :, 0])
        good = counts[rows] & np.isfinite(squares)
        parts.append(squares[good])
        times.append(run.time[good])
        start += len(run)
    return _squares(np.concatenate(times), np.concatenate(parts), level, len(names))


def _squares(time: Vector, values: Vector, level: float, degrees: int) -> Squares:
    from scipy.stats import chi2

    tails = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
    low, high = chi2.ppf(tails, degrees)
    n = values.size
    window = min(_WINDOW, n)
    sums = np.cumsum(np.concatenate([[0.0], values]))
    average = np.full(n, np.nan)
    average[window - 1 :] = (sums[window:] - sums[:-window]) / window
    mean_low, mean_high = chi2.ppf(tails, degrees * n) / n
    part_low, part_high = chi2.ppf(tails, degrees * window) / window
    return Squares(
        time=time,
        values=values,
        band=(float(low), float(high)),
        inside=float(np.mean((values >= low) & (values <= high))),
        mean=float(np.mean(values)),
        mean_band=(float(mean_low), float(mean_high)),
        average=average,
        average_band=(float(part_low), float(part_high)),
        window=window,
    )


def _autocorrelation(values: Vector) -> Vector:
    centred = values - np.mean(values)
    power = float(centred @ centred)
    lags = range(1, min(21, values.size))
    return np.array([float(centred[lag:] @ centred[:-lag]) / power if power > 0.0 else 0.0 for lag in lags])


# Five samples of every 25 are withheld: 0.1 s of 0.5 s at 20 ms, after which the filter may be off by what it knows.
_PERIOD, _GAP = 25, 5
# Rows at the start of each run in which the filter is still uncertain of everything.
_SETTLE = 50


def look_ahead_error(
    observer: KalmanObserver | NonlinearObserver, recording: Recording, late: float | None = None
) -> float:
    """Return the RMS [SI] between what the filter says is now and what its sensor, being late, says of it later.

    Of every 25 samples five are withheld from the filter. Likelihood rewards levels that trust any measurement where
    the model is wrong; a gap, and the way from the measurement to now, show what they cost. Outliers are not asked.

    Args:
        observer: the filter.
        recording: of its sample time; best rows that its noise levels were not fitted to.
        late: how late the sensor is [s]; None: as late as the filter thinks.

    Raises:
        DataError: no gap fits into the runs.
    """
    late = (observer.lead if late is None else late) / observer.sample_time
    names = measured_names(recording)
    squares = []
    for run in recording.runs():
        row = np.arange(len(run))
        gap = (row >= _SETTLE) & (row % _PERIOD >= _PERIOD - _GAP)
        z = np.column_stack([run.channels[name] for name in names])
        spoilt = outliers(z)
        hidden = {name: np.where(gap, np.nan, run.channels[name]) for name in names}
        told = observer.estimate(replace(run, channels={**run.channels, **hidden})).outputs
        clean = np.where(spoilt[:, None], np.nan, z)
        # What is measured `late` samples on, between samples by a straight line.
        whole, part = int(late), late - int(late)
        ahead = [np.vstack([clean[n:], np.full((n, clean.shape[1]), np.nan)])[: len(clean)] for n in (whole, whole + 1)]
        error = told - (ahead[0] if part == 0.0 else (1.0 - part) * ahead[0] + part * ahead[1])
        # A sensor that is not late says nothing but what the filter has seen, outside of the gaps.
        asked = (gap if late < 1.0 else row >= _SETTLE) & np.isfinite(error).all(axis=1)
        squares.append(error[asked] ** 2 if gap.any() else error[:0])
    judged = np.concatenate(squares)
    if not judged.size:
        raise DataError(f"runs of more than {_SETTLE + _PERIOD} rows are needed to check a filter; record longer.")
    return float(np.sqrt(judged.mean()))
