"""The robust method: a response from periodic multisines, noise and nonlinear distortion told apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector

from ._spectra import ComplexArray, Response

# Lines that carry less than this part of the strongest line's amplitude are not excited: rounding of a text file.
_LINE = 1e-4
# Experiments whose inputs are nearer to dependence than this are no set of orthogonal ones.
_CONDITION = 1e3
# The first third of the periods, one at least, holds the transient.
_LOST = 3
# A sine: all of the rest of its power is below this part.
_PURE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Periods:
    """A run of equal periods, transformed, without those in which it settles.

    Attributes:
        frequency: (lines,) [rad/s], above zero and up to the Nyquist frequency.
        inputs: (lines, q) amplitudes.
        outputs: (periods, lines, m) amplitudes.
    """

    frequency: Vector
    inputs: ComplexArray
    outputs: ComplexArray

    @property
    def excited(self) -> np.ndarray:
        """(lines,) whether an input has this line."""
        size = np.abs(self.inputs).max(axis=1)
        return size > _LINE * size.max()

    @property
    def is_sine(self) -> bool:
        """Whether all inputs move at one frequency."""
        power = (np.abs(self.inputs) ** 2).sum(axis=1)
        return bool(power.sum() - power.max() < _PURE * power.max())


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
    """Return a periodic run's transforms; rows are time, what follows the last whole period is left out."""
    count = inputs.shape[0] // period
    lost = max(1, count // _LOST)
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
    if np.linalg.cond(U).max() > _CONDITION:
        return None
    count = min(run.outputs.shape[0] for run in runs)
    Y = np.stack([run.outputs[:count, lines] for run in runs], axis=3)
    inverse = np.linalg.inv(U)
    each = Y @ inverse
    noise = None if count < 2 else each.var(axis=0, ddof=1) / count
    G = each.mean(axis=0)
    return G, noise, ((np.abs(G @ U) ** 2).mean(axis=2), (np.abs(U) ** 2).mean(axis=2))
