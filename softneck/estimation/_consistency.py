"""Whether the filter's own covariances are true: normalised innovations against chi-square bounds.

And how well it bridges what its sensor misses: a check on rows that its noise levels were not fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, ReprMixin
from softneck.signals import Recording

from ._kalman import KalmanObserver
from ._noise import outliers
from ._nonlinear import NonlinearObserver
from ._offline import measured_names


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Consistency(ReprMixin):
    """NIS of a filter over a recording: e' S^-1 e of every measurement that was taken in.

    Of a consistent filter chi-square with a degree of freedom for each output. Outliers would drown what it says.

    Attributes:
        level: of the bands.
        taken: how many were taken in.
        inside: part of them within the band of one; `level` is expected.
        mean: the number of outputs is expected; more: the filter is too sure of itself.
        mean_band: interval of `level` for the mean of independent values (Bar-Shalom 2001, sec. 5.4.2).
        rejected: measurements that the gate refused; of good ones it refuses 1 - `gate_level`.
    """

    level: float
    taken: int
    inside: float
    mean: float
    mean_band: tuple[float, float]
    rejected: int

    def summary(self) -> str:
        """Return some lines for people."""
        low, high = self.mean_band
        return (
            f"NIS: {100 * self.inside:.1f} % of {self.taken} in the {100 * self.level:g} % band; "
            f"mean {self.mean:.2f}, expected {low:.2f} to {high:.2f}\nrejected by the gate: {self.rejected}"
        )


def consistency(
    observer: KalmanObserver | NonlinearObserver, recording: Recording, *, level: float = 0.95, settle: int = 50
) -> Consistency:
    """Return how the normalised innovations keep their bounds.

    Args:
        observer: the filter.
        recording: of its sample time.
        level: of the bands.
        settle: rows at the start of each run that do not count.

    Raises:
        DataError: no measurements are left, or what `observer.estimate` raises.
    """
    from scipy.stats import chi2

    if not 0.0 < level < 1.0:
        raise DataError(f"`level` must be between 0 and 1; got {level:g}.")
    estimates = observer.estimate(recording)
    counts = np.concatenate([np.arange(len(run)) >= settle for run in recording.runs()])
    rows = np.flatnonzero(counts & estimates.judged)
    nis = estimates.innovation[rows[estimates.accepted[rows]]]
    if nis.size < 2:
        raise DataError(f"no measurements are left after the first {settle} rows of each run; record longer.")
    tails, degrees = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level]), len(recording.robot.outputs.names)
    low, high = chi2.ppf(tails, degrees)
    mean_low, mean_high = chi2.ppf(tails, degrees * nis.size) / nis.size
    return Consistency(
        level=level,
        taken=nis.size,
        inside=float(np.mean((nis >= low) & (nis <= high))),
        mean=float(np.mean(nis)),
        mean_band=(float(mean_low), float(mean_high)),
        rejected=rows.size - nis.size,
    )


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
