"""How a default is chosen: on all necks but one, judged on that one, in turn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """One neck left out.

    Attributes:
        left_out: its name.
        chosen: place of the candidate that the others choose.
        best: place of the one that it would have chosen itself.
        ratios: (candidate,) its scores over that of the default, geometric means over its specimens.
    """

    left_out: str
    chosen: int
    best: int
    ratios: Vector


def ratios(scores: Matrix, default: int) -> Vector:
    """Return how each candidate compares with the default on one neck: geometric mean of score / default's.

    Args:
        scores: (specimen, candidate), above 0; less is better.
        default: place of today's default.
    """
    return np.exp(np.mean(np.log(scores / scores[:, [default]]), axis=0))


def choice(found: Mapping[str, Vector], default: int) -> int:
    """Return the candidate that is best on these necks, each counted alike; the default unless another is better."""
    mean = np.mean(np.log(list(found.values())), axis=0)
    best = int(np.argmin(mean))
    return best if mean[best] < mean[default] else default


def leave_one_out(scores: Mapping[str, Matrix], default: int) -> list[Fold]:
    """Return for each neck what the others choose, and how that does on it.

    Args:
        scores: (specimen, candidate) of each neck; less is better.
        default: place of today's default.
    """
    found = {name: ratios(rows, default) for name, rows in scores.items()}
    return [
        Fold(
            left_out=name,
            chosen=choice({other: row for other, row in found.items() if other != name}, default),
            best=choice({name: own}, default),
            ratios=own,
        )
        for name, own in found.items()
    ]
