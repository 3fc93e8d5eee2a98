"""What the inputs tell: spectrum against the bandwidth, condition of Eq. 21's regressor, correlation, repeats."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from softneck.core import Matrix, Vector

from ..recording._channels import MOTORS
from ..recording._recording import Recording
from ..recording._redefinition import redefine

# The paper's section 3.1: the system's bandwidth [rad/s].
BANDWIDTH = 4.0
INPUTS = ("theta_i", "phi_i", "delta_i")
# 41 s at 20 ms: lines 0.15 rad/s apart, and several segments to average over in an identification recording.
_SEGMENT = 2048
# -20 dB: where a spectral density is below 1 % of its mean up to the bandwidth, a tenth of the amplitude is left.
_REAL_POWER = 0.01
# Two runs repeat each other if their set-points differ by no more than a drive's quantum.
_SAME_SET_POINT = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Power spectral density of theta_i, phi_i and delta_i (Welch, Hann window, half overlapping, never across runs).

    Attributes:
        omega: (frequencies,) [rad/s].
        density: (frequencies, 3) [rad^2 s/rad].
        below_bandwidth: (3,) share of the power below 4 rad/s.
        highest: (3,) highest frequency whose density is at least 1 % of the mean up to 4 rad/s [rad/s].
        crest: (3,) largest deviation from the mean by standard deviation.
    """

    omega: Vector
    density: Matrix
    below_bandwidth: Vector
    highest: Vector
    crest: Vector

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds: the numbers of each input, not the curve."""
        return {
            name: {
                "share_below_bandwidth": self.below_bandwidth[i],
                "highest_frequency_rad_s": self.highest[i],
                "crest_factor": self.crest[i],
            }
            for i, name in enumerate(INPUTS)
        }


@dataclass(frozen=True, slots=True)
class Conditioning:
    """Condition of one axis's regressor matrix (Eq. 21) with every column at mean 0 and standard deviation 1.

    Attributes:
        axis: pitch or roll.
        rows: regressors without a missed sample.
        columns: names of the regressor's columns.
        number: largest by smallest singular value; infinite where a column is constant or depends on others.
        weakest: the columns that the least excited direction is made of.
    """

    axis: str
    rows: int
    columns: tuple[str, ...]
    number: float
    weakest: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds; an infinite number becomes null there."""
        return {"number": self.number, "rows": self.rows, "columns": self.columns, "weakest": self.weakest}


@dataclass(frozen=True, slots=True)
class Repeat:
    """Two runs with the same set-points, and by how much their outputs differ.

    Attributes:
        runs: numbers of the two, from 0.
        rows: that both have.
        rms: of pitch's and roll's difference by sqrt(2) [rad]: what no model can predict.
    """

    runs: tuple[int, int]
    rows: int
    rms: tuple[float, float]

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds."""
        pitch, roll = np.degrees(self.rms)
        return {"runs": self.runs, "rows": self.rows, "rms_deg": {"pitch": pitch, "roll": roll}}


def spectrum(recording: Recording) -> Spectrum:
    """Return the spectrum of the redefined set-points, averaged over runs by their rows."""
    runs = [redefine(run.set_points) for run in recording.runs()]
    size = min(_SEGMENT, max(len(u) for u in runs))
    density, rows = np.zeros((size // 2 + 1, 3)), 0
    f = np.fft.rfftfreq(size, recording.sample_time)
    for u in runs:
        if len(u) >= 8:
            # Runs shorter than a segment are padded with zeros, so that all have the same frequencies.
            length = min(size, len(u))
            density += len(u) * welch(u, recording.sample_time, length, size)
            rows += len(u)
    omega = 2.0 * np.pi * f
    density /= 2.0 * np.pi * max(rows, 1)
    pooled = np.concatenate(runs)
    return Spectrum(omega, density, *_shares(omega, density), _crest(pooled))


def welch(u: Matrix, sample_time: float, length: int, size: int) -> Matrix:
    """Return the one-sided power spectral density (size // 2 + 1, columns) per Hz by Welch's method (1967).

    As `scipy.signal.welch` with its defaults, whose import takes ten times as long as all else here.

    Args:
        u: (time, columns), at least `length` rows.
        sample_time: [s].
        length: of a segment; each overlaps the next by half and is weighted by Hann's window.
        size: of the Fourier transform, which pads each segment with zeros.
    """
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    segments = sliding_window_view(u, length, axis=0)[:: length - length // 2]
    centred = segments - segments.mean(axis=-1, keepdims=True)
    power = np.abs(np.fft.rfft(centred * window, n=size, axis=-1)) ** 2
    density = power.mean(axis=0).T * (sample_time / (window @ window))
    # What stands at negative frequencies, too; zero and half the sample rate have no such twin.
    density[1 : (size + 1) // 2] *= 2.0
    return density


def _shares(omega: Vector, density: Matrix) -> tuple[Vector, Vector]:
    """Return the share of power below the bandwidth and the highest frequency with real power, both (3,)."""
    low = omega <= BANDWIDTH
    total = density.sum(axis=0)
    # Below, an input is constant and its density what rounding leaves.
    alive = total > 1e-18
    share = np.divide(density[low].sum(axis=0), total, out=np.full(3, np.nan), where=alive)
    real = density >= _REAL_POWER * density[low].mean(axis=0)
    highest = np.array([omega[np.flatnonzero(real[:, i])[-1]] if alive[i] else 0.0 for i in range(3)])
    return share, highest


def _crest(inputs: Matrix) -> Vector:
    deviation = inputs - inputs.mean(axis=0)
    std = deviation.std(axis=0)
    return np.divide(np.abs(deviation).max(axis=0), std, out=np.full(3, np.nan), where=std > 1e-9)


def conditioning(recording: Recording, axis: str) -> Conditioning:
    """Return the condition of Eq. 21's regressor for `axis`, row by row within each run.

    The columns are y(k-1), u_j(k-2), u_j(k-3) and M_j(k-3); without logged positions the last three would repeat
    the set-points and are left out.
    """
    names = ["y(k-1)", *(f"u{j}(k-{lag})" for j in MOTORS for lag in (2, 3))]
    if recording.has_motor_positions:
        names += [f"M{j}(k-3)" for j in MOTORS]
    parts = [_regressors(run, axis) for run in recording.runs() if len(run) > 3]
    X = np.concatenate(parts) if parts else np.zeros((0, len(names)))
    X = X[np.isfinite(X).all(axis=1)]
    if len(X) < len(names):
        return Conditioning(axis, len(X), tuple(names), float("inf"), ())
    scale = X.std(axis=0)
    still = scale <= 1e-9 * np.maximum(1.0, np.abs(X).max(axis=0))
    if still.any():
        return Conditioning(axis, len(X), tuple(names), float("inf"), _named(names, still))
    _, singular, Vt = np.linalg.svd((X - X.mean(axis=0)) / scale, full_matrices=False)
    number = float("inf") if singular[-1] <= 1e-12 * singular[0] else float(singular[0] / singular[-1])
    return Conditioning(axis, len(X), tuple(names), number, _named(names, np.abs(Vt[-1]) > 0.3))


def _regressors(run: Recording, axis: str) -> Matrix:
    """Return the rows k = 3 .. end of Eq. 21."""
    y, u = run.channels[axis], run.set_points
    columns = [y[2:-1], *(u[3 - lag : len(u) - lag, j] for j in range(3) for lag in (2, 3))]
    if run.has_motor_positions:
        columns += list(run.motor_positions[:-3].T)
    return np.column_stack(columns)


def _named(names: list[str], chosen: np.ndarray) -> tuple[str, ...]:
    return tuple(name for name, take in zip(names, chosen, strict=True) if take)


def correlation(recording: Recording) -> Matrix:
    """Return the correlation of the three set-points, (3, 3); NaN with a motor that never moves."""
    u = recording.set_points - recording.set_points.mean(axis=0)
    std = u.std(axis=0)
    still = std <= 1e-9
    z = np.divide(u, std, out=np.full_like(u, np.nan), where=~still)
    return np.clip(z.T @ z / len(z), -1.0, 1.0)


def repeats(recording: Recording) -> tuple[Repeat, ...]:
    """Return the pairs of runs with the same set-points over at least 1 s and nine tenths of the longer one."""
    runs = recording.runs()
    # With more runs than this the pairs would take long, and nobody reads them.
    pairs = itertools.combinations(range(min(len(runs), 100)), 2)
    found = (_repeat(runs[a], runs[b], (a, b)) for a, b in pairs)
    return tuple(repeat for repeat in found if repeat is not None)


def _repeat(first: Recording, second: Recording, numbers: tuple[int, int]) -> Repeat | None:
    rows = min(len(first), len(second))
    if rows * first.sample_time < 1.0 or rows < 0.9 * max(len(first), len(second)):
        return None
    if np.abs(first.set_points[:rows] - second.set_points[:rows]).max() > _SAME_SET_POINT:
        return None
    difference = first.outputs[:rows] - second.outputs[:rows]
    square = [np.mean(d[np.isfinite(d)] ** 2) if np.isfinite(d).any() else np.nan for d in difference.T]
    pitch, roll = np.sqrt(np.array(square) / 2.0)
    return Repeat(numbers, rows, (float(pitch), float(roll)))
