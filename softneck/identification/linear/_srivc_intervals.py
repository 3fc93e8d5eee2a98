"""Confidence intervals of a continuous-time model by bootstrap of its residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector

from ._srivc_fit import Continuous, Runs, SrivcFit, SrivcFitOptions

# A second of residuals stays together, so that what is correlated within a second counts as one.
_BLOCK = 1.0
# From the fit itself two steps reach what more would: the third moves the parameters by less than 1e-3 of their spread.
_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Intervals:
    """What the bootstrap says.

    Attributes:
        level: nominal part of records whose interval holds the truth.
        names: of the quantities: K, pole or coefficients, delay_s, static_gain.
        value, low, high: (names,) estimates and bounds, in SI (rad, s).
        covariance: (p, p) of theta = (a, b, L).
        samples: (count, p) theta of each resample.
    """

    level: float
    names: tuple[str, ...]
    value: Vector
    low: Vector
    high: Vector
    covariance: Matrix
    samples: Matrix

    def as_dict(self) -> dict[str, list[float]]:
        """Return name -> [low, high]."""
        bounds = zip(self.names, self.low, self.high, strict=True)
        return {name: [float(low), float(high)] for name, low, high in bounds}


def bootstrap(
    search: SrivcFitOptions,
    runs: Runs,
    fit: SrivcFit,
    *,
    count: int,
    generator: np.random.Generator,
    level: float = 0.95,
    tell: Callable[[float], None] | None = None,
) -> Intervals:
    """Fit again to the simulation with moving blocks of its own residuals on it (Kuensch 1989), `count` times.

    The bounds are the estimate and its bootstrap standard deviation times the normal quantile: with a few hundred
    resamples that is steadier than their percentiles.
    """
    from scipy.stats import norm

    block = max(round(_BLOCK / search.sample_time), 1)
    residuals = [y - simulated for (_, y), simulated in zip(runs, fit.simulated, strict=True)]
    drawn = [_draw(residuals, block, generator) for _ in range(count)]
    thetas = []
    for number, errors in enumerate(drawn):
        resampled = [(u, s + e) for (u, _), s, e in zip(runs, fit.simulated, errors, strict=True)]
        again = search.improve(resampled, fit.model, fit.starts, iterations=_STEPS)
        if again is not None:
            thetas.append(again.model.theta)
        if tell is not None and number % 20 == 0:
            tell(number / count)
    samples = np.array(thetas)
    names = quantity_names(fit.model)
    value = quantities(fit.model)
    n = fit.model.a.size
    spread = np.array([quantities(_model(theta, n)) for theta in samples]).std(axis=0, ddof=1)
    reach = float(norm.ppf(0.5 + 0.5 * level))
    return Intervals(
        level=level,
        names=names,
        value=value,
        low=np.where(np.array(names) == "delay_s", np.maximum(value - reach * spread, 0.0), value - reach * spread),
        high=value + reach * spread,
        covariance=np.cov(samples.T),
        samples=samples,
    )


def quantity_names(model: Continuous) -> tuple[str, ...]:
    """Return what `quantities` returns: K and the pole of Eq. 31, or the coefficients of higher orders."""
    if model.a.size == 1:
        return ("K", "pole", "delay_s", "static_gain")
    a = tuple(f"a{i + 1}" for i in range(model.a.size))
    b = tuple(f"b{i}" for i in range(model.b.size))
    return (*b, *a, "delay_s", "static_gain")


def quantities(model: Continuous) -> Vector:
    """Return numerator, denominator, dead time and static gain."""
    return np.concatenate([model.b, model.a, [model.delay, model.b[-1] / model.a[-1]]])


def _model(theta: Vector, n: int) -> Continuous:
    return Continuous(a=theta[:n], b=theta[n:-1], delay=float(theta[-1]))


def _draw(residuals: Sequence[Vector], block: int, generator: np.random.Generator) -> list[Vector]:
    """Return residuals in blocks drawn from all runs, missing where they were missing."""
    pool = np.concatenate([e[np.isfinite(e)] for e in residuals])
    pool = pool - pool.mean()
    block = min(block, max(pool.size // 4, 1))
    drawn = []
    for e in residuals:
        starts = generator.integers(0, pool.size - block + 1, size=e.size // block + 1)
        values = np.concatenate([pool[s : s + block] for s in starts])[: e.size]
        drawn.append(np.where(np.isfinite(e), values, np.nan))
    return drawn
