"""Noise levels from recordings: those under which the filter's innovations are most likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, SettingsError, Vector
from softneck.signals import Recording

from ._kalman import KalmanObserver
from ._likelihood import SETTLE, Cost, WalkCost, cost_of
from ._nonlinear import NonlinearObserver
from ._offline import check_recording

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
