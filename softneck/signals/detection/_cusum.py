"""Cumulative sums of log-likelihood ratios: each chart asks whether one fault explains the residual better than none.

Page's CUSUM in the form of Basseville and Nikiforov, "Detection of Abrupt Changes" (1993), sec. 2.2 and 7.2.1: with an
innovation e of variance v, and the mean f that the fault would give it,

    s = f e / v - f^2 / (2 v),     S <- max(0, S + s),     alarm where S > h.

Without a fault s falls by f^2 / (2 v) on average, with it it rises by as much: that half is the *information* of the
sample about the fault, and a fault that is not excited has none.
"""

from __future__ import annotations

import numpy as np

from softneck.core import Vector

from ._charts_runtime import CHART_CLIP as _CLIP


def shift_score(innovation: Vector, mean: Vector, variance: Vector, *, sight: float = _CLIP) -> Vector:
    """Return s for the hypotheses of `mean` (hypotheses, channels), all at once: shape (hypotheses,).

    Args:
        innovation: e (channels,).
        mean: f of each hypothesis, through the same whitening (hypotheses, channels).
        variance: v of the innovation (channels,).
        sight: a fault that would show as more standard deviations is taken for one of so many.
    """
    spread = np.maximum(np.sqrt(variance), np.abs(mean) / sight)
    e = innovation / spread
    f = mean / spread
    # Clipped around the fault's mean as well: what the fault explains may be as large as it likes.
    seen = np.clip(e, np.minimum(f, 0.0) - _CLIP, np.maximum(f, 0.0) + _CLIP)
    return (f * (seen - 0.5 * f)).sum(axis=-1)


class Charts:
    """Many cumulative sums side by side.

    Attributes:
        sums: S of each (charts,).
        thresholds: h of each (charts,).
    """

    __slots__ = ("sums", "thresholds")

    def __init__(self, thresholds: Vector) -> None:
        """Begin at zero."""
        self.thresholds = np.asarray(thresholds, dtype=np.float64)
        self.sums = np.zeros(len(self.thresholds))

    def step(self, scores: Vector) -> int:
        """Add `scores` (charts,); return the chart that fits best of those beyond their thresholds, -1 for none."""
        self.sums = np.maximum(0.0, self.sums + scores)
        beyond = self.sums > self.thresholds
        if not beyond.any():
            return -1
        # They are likelihood ratios against the same "nothing": the largest is the likeliest fault.
        return int(np.argmax(np.where(beyond, self.sums, -np.inf)))
