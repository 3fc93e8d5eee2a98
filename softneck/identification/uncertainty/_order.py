"""One, two or three poles behind a dead time: the order is chosen by the error of the free run on rows held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softneck.core import Vector

from ..linear._srivc_fit import Continuous, Runs, SrivcFit, SrivcFitOptions

ORDERS = (1, 2, 3)
# The last part of each run is held out, as `softneck identify --train 0.7` does.
_TRAINED = 0.7
# Stretches of what is held out of each run: their scatter is the standard error of a difference.
_STRETCHES = 5


def choose_order(search: SrivcFitOptions, runs: Runs, near: Continuous) -> tuple[Continuous | None, Vector]:
    """Return the model of the order chosen, fitted to all rows, and the rms errors of each order on what is held out.

    The lowest order whose error is within one standard error of the least is taken (Breiman et al. 1984, 3.4.3), as
    stretches of the runs differ: one pole more must be worth it on all of them.

    Args:
        search: how to fit; its order is overridden.
        runs: input and output of every run.
        near: one pole and dead time to start from.

    Returns:
        the model, None where no order can be fitted; (3,) rms errors in the output's unit, NaN where one cannot.
    """
    squares = {n: found for n in ORDERS if (found := _held_out(replace(search, order=n), runs, near)) is not None}
    errors = {n: error for n, (_, error) in squares.items()}
    rms = np.array([np.sqrt(errors[n].mean()) if n in errors else np.nan for n in ORDERS])
    if not errors:
        return None, rms
    best = min(errors, key=lambda n: float(errors[n].mean()))
    order = next(n for n in sorted(errors) if n == best or _as_good(errors[n] - errors[best]))
    start = squares[order][0]
    fit = replace(search, order=order).improve(runs, start.model, start.starts)
    return (start if fit is None else fit).model, rms


def _as_good(worse: Vector) -> bool:
    """Return whether errors are larger by no more than one standard error of the difference."""
    return bool(worse.mean() <= worse.std(ddof=1) / np.sqrt(worse.size))


def _held_out(search: SrivcFitOptions, runs: Runs, near: Continuous) -> tuple[SrivcFit, Vector] | None:
    """Return a fit and its mean squared errors in free run over stretches that it did not see; None without a fit."""
    trained = []
    for u, y in runs:
        seen = y.copy()
        seen[round(_TRAINED * y.size) :] = np.nan
        trained.append((u, seen))
    # As many poles of n times the speed lag as much as one; others leave valleys where dead time is a pole.
    speeds = (1.0, 0.3, 3.0) if search.order > 1 else (1.0,)
    tried = [search.start(trained, search.order * k * float(near.a[0]), near.delay) for k in speeds]
    there = [fit for fit in tried if fit is not None and fit.model.a[-1] * fit.model.b[0] > 0.0]
    if not there:
        return None
    fit = min(there, key=lambda fit: fit.cost)
    squares = []
    for (_, y), simulated in zip(runs, fit.simulated, strict=True):
        late = slice(round(_TRAINED * y.size), None)
        squares += [float(np.nanmean(part)) for part in np.array_split((y - simulated)[late] ** 2, _STRETCHES)
                    if np.isfinite(part).any()]  # fmt: skip
    return fit, np.array(squares)
