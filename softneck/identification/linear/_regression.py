"""Rows of linear regressions (Eq. 26) over runs that are never joined, and whether they determine anything."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import DataError, Matrix

# Columns of unit length: above it rounding and noise decide the parameters; a real record stays below 1e4.
_WORST_CONDITION = 1e8


def arx_rows(
    runs: Sequence[tuple[Matrix, Matrix]], na: int, nb: int, delay: int, *, lag: int | None = None
) -> tuple[Matrix, Matrix]:
    """Return phi(t-1) of Eq. 26 (rows, n) and y(t) (rows, ny) of all runs; a row with a missed sample is left out.

    Args:
        runs: outputs (time, ny) and inputs (time, nu) of each run; the first output is the one described.
        na, nb: samples of each output and each input.
        delay: dead time in samples; the newest input is u(t - delay - 1).
        lag: rows skipped at the start of each run; as many as needed by default.
    """
    need = max(na, nb + delay)
    first = need if lag is None else max(lag, need)
    parts, targets = [], []
    for Y, U in runs:
        if len(Y) <= first:
            continue
        rows = slice(first, len(Y))
        columns = [-Y[first - i : len(Y) - i, j] for j in range(Y.shape[1]) for i in range(1, na + 1)]
        columns += [U[first - delay - i : len(Y) - delay - i, j] for j in range(U.shape[1]) for i in range(1, nb + 1)]
        parts.append(np.column_stack(columns))
        targets.append(Y[rows])
    if not parts:
        raise DataError(
            f"every run is shorter than the {first + 1} samples that this order and dead time need; "
            "lower them or record longer."
        )
    Phi, y = np.concatenate(parts), np.concatenate(targets)
    good = np.isfinite(Phi).all(axis=1) & np.isfinite(y[:, 0])
    return np.ascontiguousarray(Phi[good]), np.ascontiguousarray(y[good])


def condition(Phi: Matrix) -> float:
    """Return the condition number of the regressors, their columns scaled to unit length; inf for a zero column."""
    norms = np.linalg.norm(Phi, axis=0)
    if Phi.shape[0] < Phi.shape[1] or norms.min(initial=np.inf) == 0.0:
        return float("inf")
    return float(np.linalg.cond(Phi / norms))


def require_excitation(what: str, Phi: Matrix) -> float:
    """Return the condition number of the regressors; raise DataError where they do not determine the parameters."""
    number = condition(Phi)
    if not number <= _WORST_CONDITION:
        raise DataError(
            f"{what}: the data does not determine the {Phi.shape[1]} parameters (condition number {number:.2g}, "
            f"{len(Phi)} rows): its input stands still, repeats another, or the order is too high. "
            "Record with an excitation such as `eq22`, or lower the orders."
        )
    return number
