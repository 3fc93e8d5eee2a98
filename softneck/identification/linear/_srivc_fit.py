"""Simplified refined instrumental variables in continuous time, one axis (Young and Jakeman 1980; Garnier 2015).

`yhat = B(s)/A(s) u(t - L)` is simulated exactly for an input that is constant between samples, with the start of each
run as free parameters. The instruments come from the simulation, `-s^i/A yhat` and `s^j/A u`, and are free of noise.
The regressors also include the filtered errors, linear between samples. The dead time enters by its derivative,
`-yhat'`. At the solution the errors are orthogonal to the instruments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions

_CT_RUNTIME = "softneck.identification.linear._continuous_runtime"
_MAX_ITERATIONS = 40
# Relative decrease of the cost at which the search ends; less is rounding.
_COST_TOLERANCE = 1e-9
# Longest correlation of errors [scaled s]: five time constants.
_MAX_CORRELATION_S = 1.0
Runs = Sequence[tuple[Vector, Vector]]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Continuous:
    """`B(s)/A(s) exp(-L s)`: a (n,) without its leading one and b (m,), m <= n, highest power first; delay L [s]."""

    a: Vector
    b: Vector
    delay: float

    @property
    def theta(self) -> Vector:
        """(n + m + 1,) a, b and the dead time."""
        return np.concatenate([self.a, self.b, [self.delay]])

    def discretize(self, sample_time: float) -> tuple[Vector, Vector, int]:
        """Discretize by a zero-order hold, exactly for any dead time; return a, b and the whole samples of delay."""
        A, e, C = self.canonical()
        d, old, new, Ad = _discretize_zoh(A, e, self.delay, sample_time)
        a = np.real(np.poly(Ad))
        above = [np.real(np.poly(Ad - np.outer(g, C))) - a for g in (new, old)]
        return a[1:], np.concatenate([above[0][1:], [0.0]]) + np.concatenate([[0.0], above[1][1:]]), d

    def canonical(self) -> tuple[Matrix, Vector, Vector]:
        """Return A (n, n), e (n,), C (n,) in controllable form, with the states X, X', ..."""
        n = self.a.size
        A = np.eye(n, k=1)
        A[-1] = -self.a[::-1]
        e = np.zeros(n)
        e[-1] = 1.0
        C = np.zeros(n)
        C[: self.b.size] = self.b[::-1]
        return A, e, C


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SrivcFit:
    """A fitted model, the sum of squared errors `cost`, and `simulated` (time,) of each run.

    starts: initial states of each run, and its offset; information: (p, p) moments of the instruments of (a, b, L),
    with the starts eliminated.
    """

    model: Continuous
    cost: float
    simulated: list[Vector]
    starts: Sequence[Vector]
    information: Matrix


@dataclass(frozen=True, slots=True, kw_only=True)
class SrivcFitOptions:
    """Settings of the fit.

    sample_time, max_delay: [s]; order: poles n; offset: estimate a constant on the output of each run (for windows
    around an operating point); free_delay: estimate the dead time; fastest: bound on the poles [1/s];
    runs_per_time_constant: the longest run over the largest time constant, as slower poles only fit a drift.
    """

    sample_time: float
    order: int = 1
    offset: bool = False
    max_delay: float = 0.3
    free_delay: bool = True
    fastest: float = 100.0
    runs_per_time_constant: float = 3.0

    def start(self, runs: Runs, pole: float, delay: float) -> SrivcFit | None:
        """Fit from A = (s + pole)^n by one step of least squares and `improve`."""
        a = np.real(np.poly(np.full(self.order, -pole)))[1:]
        first = Continuous(a=a, b=np.zeros(1), delay=delay)
        starts = [np.zeros(self.order + self.offset) for _ in runs]
        return self.improve(runs, first, starts)

    def improve(self, runs: Runs, model: Continuous, starts: Sequence[Vector]) -> SrivcFit | None:
        """Iterate from a model and starts to the fit; None where there is no stable one."""
        fit, moves = self._step(runs, model, starts)
        slowest = self.runs_per_time_constant / (max(u.size for u, _ in runs) * self.sample_time)
        for _ in range(_MAX_ITERATIONS):
            better = self._search_line(runs, fit, moves, slowest)
            if better is None:
                break
            gained = fit.cost - better[0].cost
            fit, moves = better
            if gained <= _COST_TOLERANCE * fit.cost:
                break
        return fit if np.any(fit.model.b) else None

    def _search_line(
        self, runs: Runs, fit: SrivcFit, moves: tuple[Vector, Sequence[Vector]], slowest: float
    ) -> tuple[SrivcFit, tuple] | None:
        """Halve the step until the cost falls; return the fit and its next step, or None."""
        size = 1.0
        for _ in range(12):
            step, n = size * moves[0], self.order
            a, b = fit.model.a + step[:n], fit.model.b + step[n : n + fit.model.b.size]
            poles = -a if n == 1 else np.roots(np.concatenate([[1.0], a]))
            if poles.real.max() <= -slowest and np.abs(poles).max() <= self.fastest:
                L = fit.model.delay
                L = float(np.clip(L + step[-1], 0.0, self.max_delay)) if self.free_delay else L
                model = Continuous(a=a, b=b, delay=L)
                starts = [s + size * move for s, move in zip(fit.starts, moves[1], strict=True)]
                new = self._step(runs, model, starts)
                if new[0].cost < fit.cost:
                    return new
            size *= 0.5
        return None

    def _step(
        self, runs: Runs, model: Continuous, starts: Sequence[Vector]
    ) -> tuple[SrivcFit, tuple[Vector, list[Vector]]]:
        """Return the fit at `model` and the next step, of (a, b, L) and of the starts."""
        discrete = _Discrete.of(model, self.sample_time, max(u.size for u, _ in runs))
        rows = [self._run_columns(u, y, discrete, start) for (u, y), start in zip(runs, starts, strict=True)]
        cost = sum(float(r.errors @ r.errors) for r in rows)
        Z = np.concatenate([r.instruments_off for r in rows])
        Phi = np.concatenate([r.regressors_off for r in rows])
        e = np.concatenate([r.errors_off for r in rows])
        kept = slice(None) if self.free_delay else slice(0, -1)
        if not np.any(model.b):
            kept = slice(self.order, -1)  # at the start: least squares of the numerator alone
        step = np.zeros(Phi.shape[1])
        moment = Z[:, kept].T @ Phi[:, kept]
        step[kept] = np.linalg.lstsq(moment, Z[:, kept].T @ e)[0]
        simulated = [r.simulated for r in rows]
        fit = SrivcFit(model=model, cost=cost, simulated=simulated, starts=starts, information=Z.T @ Z)
        return fit, (step, [r.start_step(step) for r in rows])

    def _run_columns(self, u: Vector, y: Vector, at: _Discrete, start: Vector) -> _RunColumns:
        """Simulate one run and return its errors, instruments and regressors."""
        n, functions = self.order, load_functions(_CT_RUNTIME)
        states = np.zeros((u.size, 3 * n))
        # At rest under the first input before the recording.
        states[0, 0] = u[0] / at.model.a[-1]
        states[0, n : 2 * n] = start[:n]
        functions.ct_simulate(at.transition, at.old, at.new, u, at.late, states[0].copy(), states)
        simulated = states[:, :n] @ at.C + states[:, n] + (start[n] if self.offset else 0.0)
        there = np.isfinite(y)
        errors = np.where(there, y - simulated, 0.0)
        filtered = np.zeros((u.size, n))
        functions.ct_filter(*at.filter, errors, filtered)
        late = np.concatenate([np.full(min(at.late + 1, u.size), u[0]), u[: max(u.size - at.late - 1, 0)]])
        slope = -(states[:, :n] @ at.slope + at.C[-1] * late)
        columns = np.column_stack([states[:, :1], slope])
        own = -states[:, 2 * n :][:, ::-1]
        nuisance = at.free[: u.size]
        if self.offset:
            nuisance = np.column_stack([nuisance, np.ones(u.size)])
        return _RunColumns(
            simulated=simulated,
            errors=errors[there],
            instruments=np.column_stack([own, columns])[there],
            regressors=np.column_stack([own - filtered[:, ::-1], columns])[there],
            nuisance=nuisance[there],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Discrete:
    """A model at a sample time, the same for all runs.

    transition, old, new, late: of the states, their model's response and its derivatives (3 n); filter: of the errors;
    C, slope: (n,) of the output and of its derivative; free: (longest run, n) responses to a start.
    """

    model: Continuous
    transition: Matrix
    old: Vector
    new: Vector
    late: int
    filter: tuple[Matrix, Vector, Vector]
    C: Vector
    slope: Vector
    free: Matrix

    @classmethod
    def of(cls, model: Continuous, sample_time: float, longest: int) -> _Discrete:
        A, e, C = model.canonical()
        n = e.size
        big, drive = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
        for i in range(3):
            big[i * n : (i + 1) * n, i * n : (i + 1) * n] = A
        big[3 * n - 1, :n] = C
        big[3 * n - 1, n] += 1.0
        drive[:n] = e
        late, old, new, transition = _discretize_zoh(big, drive, model.delay, sample_time)
        free = _free_responses(transition[:n, :n].copy(), longest)
        return cls(model, transition, old, new, late, _discretize_foh(A, e, sample_time), C, C @ A, free)


class _RunColumns:
    """Columns of one run, and the same with its start projected off."""

    def __init__(
        self, *, simulated: Vector, errors: Vector, instruments: Matrix, regressors: Matrix, nuisance: Matrix
    ) -> None:
        self.simulated, self.errors = simulated, errors
        self._regressors, self._nuisance = regressors, nuisance
        scale = np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300)
        Q, R = np.linalg.qr(nuisance / scale)
        kept = np.abs(np.diag(R)) > 1e-10
        Q = Q[:, kept]
        # Q and what gives the start from it, where no column depends on the others.
        self._basis = (Q, R * scale) if kept.all() else None
        self.instruments_off = instruments - Q @ (Q.T @ instruments)
        self.regressors_off = regressors - Q @ (Q.T @ regressors)
        self.errors_off = errors - Q @ (Q.T @ errors)

    def start_step(self, step: Vector) -> Vector:
        """Return the step of the start for a `step` of (a, b, L)."""
        left = self.errors - self._regressors @ step
        if self._basis is None:
            return np.linalg.lstsq(self._nuisance, left)[0]
        Q, R = self._basis
        return np.linalg.solve(R, Q.T @ left)


def _discretize_zoh(A: Matrix, e: Vector, delay: float, sample_time: float) -> tuple[int, Vector, Vector, Matrix]:
    """Return whole samples of delay, the weights of the older and newer input, and the transition over a sample."""
    from scipy.linalg import expm

    def discretize(time: float) -> tuple[Matrix, Vector]:
        n = e.size
        joint = np.zeros((n + 1, n + 1))
        joint[:n, :n], joint[:n, n] = A, e
        E = np.asarray(expm(joint * time))
        return E[:n, :n], E[:n, n]

    d = int(np.floor(delay / sample_time + 1e-9))
    rest = min(max(delay - d * sample_time, 0.0), sample_time)
    first, second = discretize(rest), discretize(sample_time - rest)
    return d, second[0] @ first[1], second[1], second[0] @ first[0]


def _discretize_foh(A: Matrix, e: Vector, Ts: float) -> tuple[Matrix, Vector, Vector]:
    """Return the transition and the weights of this and the next sample of an input linear between them."""
    from scipy.linalg import expm

    n = e.size
    joint = np.zeros((n + 2, n + 2))
    joint[:n, :n], joint[:n, n], joint[n, n + 1] = A, e, 1.0 / Ts
    E = np.asarray(expm(joint * Ts))
    return E[:n, :n], E[:n, n] - E[:n, n + 1], E[:n, n + 1]


def _free_responses(Ad: Matrix, size: int) -> Matrix:
    """Return the first rows of Ad^k, (size, n), a basis of the responses to a start."""
    n = len(Ad)
    rows, states, zero = np.zeros((size, n)), np.zeros((size, n)), np.zeros(n)
    for i in range(n):
        load_functions(_CT_RUNTIME).ct_simulate(Ad, zero, zero, np.zeros(size), 0, np.eye(n)[i], states)
        rows[:, i] = states[:, 0]
    return rows


def deviations(search: SrivcFitOptions, runs: Runs, fit: SrivcFit) -> tuple[Vector, float]:
    """Return standard deviations of static gain, pole, dead time and K of a one-pole fit, and the fit [%]."""
    errors = [(y - s)[np.isfinite(y)] for (_, y), s in zip(runs, fit.simulated, strict=True)]
    spread = sum(float(np.sum((y[np.isfinite(y)] - np.nanmean(y)) ** 2)) for _, y in runs)
    e = np.concatenate(errors)
    # Errors correlated over n samples count as one in n.
    variance = float(np.mean(e**2)) * _correlation_time(errors, round(_MAX_CORRELATION_S / search.sample_time))
    covariance = variance * np.linalg.pinv(fit.information, hermitian=True)
    p, K = fit.model.a[0], fit.model.b[0]
    slope = np.array([-K / p**2, 1.0 / p, 0.0])
    gain = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
    a, b, L = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return np.array([gain, a, L, b]), 100.0 * (1.0 - float(np.sqrt(fit.cost / max(spread, 1e-300))))


def _correlation_time(errors: Sequence[Vector], lags: int) -> float:
    """Return the correlation time [samples], the sum of the autocorrelation while it is positive; 1 or more."""
    power = sum(float(e @ e) for e in errors)
    total = 1.0
    for k in range(1, lags + 1):
        r = sum(float(e[k:] @ e[:-k]) for e in errors if e.size > k) / max(power, 1e-300)
        if r <= 0.05:
            break
        total += 2.0 * r
    return total
