"""The local polynomial method: a frequency response with its covariance from any excitation, loops included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Vector

from ._spectra import ComplexArray, Response

# Degree of the polynomials of response and transient over a window of frequencies (Pintelon and Schoukens 2012, 7.2).
_DEGREE = 2
# Equations beyond the unknowns in each window: what is left over tells the noise, and so few tell it within 30 %.
_SPARE = 10
# Windows of the least number of bins, and of so many times more; none reaches further than this part of the frequency.
_WIDENINGS = (1, 3, 9, 27)
_WIDEST = 0.5
# Inputs, and ways to combine them, excited by less than this part of what is usual are not excited: rounding.
_EXCITED = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """One run, transformed.

    Attributes:
        frequency: (bins,) [rad/s], of both signs, without zero.
        driven: (bins, q) what the experimenter chose: the inputs, or the references of a closed loop.
        answered: (bins, m + p) outputs, and in a closed loop the inputs behind them.
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
    """Return the fit around w with the least variance over windows of growing width.

    A window too wide for its polynomials leaves over more, which the variance shows as well.
    """
    count = (_DEGREE + 1) * (q + len(runs)) + _SPARE
    best = None
    for widening in _WIDENINGS:
        near = _nearest(runs, w, widening * count)
        reach = max(
            float(np.abs(run.frequency[rows] - w).max(initial=0.0)) for run, rows in zip(runs, near, strict=True)
        )
        if widening > 1 and reach > _WIDEST * w:
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
        powers = ((run.frequency[rows] - w) / reach)[:, None] ** np.arange(_DEGREE + 1)
        # Columns: G of every input, then its slope and its bend; the transient of each run by itself.
        response = (powers[:, :, None] * run.driven[rows][:, None, :]).reshape(rows.size, -1)
        transient = np.zeros((rows.size, len(runs), _DEGREE + 1), dtype=complex)
        transient[:, number] = powers
        blocks.append(np.hstack([response, transient.reshape(rows.size, -1)]))
        Z.append(run.answered[rows])
    A, Y = np.vstack(blocks), np.vstack(Z)
    freedom = A.shape[0] - A.shape[1]
    scale = np.linalg.norm(A, axis=0)
    usual = max(float(np.sqrt((np.abs(run.driven) ** 2).mean())) for run in runs)
    if freedom < 1 or scale[:q].min() < _EXCITED * usual * np.sqrt(A.shape[0]):
        return None
    left, s, right = np.linalg.svd(A / scale, full_matrices=False)
    if s[-1] < _EXCITED * s[0]:
        return None
    inverse = (right.conj().T / s) @ left.conj().T / scale[:, None]
    theta = inverse @ Y
    e = Y - A @ theta
    # What the inputs explain beside the transients.
    bare = A[:, (_DEGREE + 1) * q :]
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
