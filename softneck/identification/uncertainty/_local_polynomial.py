"""The local polynomial method: a frequency response with its covariance from any excitation, loops included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softneck.core import Matrix, Vector

ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """An estimate at (k,) rising frequencies [rad/s]; `response[k, i, a]` from input a to output i, NaN if not excited.

    covariance: (k, m q, m q), entry i q + a for `G[i, a]`, of noise and nonlinear distortion; freedom: (k,) its degrees
    of freedom; coherence: (k, m) part of each output's power that the inputs explain; noise: (k, m, q) variance by
    noise alone, None where it was not told apart.
    """

    frequency: Vector
    response: ComplexArray
    covariance: ComplexArray
    freedom: Vector
    coherence: Vector
    noise: Vector | None


# Degree of the polynomials of response and transient over a window of frequencies (Pintelon and Schoukens 2012, 7.2).
_POLYNOMIAL_DEGREE = 2
# Equations beyond the unknowns in each window: what is left over tells the noise, and so few tell it within 30 %.
_EXTRA_EQUATIONS = 10
# Windows of the least number of bins, and of so many times more; none reaches further than this part of the frequency.
_WIDTH_FACTORS = (1, 3, 9, 27)
_MAX_RELATIVE_WIDTH = 0.5
# Inputs, and ways to combine them, excited by less than this part of what is usual are not excited: rounding.
_MIN_EXCITATION = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """One run, transformed; frequencies (bins,) [rad/s] of both signs, without zero.

    driven: (bins, q) inputs, or the references of a closed loop; answered: (bins, m + p) outputs, in a loop inputs too.
    """

    frequency: Vector
    driven: ComplexArray
    answered: ComplexArray


def spectrum(driven: np.ndarray, answered: np.ndarray, sample_time: float) -> Spectrum:
    """Return the transforms of a run, rows are time; means are taken away."""
    scale = 1.0 / np.sqrt(driven.shape[0])
    frequency = 2.0 * np.pi * np.fft.fftfreq(driven.shape[0], sample_time)
    U, Z = (scale * np.fft.fft(part - part.mean(axis=0), axis=0) for part in (driven, answered))
    order = np.argsort(frequency)
    order = order[frequency[order] != 0.0]
    return Spectrum(frequency[order], U[order], Z[order])


def local_polynomial(runs: Sequence[Spectrum], frequency: Vector, outputs: int) -> Response:
    """Return the response of the first `outputs` answers to the inputs at `frequency` [rad/s].

    Around each frequency, response and transient of every run are polynomials of degree 2 in the frequency:
    `Z = G U + T + V`; least squares gives G, the residual the covariance of V (Pintelon and Schoukens 2012, 7.2.2).
    Where inputs stand behind the outputs in the answers (a closed loop), `G = G_yr G_ur^-1`.
    """
    q, answers = runs[0].driven.shape[1], runs[0].answered.shape[1]
    found = [_at(runs, float(w), q, answers) for w in frequency]
    G = np.array([item.response for item in found])
    noise = np.array([item.noise for item in found])
    spread = np.array([item.spread for item in found])
    freedom = np.array([item.freedom for item in found], dtype=np.float64)
    coherence = np.array([item.coherence[:outputs] for item in found])
    if answers > outputs:
        G, noise, spread = _behind_the_loop(G, noise, spread, outputs)
    size = outputs * G.shape[2]
    covariance = np.einsum("kij,kab->kiajb", noise, spread).reshape(-1, size, size)
    return Response(
        frequency=frequency, response=G, covariance=covariance, freedom=freedom, coherence=coherence, noise=None
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Response (answers, q), covariance of the noise, that of the estimate, and coherence (answers,)."""

    response: ComplexArray
    noise: ComplexArray
    spread: ComplexArray
    freedom: int
    coherence: Vector

    @property
    def variance(self) -> float:
        """The mean variance of the response's entries."""
        return float(np.trace(self.noise).real * np.trace(self.spread).real)


def _at(runs: Sequence[Spectrum], w: float, q: int, answers: int) -> _Fit:
    """Return the fit around w with the lowest variance over windows of growing width.

    A window too wide for its polynomials leaves over more, which the variance shows as well.
    """
    count = (_POLYNOMIAL_DEGREE + 1) * (q + len(runs)) + _EXTRA_EQUATIONS
    best = None
    for widening in _WIDTH_FACTORS:
        near = _nearest(runs, w, widening * count)
        reach = max(
            float(np.abs(run.frequency[rows] - w).max(initial=0.0)) for run, rows in zip(runs, near, strict=True)
        )
        if widening > 1 and reach > _MAX_RELATIVE_WIDTH * w:
            break
        found = _fit(runs, near, w, reach, q)
        if found is not None and (best is None or found.variance < best.variance):
            best = found
    if best is not None:
        return best
    nothing = (np.full(shape, np.nan + 0j) for shape in ((answers, q), (answers, answers), (q, q)))
    return _Fit(*nothing, freedom=1, coherence=np.zeros(answers))


def _fit(runs: Sequence[Spectrum], near: Sequence[np.ndarray], w: float, reach: float, q: int) -> _Fit | None:
    """Return the least-squares fit over the bins `near` w, None where some input is not excited there."""
    blocks, Z = [], []
    for number, (run, rows) in enumerate(zip(runs, near, strict=True)):
        powers = ((run.frequency[rows] - w) / reach)[:, None] ** np.arange(_POLYNOMIAL_DEGREE + 1)
        # Columns: G of every input, then its slope and its bend; the transient of each run by itself.
        response = (powers[:, :, None] * run.driven[rows][:, None, :]).reshape(rows.size, -1)
        transient = np.zeros((rows.size, len(runs), _POLYNOMIAL_DEGREE + 1), dtype=complex)
        transient[:, number] = powers
        blocks.append(np.hstack([response, transient.reshape(rows.size, -1)]))
        Z.append(run.answered[rows])
    A, Y = np.vstack(blocks), np.vstack(Z)
    freedom = A.shape[0] - A.shape[1]
    scale = np.linalg.norm(A, axis=0)
    usual = max(float(np.sqrt((np.abs(run.driven) ** 2).mean())) for run in runs)
    if freedom < 1 or scale[:q].min() < _MIN_EXCITATION * usual * np.sqrt(A.shape[0]):
        return None
    left, s, right = np.linalg.svd(A / scale, full_matrices=False)
    if s[-1] < _MIN_EXCITATION * s[0]:
        return None
    inverse = (right.conj().T / s) @ left.conj().T / scale[:, None]
    theta = inverse @ Y
    e = Y - A @ theta
    # What the inputs explain beside the transients.
    bare = A[:, (_POLYNOMIAL_DEGREE + 1) * q :]
    without = Y - bare @ np.linalg.lstsq(bare, Y)[0]
    return _Fit(
        response=theta[:q].T,
        # Rows are frequencies: E[v v^H] of a frequency's answers is e^T conj(e).
        noise=e.T @ e.conj() / freedom,
        spread=(inverse @ inverse.conj().T)[:q, :q],
        freedom=freedom,
        coherence=1.0 - (np.abs(e) ** 2).sum(axis=0) / np.maximum((np.abs(without) ** 2).sum(axis=0), 1e-300),
    )


def _nearest(runs: Sequence[Spectrum], w: float, count: int) -> list[np.ndarray]:
    """Return for each run the rows of the `count` bins of all runs that are nearest to w."""
    away = np.concatenate([np.abs(run.frequency - w) for run in runs])
    border = np.sort(away)[min(count, away.size) - 1] * (1.0 + 1e-12)
    return [np.flatnonzero(np.abs(run.frequency - w) <= border) for run in runs]


def _behind_the_loop(
    G: ComplexArray, noise: ComplexArray, spread: ComplexArray, outputs: int
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return response, noise and spread from inputs to outputs out of those from references to both.

    With `V = V_y - G V_u`, `dG = dV G_ur^-1` (Pintelon and Schoukens 2012, 7.2.7).
    """
    G_yr, G_ur = G[:, :outputs], G[:, outputs:]
    # Where nothing is known nothing can be inverted.
    known = np.isfinite(G_ur).all(axis=(1, 2))
    inverse = np.full_like(np.swapaxes(G_ur, 1, 2), np.nan)
    inverse[known] = np.linalg.pinv(G_ur[known])
    plant = G_yr @ inverse
    eye = np.broadcast_to(np.eye(outputs), (G.shape[0], outputs, outputs))
    T = np.concatenate([eye, -plant], axis=2)
    noise = T @ noise @ np.conj(np.swapaxes(T, 1, 2))
    spread = np.swapaxes(inverse, 1, 2) @ spread @ np.conj(inverse)
    return plant, noise, spread


# Lines that carry less than this part of the strongest line's amplitude are not excited: rounding of a text file.
_MIN_LINE_RATIO = 1e-4
# Experiments whose inputs are nearer to dependence than this are no set of orthogonal ones.
_MAX_CONDITION = 1e3
# The first third of the periods, one at least, holds the transient.
_TRANSIENT_DIVISOR = 3
# A sine: all of the rest of its power is below this part.
_SINE_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Periods:
    """A run of equal periods, transformed, without those in which it settles.

    frequency: (lines,) [rad/s], above zero; amplitudes of inputs (lines, q) and outputs (periods, lines, m).
    """

    frequency: Vector
    inputs: ComplexArray
    outputs: ComplexArray

    @property
    def excited(self) -> np.ndarray:
        """(lines,) whether an input has this line."""
        size = np.abs(self.inputs).max(axis=1)
        return size > _MIN_LINE_RATIO * size.max()

    @property
    def is_sine(self) -> bool:
        """Whether all inputs move at one frequency."""
        power = (np.abs(self.inputs) ** 2).sum(axis=1)
        return bool(power.sum() - power.max() < _SINE_TOLERANCE * power.max())


def period_of(inputs: Matrix) -> int | None:
    """Return how many rows one period of `inputs` (time, q) has; None where fewer than two whole ones are there."""
    rows = inputs.shape[0]
    size = np.abs(inputs).max(initial=0.0)
    if size == 0.0 or np.ptp(inputs, axis=0).max() < 1e-9 * size:
        return None
    # Text keeps 9 digits at least.
    tolerance = 1e-8 * size
    starts = np.flatnonzero(np.abs(inputs - inputs[0]).max(axis=1) <= tolerance)
    for p in starts[(starts >= 2) & (2 * starts <= rows)]:
        if np.abs(inputs[p:] - inputs[:-p]).max() <= tolerance:
            return int(p)
    return None


def periods(inputs: Matrix, outputs: Matrix, period: int, sample_time: float) -> Periods:
    """Return the transforms of a periodic run's whole periods; rows are time."""
    count = inputs.shape[0] // period
    lost = max(1, count // _TRANSIENT_DIVISOR)
    keep = slice(lost * period, count * period)
    lines = np.arange(1, period // 2 + 1)

    def amplitudes(values: Matrix) -> ComplexArray:
        parts = values[keep].reshape(count - lost, period, -1)
        return 2.0 / period * np.fft.fft(parts, axis=1)[:, lines]

    return Periods(2.0 * np.pi * lines / (period * sample_time), amplitudes(inputs).mean(axis=0), amplitudes(outputs))


def robust(runs: Sequence[Periods]) -> Response | None:
    """Return the best linear approximation over realisations; None where the runs are no sets of experiments.

    q runs that follow each other, with independent inputs at each line, are one realisation: `G = Y U^-1`. Its mean
    over periods and realisations is the best linear approximation for this class of input; its scatter over
    realisations is noise and nonlinear distortion, that over periods noise alone (Pintelon and Schoukens 2012, 4.3.1).
    """
    q = runs[0].inputs.shape[1]
    if len(runs) < 2 * q or len(runs) % q or len({run.frequency.size for run in runs}) > 1:
        return None
    lines = np.logical_and.reduce([run.excited for run in runs])
    if not lines.any():
        return None
    each, noises, powers = [], [], []
    for start in range(0, len(runs), q):
        found = _realisation(runs[start : start + q], lines)
        if found is None:
            return None
        each.append(found[0])
        noises.append(found[1])
        powers.append(found[2])
    G = np.array(each)
    M, K, m, _ = G.shape
    e = (G - G.mean(axis=0)).reshape(M, K, m * q)
    covariance = np.einsum("rka,rkb->kab", e, e.conj()) / (M * (M - 1))
    # The scatter of G turned into power of the outputs, beside that of the outputs themselves.
    explained = np.mean([power for power, _ in powers], axis=0)
    scatter = M * np.einsum("kaa->ka", covariance).real.reshape(K, m, q)
    inputs = np.mean([power for _, power in powers], axis=0)
    unexplained = (scatter * inputs[:, None, :]).sum(axis=2)
    return Response(
        frequency=runs[0].frequency[lines],
        response=G.mean(axis=0),
        covariance=covariance,
        freedom=np.full(K, M - 1.0),
        coherence=1.0 - unexplained / np.maximum(unexplained + explained, 1e-300),
        noise=None if noises[0] is None else np.mean(noises, axis=0) / M,
    )


def _realisation(
    runs: Sequence[Periods], lines: np.ndarray
) -> tuple[ComplexArray, Vector | None, tuple[Vector, Vector]] | None:
    """Return G (lines, m, q), its variance by noise, the powers of outputs and inputs; None where U is singular."""
    U = np.stack([run.inputs[lines] for run in runs], axis=2)
    if np.linalg.cond(U).max() > _MAX_CONDITION:
        return None
    count = min(run.outputs.shape[0] for run in runs)
    Y = np.stack([run.outputs[:count, lines] for run in runs], axis=3)
    inverse = np.linalg.inv(U)
    each = Y @ inverse
    noise = None if count < 2 else each.var(axis=0, ddof=1) / count
    G = each.mean(axis=0)
    return G, noise, ((np.abs(G @ U) ** 2).mean(axis=2), (np.abs(U) ** 2).mean(axis=2))
