"""What the data deny, said by naming the two rows that deny it."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError

from ._forest import Points
from ._gamma import RULES, least_gammas


def require_allowed(points: Points, output: int, gamma: float, epsilon: float, rule: str) -> None:
    """Raise DataError, naming the pair, unless the data allow (gamma, epsilon): else no function fits (FSS empty)."""
    P, y = points.points, points.values[output]
    least, pairs = least_gammas(P, y, np.array([RULES[rule] * epsilon]), nodes=points.own_nodes(output))
    # A gamma beyond 1e200 stands for none; the distance and its reciprocal round once each.
    if least[0] <= min(gamma * (1.0 + 1e-12), 1e200):
        return
    j, k = sorted(pairs[0], key=lambda column: points.ages[column])
    distance, rise = float(np.linalg.norm(P[:, j] - P[:, k])), float(abs(y[j] - y[k]))
    who = f"rows {int(points.ages[j])} and {int(points.ages[k])} of `X` and `Y`"
    raise DataError(denial(who, f"output {output} is {rise:.6g} apart", distance, (gamma, epsilon), float(least[0])))


def denial(who: str, rise: str, distance: float, tried: tuple[float, float], least: float) -> str:
    """Return the sentence about a pair: who they are, how far apart, what would do."""
    gamma, epsilon = tried
    if least > 1e200:
        return (
            f"epsilon {epsilon:.6g} is below the noise: {who} have equal regressors and {rise}, so no function fits "
            "both (the FSS is empty). Set `epsilon` higher, or leave one of the two out."
        )
    return (
        f"gamma {gamma:.6g} with epsilon {epsilon:.6g} is denied by the data (the FSS is empty): between {who} the "
        f"regressor moves by {distance:.6g} and {rise}. With this epsilon gamma must be at least {least:.6g}; else "
        "set `epsilon` higher, or leave one of the two out."
    )
