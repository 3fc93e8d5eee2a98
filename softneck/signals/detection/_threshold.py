"""Thresholds for many charts from undisturbed motion alone: a budget of false alarms, shared, and block bootstrap.

Scores of undisturbed motion are drawn again in blocks, which keep what correlation is left (Kuensch, Annals of
Statistics 17, 1989), the same block for all charts. The largest sum in each window of such a path has an exponential
tail (Basseville and Nikiforov 1993, sec. 5.2.2: e^-h for a likelihood ratio of white noise), which carries from what a
few minutes show to what the budget asks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Vector, require_positive, require_whole

# A tail is fitted to the tenth of the windows with the largest sums.
_TAIL = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How often all charts together may cry wolf, and how that is carried over.

    Attributes:
        rate: false alarms per second of motion, of all charts together [1/s].
        charts: that share it.
        step: between two scores [s].
        block: that is drawn at once [s]: longer than what correlation whitening leaves.
        window: whose largest sum is looked at [s].
        windows: drawn of them.
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
    """Return h (charts,) for charts whose scores on undisturbed motion are `scores`, each stretch (time, charts).

    Raises:
        DataError: less than ten blocks of motion, or scores that are not finite.
    """
    largest = window_maxima(scores, budget, rng)
    border = np.quantile(largest, 1.0 - _TAIL, axis=0)
    excess = np.maximum(largest - border, 0.0).sum(axis=0) / max(_TAIL * len(largest), 1.0)
    # Of a likelihood ratio the tail falls as e^-h; what the motion shows may only make it heavier.
    scale = np.maximum(excess, 1.0)
    share = budget.rate * budget.window / budget.charts
    return np.maximum(border + scale * np.log(_TAIL / share), largest.max(axis=0))


def window_maxima(scores: list[Matrix], budget: Budget, rng: np.random.Generator) -> Matrix:
    """Return the largest sums (windows, charts) in windows of paths that are drawn block by block."""
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
    # Where a block may begin: not so late in a stretch that it would run into the next.
    first, begins = 0, []
    for part in starts:
        begins.append(first + np.arange(len(part)))
        first += len(part) + length - 1
    begin = np.concatenate(begins)
    blocks = max(1, round(budget.window / budget.block))
    sums = np.zeros((budget.windows, joined.shape[1]))
    largest = np.zeros_like(sums)
    # A window goes on from a block before it, so that it does not begin from rest.
    for number in range(-1, blocks):
        at = rng.choice(begin, budget.windows)
        for k in range(length):
            sums = np.maximum(0.0, sums + joined[at + k])
            if number >= 0:
                largest = np.maximum(largest, sums)
    return largest
