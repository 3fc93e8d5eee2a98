"""Simplified refined instrumental variables in continuous time, one axis (Young and Jakeman 1980; Garnier 2015).

`yhat = B(s)/A(s) u(t - L)` is simulated exactly for an input that is held between samples, with the start of each run
as free parameters. The instruments are what the model itself says, `-s^i/A yhat` and `s^j/A u`, free of noise; the
regressors have in addition the filtered errors, joined by straight lines. The dead time is taken along by its
derivative, `-yhat'`. At the solution the errors are orthogonal to the instruments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions

_RUNTIME = "softneck.identification.linear._continuous_runtime"
_ITERATIONS = 40
# A step that moves the fit by less than this part of the error is rounding.
_TOLERANCE = 1e-9
# Errors stay for so long at most, scaled: five time constants.
_CORRELATED = 1.0
Runs = Sequence[tuple[Vector, Vector]]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Continuous:
    """`B(s)/A(s) exp(-L s)`.

    Attributes:
        a: (n,) A without its leading one, highest power first.
        b: (m,) B, highest power first, m <= n.
        delay: L [s].
    """

    a: Vector
    b: Vector
    delay: float

    @property
    def theta(self) -> Vector:
        """(n + m + 1,) a, b and the dead time."""
        return np.concatenate([self.a, self.b, [self.delay]])

    def discretize(self, sample_time: float) -> tuple[Vector, Vector, int]:
        """Return a, b and the whole samples of delay of the same system with its input held: exact, also between."""
        A, e, C = self.canonical()
        d, old, new, Ad = _held(A, e, self.delay, sample_time)
        a = np.real(np.poly(Ad))
        above = [np.real(np.poly(Ad - np.outer(g, C))) - a for g in (new, old)]
        return a[1:], np.concatenate([above[0][1:], [0.0]]) + np.concatenate([[0.0], above[1][1:]]), d

    def canonical(self) -> tuple[Matrix, Vector, Vector]:
        """Return A (n, n), e (n,), C (n,) in controllable form: the states are X, X', ..."""
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
    """A model and what it leaves over.

    Attributes:
        model: the transfer function.
        cost: sum of squared errors.
        simulated: (time,) of each run.
        starts: of each run, what each run began with, and its offset.
        information: (p, p) instruments' moments per squared noise, of (a, b, L), all else eliminated.
        rows: measured samples.
    """

    model: Continuous
    cost: float
    simulated: list[Vector]
    starts: Sequence[Vector]
    information: Matrix
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SrivcFitOptions:
    """How a fit is made.

    Attributes:
        sample_time: [s].
        order: poles n.
        offset: estimate a constant on the output of each run as well (for windows around an operating point).
        max_delay: bound on the dead time [s].
        free_delay: take the dead time along; otherwise it stays.
        fastest: bound on the poles [1/s].
        runs_per_time_constant: bound on time constants, as a part of the longest run: what is slower is a drift that
            each run's start makes up for.
    """

    sample_time: float
    order: int = 1
    offset: bool = False
    max_delay: float = 0.3
    free_delay: bool = True
    fastest: float = 100.0
    runs_per_time_constant: float = 3.0

    def start(self, runs: Runs, pole: float, delay: float) -> SrivcFit | None:
        """Return a fit from A = (s + pole)^n: one step of least squares, then `improve`."""
        a = np.real(np.poly(np.full(self.order, -pole)))[1:]
        first = Continuous(a=a, b=np.zeros(1), delay=delay)
        starts = [np.zeros(self.order + self.offset) for _ in runs]
        return self.improve(runs, first, starts)

    def improve(self, runs: Runs, model: Continuous, starts: Sequence[Vector]) -> SrivcFit | None:
        """Return the fit that the iteration ends in; None where there is no stable one."""
        fit, moves = self._step(runs, model, starts)
        longest = max(u.size for u, _ in runs) * self.sample_time
        for _ in range(_ITERATIONS):
            better = self._line(runs, fit, moves, self.runs_per_time_constant / longest)
            if better is None:
                break
            gained = fit.cost - better[0].cost
            fit, moves = better
            if gained <= _TOLERANCE * fit.cost:
                break
        return fit if np.any(fit.model.b) else None

    def _line(
        self, runs: Runs, fit: SrivcFit, moves: tuple[Vector, Sequence[Vector]], slowest: float
    ) -> tuple[SrivcFit, tuple] | None:
        size = 1.0
        for _ in range(12):
            model = self._moved(fit.model, size * moves[0], slowest)
            if model is not None:
                starts = [s + size * move for s, move in zip(fit.starts, moves[1], strict=True)]
                new = self._step(runs, model, starts)
                if new[0].cost < fit.cost:
                    return new
            size *= 0.5
        return None

    def _moved(self, model: Continuous, step: Vector, slowest: float) -> Continuous | None:
        n = self.order
        a, b = model.a + step[:n], model.b + step[n : n + model.b.size]
        poles = np.roots(np.concatenate([[1.0], a]))
        if poles.real.max() > -slowest or np.abs(poles).max() > self.fastest:
            return None
        delay = float(np.clip(model.delay + step[-1], 0.0, self.max_delay)) if self.free_delay else model.delay
        return Continuous(a=a, b=b, delay=delay)

    def _step(
        self, runs: Runs, model: Continuous, starts: Sequence[Vector]
    ) -> tuple[SrivcFit, tuple[Vector, list[Vector]]]:
        """Return the fit at `model` and the move from it: of (a, b, L) and of the starts."""
        rows = [self._rows(u, y, model, start) for (u, y), start in zip(runs, starts, strict=True)]
        cost = sum(float(r.errors @ r.errors) for r in rows)
        Z = np.concatenate([r.instruments_off for r in rows])
        Phi = np.concatenate([r.regressors_off for r in rows])
        e = np.concatenate([r.errors_off for r in rows])
        kept = slice(None) if self.free_delay else slice(0, -1)
        if not np.any(model.b):
            kept = slice(self.order, -1)  # nothing simulated yet: least squares of the numerator alone
        step = np.zeros(Phi.shape[1])
        moment = Z[:, kept].T @ Phi[:, kept]
        step[kept] = np.linalg.lstsq(moment, Z[:, kept].T @ e)[0]
        moves = [r.nuisance_move(step) for r in rows]
        fit = SrivcFit(
            model=model,
            cost=cost,
            simulated=[r.simulated for r in rows],
            starts=starts,
            information=Z.T @ Z,
            rows=e.size,
        )
        return fit, (step, moves)

    def _rows(self, u: Vector, y: Vector, model: Continuous, start: Vector) -> _RunColumns:
        n, functions = self.order, load_functions(_RUNTIME)
        A, e, C = model.canonical()
        big, drive = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
        for i in range(3):
            big[i * n : (i + 1) * n, i * n : (i + 1) * n] = A
        big[3 * n - 1, :n] = C
        big[3 * n - 1, n] += 1.0
        drive[:n] = e
        d, old, new, transition = _held(big, drive, model.delay, self.sample_time)
        states = np.zeros((u.size, 3 * n))
        # Before the record the first input was held.
        states[0, 0] = u[0] / model.a[-1]
        states[0, n : 2 * n] = start[:n]
        functions.ct_simulate(transition, old, new, u, d, states[0].copy(), states)
        simulated = states[:, :n] @ C + states[:, n] + (start[n] if self.offset else 0.0)
        there = np.isfinite(y)
        errors = np.where(there, y - simulated, 0.0)
        filtered = np.zeros((u.size, n))
        functions.ct_filter(*_joined(A, e, self.sample_time), errors, filtered)
        late = np.concatenate([np.full(min(d + 1, u.size), u[0]), u[: max(u.size - d - 1, 0)]])
        slope = -(states[:, :n] @ (C @ A) + C[-1] * late)
        columns = np.column_stack([states[:, :1], slope])
        own = -states[:, 2 * n :][:, ::-1]
        nuisance = _free_responses(A, u.size, self.sample_time)
        if self.offset:
            nuisance = np.column_stack([nuisance, np.ones(u.size)])
        return _RunColumns(
            simulated=simulated,
            errors=errors[there],
            instruments=np.column_stack([own, columns])[there],
            regressors=np.column_stack([own - filtered[:, ::-1], columns])[there],
            nuisance=nuisance[there],
        )


class _RunColumns:
    """One run's columns, and the same with its start projected off."""

    def __init__(
        self, *, simulated: Vector, errors: Vector, instruments: Matrix, regressors: Matrix, nuisance: Matrix
    ) -> None:
        self.simulated, self.errors = simulated, errors
        self._regressors, self._nuisance = regressors, nuisance
        scale = np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300)
        Q, R = np.linalg.qr(nuisance / scale)
        Q = Q[:, np.abs(np.diag(R)) > 1e-10]
        self.instruments_off = instruments - Q @ (Q.T @ instruments)
        self.regressors_off = regressors - Q @ (Q.T @ regressors)
        self.errors_off = errors - Q @ (Q.T @ errors)

    def nuisance_move(self, step: Vector) -> Vector:
        """Return how the start moves where (a, b, L) move by `step`."""
        return np.linalg.lstsq(self._nuisance, self.errors - self._regressors @ step)[0]


def _held(A: Matrix, e: Vector, delay: float, sample_time: float) -> tuple[int, Vector, Vector, Matrix]:
    """Return whole samples of delay, the weights of the older and newer input, and the transition over a sample."""
    d = int(np.floor(delay / sample_time + 1e-9))
    rest = min(max(delay - d * sample_time, 0.0), sample_time)
    first, second = _expm_pair(A, e, rest), _expm_pair(A, e, sample_time - rest)
    return d, second[0] @ first[1], second[1], second[0] @ first[0]


def _expm_pair(A: Matrix, e: Vector, time: float) -> tuple[Matrix, Vector]:
    from scipy.linalg import expm

    n = e.size
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n] = A, e
    E = np.asarray(expm(joint * time))
    return E[:n, :n], E[:n, n]


def _joined(A: Matrix, e: Vector, Ts: float) -> tuple[Matrix, Vector, Vector]:
    """Return the transition and the weights of an input's sample and the next one, joined by a straight line."""
    from scipy.linalg import expm

    n = e.size
    joint = np.zeros((n + 2, n + 2))
    joint[:n, :n], joint[:n, n], joint[n, n + 1] = A, e, 1.0 / Ts
    E = np.asarray(expm(joint * Ts))
    return E[:n, :n], E[:n, n] - E[:n, n + 1], E[:n, n + 1]


def _free_responses(A: Matrix, size: int, sample_time: float) -> Matrix:
    """Return the first row of exp(A t), (size, n): what starts can leave on the output."""
    from scipy.linalg import expm

    n = A.shape[0]
    Ad = np.asarray(expm(A * sample_time))
    rows = np.zeros((size, n))
    states = np.zeros((size, n))
    zero = np.zeros(n)
    for i in range(n):
        load_functions(_RUNTIME).ct_simulate(Ad, zero, zero, np.zeros(size), 0, np.eye(n)[i], states)
        rows[:, i] = states[:, 0]
    return rows


def deviations(search: SrivcFitOptions, runs: Runs, fit: SrivcFit) -> tuple[Vector, float]:
    """Return standard deviations of static gain, pole, dead time and K, and the fit [%] about each run's mean.

    Args:
        search: how `fit` was found; with one pole.
        runs: that it was fitted to.
        fit: the model and what it leaves over.
    """
    errors = [(y - s)[np.isfinite(y)] for (_, y), s in zip(runs, fit.simulated, strict=True)]
    spread = sum(float(np.sum((y[np.isfinite(y)] - np.nanmean(y)) ** 2)) for _, y in runs)
    e = np.concatenate(errors)
    # Errors that stay for n samples count as one in n.
    variance = float(np.mean(e**2)) * _correlation_time(errors, round(_CORRELATED / search.sample_time))
    covariance = variance * np.linalg.pinv(fit.information, hermitian=True)
    p, K = fit.model.a[0], fit.model.b[0]
    slope = np.array([-K / p**2, 1.0 / p, 0.0])
    gain = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
    a, b, L = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return np.array([gain, a, L, b]), 100.0 * (1.0 - float(np.sqrt(fit.cost / max(spread, 1e-300))))


def _correlation_time(errors: Sequence[Vector], lags: int) -> float:
    """Return the sum of the autocorrelation over both sides, while it is positive, at least 1."""
    power = sum(float(e @ e) for e in errors)
    total = 1.0
    for k in range(1, lags + 1):
        r = sum(float(e[k:] @ e[:-k]) for e in errors if e.size > k) / max(power, 1e-300)
        if r <= 0.05:
            break
        total += 2.0 * r
    return total
