"""Laws of order that every aggregate of `softneck.core.METRICS` keeps; each subpackage tries its own against them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import permutations

from softneck.core import metric_of

# No two are equal, none is the neutral element of a sum or product, and the worst is neither first nor last.
MEMBERS = (1.75, 3.5, 1.25, 2.5)


def is_worse(name: str, a: float, b: float) -> bool:
    """Return whether `a` is strictly worse than `b`, or no number."""
    return math.isnan(a) or (a < b if metric_of(name).larger else a > b)


def check_worst(name: str, of: Callable[[Sequence[float]], float], members: Sequence[float] = MEMBERS) -> None:
    """Check that `of` takes the worst of its members, wherever it stands, and that nothing unknown vanishes."""
    larger = metric_of(name).larger
    expected = min(members) if larger else max(members)
    best = max(members) if larger else min(members)
    for order in permutations(members):
        assert of(order) == expected, (name, order)
    for number in range(1, len(members) + 1):
        part = members[:number]
        assert of(part) == (min(part) if larger else max(part))
    worse = expected * (0.5 if larger else 2.0)
    for place in range(len(members) + 1):
        with_worse = (*members[:place], worse, *members[place:])
        assert of(with_worse) == worse, (name, place)
        with_better = (*members[:place], best, *members[place:])
        assert of(with_better) == expected, (name, place)
        for unknown in (math.nan, -math.inf if larger else math.inf):
            found = of((*members[:place], unknown, *members[place:]))
            assert is_worse(name, found, expected), (name, place, unknown, found)
