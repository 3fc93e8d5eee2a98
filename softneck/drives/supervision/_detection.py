"""Change detection without I/O: whitening of residuals, cumulative sums, thresholds from undisturbed motion.

The residual of a simulation is correlated from sample to sample, and a cumulative sum over it drifts far beyond the
thresholds for white noise: Johnson and Bagshaw, "The effect of serial correlation on the performance of CUSUM tests",
Technometrics 16 (1974), find the run length cut by four at a correlation of 0.5. An autoregression makes it white.

Charts test whether one fault explains the residual better than none: Page's CUSUM in the form of Basseville and
Nikiforov, "Detection of Abrupt Changes" (1993), sec. 2.2 and 7.2.1. With an innovation e of variance v, and the mean f
that the fault would give it,

    s = f e / v - f^2 / (2 v),     S <- max(0, S + s),     alarm where S > h.

Without the fault s falls by f^2 / (2 v) on average, with it s rises by as much. This is the *information* of the sample
about the fault; a fault that is not excited has none.

Thresholds: scores of undisturbed motion are resampled in blocks, which keep the remaining correlation (Kuensch, Annals
of Statistics 17, 1989), the same block for all charts. The largest sum in each window of such a path has an exponential
tail (sec. 5.2.2: e^-h for a likelihood ratio of white noise), which extrapolates from a few minutes of data to the rate
of the budget.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector, require_positive, require_whole
from softneck.runtime import load_functions

from ._charts_runtime import CHART_CLIP

# Least number of rows per coefficient for an order; with fewer rows the noise is fitted.
_ROWS_EACH = 20


@dataclass(frozen=True, slots=True)
class Whitening:
    """The whitening filter `e_k = r_k - sum a_j r_(k-j)`; the mean under a fault passes through it as well.

    Attributes:
        coefficients: a_1..a_p.
    """

    coefficients: tuple[float, ...] = ()

    @classmethod
    def fit(cls, residuals: Sequence[Vector], *, most: int = 6) -> Whitening:
        """Fit an autoregression with the order of the smallest corrected Akaike criterion (AICc).

        `residuals`: of undisturbed segments, each (time,); regressors do not cross segments. `most`: highest order.
        Raises DataError: a residual that is not finite, or no segment of 20 rows.
        """
        if not all(np.isfinite(part).all() for part in residuals):
            raise DataError("residuals must be finite to fit a whitening filter.")
        long = [np.asarray(part, dtype=np.float64) for part in residuals if len(part) > most]
        rows = sum(len(part) - most for part in long)
        if rows < _ROWS_EACH:
            raise DataError(f"a whitening filter needs {_ROWS_EACH} rows beyond its order {most}; there are {rows}.")
        y = np.concatenate([part[most:] for part in long])
        best, found = np.inf, np.zeros(0)
        for order in range(min(most, rows // _ROWS_EACH) + 1):
            X = np.vstack([lags(part, order)[most - order :] for part in long])
            a = np.linalg.lstsq(X, y, rcond=None)[0] if order else np.zeros(0)
            spread = float(np.mean((y - X @ a) ** 2))
            if spread <= 0.0:
                break
            # Hurvich and Tsai (1989), with the variance as one parameter more.
            score = rows * np.log(spread) + 2.0 * (order + 1) * rows / max(rows - order - 2, 1)
            if score < best:
                best, found = score, a
        return cls(tuple(float(value) for value in found))

    def apply(self, residual: Vector) -> Vector:
        """Return the innovations (time - p,) of one segment (time,)."""
        order = len(self.coefficients)
        return residual[order:] - lags(residual, order) @ np.array(self.coefficients)


def lags(x: Vector, order: int) -> Matrix:
    """Return (time - order, order): each row has the `order` previous values, latest first."""
    return np.column_stack([x[order - j : len(x) - j] for j in range(1, order + 1)]) if order else np.zeros((len(x), 0))


class Filter:
    """Recursive whitening filters, one for each channel, for residuals and for their means under faults.

    `coefficients`: (order, channels), zero beyond a channel's own order. `past`: past values, latest first (order,
    kinds, channels). `seen`: number of values so far.
    """

    __slots__ = ("_step", "coefficients", "past", "seen")

    def __init__(self, channels: Sequence[Whitening], kinds: int = 1) -> None:
        """Start without values; these have shape (kinds, channels)."""
        order = max((len(channel.coefficients) for channel in channels), default=0)
        padded = [[*channel.coefficients, *(0.0,) * (order - len(channel.coefficients))] for channel in channels]
        self.coefficients = np.array(padded).reshape(len(channels), order).T.copy()
        self.past = np.zeros((order, kinds, len(channels)))
        self.seen = 0
        self._step: Any = load_functions("softneck.drives.supervision._charts_runtime").chart_whiten

    @property
    def settled(self) -> bool:
        """Whether its memory is filled."""
        return self.seen >= len(self.past)

    def step(self, value: Matrix) -> Matrix:
        """Return the innovations of `value` (kinds, channels)."""
        white = np.array(value, dtype=np.float64)
        for channel in range(white.shape[1]):
            self._step(self.coefficients, self.past, white, channel)
        self.seen += 1
        return white

    def reset(self) -> None:
        """Forget all values."""
        self.past[:] = 0.0
        self.seen = 0


def shift_score(innovation: Vector, mean: Vector, variance: Vector, *, sight: float = CHART_CLIP) -> Vector:
    """Return s (hypotheses,) for the hypotheses `mean` (hypotheses, channels).

    `innovation`: e (channels,). `mean`: f of each hypothesis, after the same whitening (hypotheses, channels).
    `variance`: v of the innovation (channels,). `sight`: limit of a fault in standard deviations.
    """
    spread = np.maximum(np.sqrt(variance), np.abs(mean) / sight)
    e = innovation / spread
    f = mean / spread
    # Clipped around the fault's mean as well: the part explained by the fault is not limited.
    seen = np.clip(e, np.minimum(f, 0.0) - CHART_CLIP, np.maximum(f, 0.0) + CHART_CLIP)
    return (f * (seen - 0.5 * f)).sum(axis=-1)


class Charts:
    """Parallel cumulative sums.

    `sums`: S of each (charts,). `thresholds`: h of each (charts,).
    """

    __slots__ = ("sums", "thresholds")

    def __init__(self, thresholds: Vector) -> None:
        """Start at zero."""
        self.thresholds = np.asarray(thresholds, dtype=np.float64)
        self.sums = np.zeros(len(self.thresholds))

    def step(self, scores: Vector) -> int:
        """Add `scores` (charts,); return the chart with the largest sum beyond its threshold, -1 for none."""
        self.sums = np.maximum(0.0, self.sums + scores)
        beyond = self.sums > self.thresholds
        if not beyond.any():
            return -1
        # The sums are likelihood ratios against no fault: the largest is the most likely fault.
        return int(np.argmax(np.where(beyond, self.sums, -np.inf)))


# A tail is fitted to the tenth of the windows with the largest sums.
_TAIL_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Budget of false alarms of all charts, and settings of the extrapolation to it.

    Attributes:
        rate: false alarms per second of motion, of all charts together [1/s].
        charts: number of charts.
        step: between two scores [s].
        block: length of resampled blocks [s]: longer than the correlation after whitening.
        window: length of the windows whose largest sum is used [s].
        windows: number of windows.
    """

    rate: float = 1.0 / (300.0 * 3600.0)
    charts: int = 1
    step: float = 0.02
    block: float = 2.0
    window: float = 20.0
    windows: int = 600

    def __post_init__(self) -> None:
        require_positive("rate", self.rate, "1/s")
        require_positive("step", self.step, "s")
        require_positive("block", self.block, "s")
        require_positive("window", self.window, "s")
        require_whole("charts", self.charts, 1, 10_000)
        require_whole("windows", self.windows, 100, 100_000)


def thresholds(scores: list[Matrix], budget: Budget, rng: np.random.Generator) -> Vector:
    """Return the thresholds h (charts,) from scores on undisturbed motion, one array (time, charts) for each segment.

    Raises DataError: less than ten blocks of motion, or scores that are not finite.
    """
    largest = window_maxima(scores, budget, rng)
    border = np.quantile(largest, 1.0 - _TAIL_SHARE, axis=0)
    excess = np.maximum(largest - border, 0.0).sum(axis=0) / max(_TAIL_SHARE * len(largest), 1.0)
    # The tail of a likelihood ratio falls as e^-h; the data may only make it heavier.
    scale = np.maximum(excess, 1.0)
    share = budget.rate * budget.window / budget.charts
    return np.maximum(border + scale * np.log(_TAIL_SHARE / share), largest.max(axis=0))


def window_maxima(scores: list[Matrix], budget: Budget, rng: np.random.Generator) -> Matrix:
    """Return the largest sums (windows, charts) in windows of resampled paths."""
    length = max(1, round(budget.block / budget.step))
    starts = [part[: len(part) - length + 1] for part in scores if len(part) >= length]
    rows = sum(len(part) for part in starts)
    if rows < 10 * length:
        raise DataError(
            f"thresholds need {11 * length * budget.step:.3g} s of undisturbed motion in stretches longer than "
            f"{budget.block:g} s; there are {rows * budget.step:.3g} s."
        )
    joined = np.concatenate([part for part in scores if len(part) >= length])
    if not np.isfinite(joined).all():
        raise DataError("scores must be finite to find thresholds.")
    # Possible starts of blocks, so that no block crosses segments.
    first, begins = 0, []
    for part in starts:
        begins.append(first + np.arange(len(part)))
        first += len(part) + length - 1
    begin = np.concatenate(begins)
    blocks = max(1, round(budget.window / budget.block))
    sums = np.zeros((budget.windows, joined.shape[1]))
    largest = np.zeros_like(sums)
    # Each window follows a first block, so that its sums do not start at zero.
    for number in range(-1, blocks):
        at = rng.choice(begin, budget.windows)
        for k in range(length):
            sums = np.maximum(0.0, sums + joined[at + k])
            if number >= 0:
                largest = np.maximum(largest, sums)
    return largest
