"""Output error of one axis by variable projection: only the poles are searched, all else is linear in them.

`y(k) = B(q) / F(q) u(k - d) + c(q) / F(q) pulse(k) + e(k)`: B by least squares for each F, and c, the start of each
run, projected out (Golub and Pereyra 2003; Ljung 1999, sec. 10.2). Derivatives are exact, by filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector

# A time constant beyond a third of the longest run is no more than a drift that each run's start makes up for.
_RUNS_PER_TIME_CONSTANT = 3.0
_ITERATIONS = 50
# A step that changes the sum of squares by less than this part changes no digit that noise leaves.
_TOLERANCE = 1e-10
# Time constants [s] from which the search starts, beside that of least squares: a neck has 0.2 s.
_TIME_CONSTANTS = (0.05, 0.2, 0.8)

# -log of the rounding of a double.
_ROUNDING = 36.0

Runs = Sequence[tuple[Vector, Vector]]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OutputErrorFit:
    """One axis at one dead time.

    Attributes:
        f: (nf,) denominator without its leading one.
        b: (nb,) numerator.
        cost: sum of squared errors.
        covariance: (nf + nb, nf + nb) of (f, b), if the output noise is white.
        residuals: one (time,) each run, NaN where nothing was measured.
        rows: measured samples.
    """

    f: Vector
    b: Vector
    cost: float
    covariance: Matrix
    residuals: list[Vector]
    rows: int


def fit_output_error(runs: Runs, nf: int, nb: int, d: int, starts: Sequence[Vector]) -> OutputErrorFit | None:
    """Return the best fit over all `starts` (nf,); None where none is stable."""
    best: tuple[float, Vector] | None = None
    radius = largest_radius(runs)
    for start in starts:
        found = _search(runs, nb, d, _inside(start, radius), radius)
        if best is None or found[0] < best[0]:
            best = found
    if best is None or not np.isfinite(best[0]):
        return None
    return _finish(runs, nf, nb, d, best[1])


def default_starts(nf: int, sample_time: float, least_squares: Vector | None) -> list[Vector]:
    """Return denominators to start from: that of least squares, and poles at spread time constants."""
    starts = [] if least_squares is None else [least_squares]
    for tau in _TIME_CONSTANTS:
        poles = np.exp(-sample_time / (tau * np.geomspace(1.0, 0.3, nf)))
        starts.append(np.poly(poles)[1:])
    return starts


def largest_radius(runs: Runs) -> float:
    """Return the bound on the poles: they must settle within a run."""
    return float(np.exp(-_RUNS_PER_TIME_CONSTANT / max(u.size for u, _ in runs)))


def _search(runs: Runs, nb: int, d: int, f: Vector, radius: float) -> tuple[float, Vector]:
    """Levenberg-Marquardt over f on the projected problem (Kaufman's derivative)."""
    cost, r, J = _projected(runs, f, nb, d)
    damping = 1e-3
    for _ in range(_ITERATIONS):
        H, g = J.T @ J, J.T @ r
        gained = 0.0
        while damping < 1e8:
            step = np.linalg.solve(H + damping * np.diag(np.maximum(np.diag(H), 1e-300)), g)
            trial = f + step
            if pole_radius(trial) <= radius:
                new = _projected(runs, trial, nb, d)
                if new[0] < cost:
                    gained = cost - new[0]
                    f, (cost, r, J) = trial, new
                    damping = max(damping / 10.0, 1e-12)
                    break
            damping *= 10.0
        if gained <= _TOLERANCE * cost:
            break
    return cost, f


def _projected(runs: Runs, f: Vector, nb: int, d: int) -> tuple[float, Vector, Matrix]:
    """Return cost, residual and derivative of the prediction by f, b and the starts eliminated."""
    X, y, starts = _columns(runs, f, nb, d)
    Q = _basis(X)
    r = y - Q @ (Q.T @ y)
    b = np.linalg.lstsq(X, y)[0]
    S = _pole_columns(runs, f, b, d, starts)
    return float(r @ r), r, S - Q @ (Q.T @ S)


def _columns(runs: Runs, f: Vector, nb: int, d: int) -> tuple[Matrix, Vector, list[Matrix]]:
    """Return regressors of b (rows, nb) and outputs (rows,), the starts projected out, and each run's projector."""
    parts, targets, bases = [], [], []
    for u, y in runs:
        there = np.isfinite(y)
        Q = _start_basis(f, u.size, there)
        parts.append(_without(Q, _input_columns(u, f, nb, d)[there]))
        targets.append(_without(Q, y[there]))
        bases.append(Q)
    return np.concatenate(parts), np.concatenate(targets), bases


def _pole_columns(runs: Runs, f: Vector, b: Vector, d: int, bases: list[Matrix]) -> Matrix:
    """Return the derivative of the output by f, `-q^-i / F y`, the starts projected out."""
    F = np.concatenate([[1.0], f])
    parts = []
    for (u, y), Q in zip(runs, bases, strict=True):
        there = np.isfinite(y)
        forced = _input_columns(u, f, b.size, d) @ b
        # The whole output, with its own start, is what F filters.
        left = y[there] - forced[there]
        response = _start_responses(f, u.size)
        n = len(response)
        output = forced
        output[:n] += response @ np.linalg.lstsq(response[there[:n]], left[: int(there[:n].sum())])[0]
        S = np.column_stack([_late(-_filtered(F, output), i) for i in range(1, f.size + 1)])[there]
        parts.append(_without(Q, S))
    return np.concatenate(parts)


def _finish(runs: Runs, nf: int, nb: int, d: int, f: Vector) -> OutputErrorFit:
    X, y, bases = _columns(runs, f, nb, d)
    b = np.linalg.lstsq(X, y)[0]
    r = y - X @ b
    J = np.column_stack([_pole_columns(runs, f, b, d, bases), X])
    rows = y.size
    free = max(rows - nf - nb - nf * len(runs), 1)
    cost = float(r @ r)
    residuals, at = [], 0
    for _, target in runs:
        there = np.isfinite(target)
        e = np.full(target.size, np.nan)
        e[there] = r[at : at + int(there.sum())]
        at += int(there.sum())
        residuals.append(e)
    covariance = cost / free * np.linalg.pinv(J.T @ J, hermitian=True)
    return OutputErrorFit(f=f, b=b, cost=cost, covariance=covariance, residuals=residuals, rows=rows)


def _input_columns(u: Vector, f: Vector, nb: int, d: int) -> Matrix:
    """Return `u(k - d - j) / F` for j = 1..nb as (time, nb), u(0) held before the record."""
    from scipy.signal import lfilter

    F = np.concatenate([[1.0], f])
    gain = u[0] / F.sum()
    # From equilibrium with the held input; the start of the run takes up whatever else it was.
    z0 = np.zeros(f.size)
    for i in range(f.size - 1, -1, -1):
        z0[i] = -f[i] * gain + (z0[i + 1] if i + 1 < f.size else 0.0)
    columns = []
    for j in range(1, nb + 1):
        late = min(d + j, u.size)
        delayed = np.concatenate([np.full(late, u[0]), u[: u.size - late]])
        columns.append(lfilter([1.0], F, delayed, zi=z0)[0])
    return np.column_stack(columns)


def _start_responses(f: Vector, size: int) -> Matrix:
    """Return `q^-i / F` of a pulse at the first sample, (up to size, nf): all that a start can be."""
    # What has died away below rounding is left out: a second or two of a long run.
    pulse = np.zeros(min(size, int(_ROUNDING / -np.log(max(pole_radius(f), 0.1))) + f.size + 1))
    pulse[0] = 1.0
    first = _filtered(np.concatenate([[1.0], f]), pulse)
    return np.column_stack([_late(first, i) for i in range(f.size)])


def _start_basis(f: Vector, size: int, there: np.ndarray) -> Matrix:
    response = _start_responses(f, size)
    return _basis(response[there[: len(response)]])


def _without(Q: Matrix, X: Matrix) -> Matrix:
    """Return `X` with its first rows projected off the basis of a start."""
    rest = X.copy()
    n = len(Q)
    rest[:n] -= Q @ (Q.T @ X[:n])
    return rest


def _filtered(F: Vector, x: Vector) -> Vector:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], F, x))


def _basis(X: Matrix) -> Matrix:
    """Return an orthonormal basis of the columns, those left out that add nothing."""
    U, s, _ = np.linalg.svd(X, full_matrices=False)
    return U[:, s > 1e-12 * max(float(s.max(initial=0.0)), 1e-300)]


def _late(x: Vector, samples: int) -> Vector:
    return np.concatenate([np.zeros(samples), x[: x.size - samples]]) if samples else x


def pole_radius(f: Vector) -> float:
    """Return the size of the largest root of z^n + f_1 z^(n-1) + ..."""
    return float(np.abs(np.roots(np.concatenate([[1.0], f]))).max(initial=0.0))


def _inside(f: Vector, radius: float) -> Vector:
    """Return `f` with its poles drawn within `radius`."""
    poles = np.roots(np.concatenate([[1.0], f]))
    size = np.abs(poles)
    if size.max(initial=0.0) <= radius:
        return f
    return np.real(np.poly(np.where(size <= radius, poles, 0.99 * radius * poles / np.maximum(size, 1e-300))))[1:]
