"""Whether a model's `validity` says how often it is right: Brier score and reliability, on rows not trained on."""

from __future__ import annotations

from typing import Any

import numpy as np

from softneck.core import Matrix

from ..models._model import Model
from ..models._validity import knows_validity, tolerance_of
from ._scored_rows import Rows

_BINS = 10


def judged_validity(model: Model, rows: Rows, free: Matrix) -> dict[str, Any] | None:
    """Return what the validity of a free run was, and how that compares with how often the error stayed within.

    The Brier score is the mean squared distance between the probability and what happened, 0 at best (Brier 1950);
    `brier_base_rate` is that of who knows how often these rows stay within the tolerance and nothing else.

    Args:
        model: whose free run it is.
        rows: those judged.
        free: (time, n_out) the free run with all outputs of the model.

    Returns:
        least, mean, held (share of the rows with all errors within the tolerance), brier, brier_base_rate, and
        reliability: predicted, held and rows for each tenth of the probability. None where the model has no validity
        or nothing is judged.
    """
    allowed = tolerance_of(model)
    if not knows_validity(model) or allowed is None or free.shape[1] <= allowed.size:
        return None
    there = np.isfinite(rows.measured).all(axis=1) & np.isfinite(free[:, -1])
    if not there.any():
        return None
    predicted = free[there, -1]
    # An error that is no number is not within.
    held = np.asarray((np.abs(rows.measured - free[:, : allowed.size])[there] <= allowed).all(axis=1))
    share = float(held.mean())
    return {
        "least": float(predicted.min()),
        "mean": float(predicted.mean()),
        "held": share,
        "brier": float(np.mean((predicted - held) ** 2)),
        "brier_base_rate": share * (1.0 - share),
        "reliability": reliability(predicted, held),
    }


def reliability(predicted: np.ndarray, held: np.ndarray) -> list[dict[str, float]]:
    """Return for each tenth of the probability that occurs: its mean, how often that happened, and the rows."""
    bins = np.minimum((predicted * _BINS).astype(int), _BINS - 1)
    return [
        {
            "predicted": float(predicted[bins == b].mean()),
            "held": float(held[bins == b].mean()),
            "rows": int((bins == b).sum()),
        }
        for b in np.unique(bins)
    ]
