"""What the inputs tell: spectrum against the bandwidth, condition of Eq. 21's regressor, correlation.

Inputs are a neck's theta_i, phi_i and delta_i, and the set-points of another robot's motors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from softneck.core import Matrix, Vector

from ..recording._recording import Recording
from ..recording._redefinition import redefine

# The paper's section 3.1: the system's bandwidth [rad/s].
BANDWIDTH = 4.0
INPUTS = ("theta_i", "phi_i", "delta_i")
# 41 s at 20 ms: lines 0.15 rad/s apart, and several segments to average over in an identification recording.
_SEGMENT = 2048
_NECK_STEP = 0.02 * BANDWIDTH
# -20 dB: where a spectral density is below 1 % of its mean up to the bandwidth, a tenth of the amplitude is left.
_REAL_POWER = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Power spectral density of the inputs (Welch, Hann window, half overlapping, never across runs).

    Attributes:
        inputs: their names, (n,).
        bandwidth: up to where the outputs follow [rad/s]; NaN where nothing is known of it.
        omega: (frequencies,) [rad/s].
        density: (frequencies, n) [rad^2 s/rad, or by the unit of the motors].
        below_bandwidth: (n,) share of the power below the bandwidth.
        highest: (n,) highest frequency whose density is at least 1 % of the mean up to the bandwidth [rad/s].
        crest: (n,) largest deviation from the mean by standard deviation.
        ranges: (n, 2) lowest and highest value [SI].
    """

    inputs: tuple[str, ...]
    bandwidth: float
    omega: Vector
    density: Matrix
    below_bandwidth: Vector
    highest: Vector
    crest: Vector
    ranges: Matrix

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds: the numbers of each input, not the curve."""
        return {
            name: {
                "share_below_bandwidth": self.below_bandwidth[i],
                "highest_frequency_rad_s": self.highest[i],
                "crest_factor": self.crest[i],
            }
            for i, name in enumerate(self.inputs)
        }


@dataclass(frozen=True, slots=True)
class Conditioning:
    """Condition of one axis's regressor matrix (Eq. 21) with every column at mean 0 and standard deviation 1.

    Attributes:
        axis: name of the output.
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


def spectrum(recording: Recording, bandwidth: float) -> Spectrum:
    """Return the spectrum of the inputs, averaged over runs by their rows."""
    neck = recording.robot.is_neck
    runs = [redefine(run.set_points) if neck else run.set_points for run in recording.runs()]
    segment = _SEGMENT
    if not neck and not np.isnan(bandwidth):
        # As many lines up to the bandwidth as a neck has.
        segment = max(16, round(_SEGMENT * _NECK_STEP / (bandwidth * recording.sample_time)))
    size = min(segment, max(len(u) for u in runs))
    density, rows = np.zeros((size // 2 + 1, runs[0].shape[1])), 0
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
    names = INPUTS if neck else recording.robot.set_points
    ranges = np.column_stack([pooled.min(axis=0), pooled.max(axis=0)])
    return Spectrum(names, bandwidth, omega, density, *_shares(omega, density, bandwidth), _crest(pooled), ranges)


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


def _shares(omega: Vector, density: Matrix, bandwidth: float) -> tuple[Vector, Vector]:
    """Return the share of power below the bandwidth and the highest frequency with real power, both (n,)."""
    inputs = density.shape[1]
    if np.isnan(bandwidth):
        return np.full(inputs, np.nan), np.full(inputs, np.nan)
    low = omega <= bandwidth
    total = density.sum(axis=0)
    # Below, an input is constant and its density what rounding leaves.
    alive = total > 1e-18
    share = np.divide(density[low].sum(axis=0), total, out=np.full(inputs, np.nan), where=alive)
    real = density >= _REAL_POWER * density[low].mean(axis=0)
    highest = np.array([omega[np.flatnonzero(real[:, i])[-1]] if alive[i] else 0.0 for i in range(inputs)])
    return share, highest


def _crest(inputs: Matrix) -> Vector:
    deviation = inputs - inputs.mean(axis=0)
    std = deviation.std(axis=0)
    return np.divide(np.abs(deviation).max(axis=0), std, out=np.full_like(std, np.nan), where=std > 1e-9)


def conditioning(recording: Recording, axis: str) -> Conditioning:
    """Return the condition of Eq. 21's regressor for `axis`, row by row within each run.

    The columns are y(k-1), u_j(k-2), u_j(k-3) and M_j(k-3); without logged positions the last ones would repeat
    the set-points and are left out.
    """
    motors = range(1, len(recording.robot.motors.names) + 1)
    names = ["y(k-1)", *(f"u{j}(k-{lag})" for j in motors for lag in (2, 3))]
    if recording.has_motor_positions:
        names += [f"M{j}(k-3)" for j in motors]
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
    columns = [y[2:-1], *(u[3 - lag : len(u) - lag, j] for j in range(u.shape[1]) for lag in (2, 3))]
    if run.has_motor_positions:
        columns += list(run.motor_positions[:-3].T)
    return np.column_stack(columns)


def _named(names: list[str], chosen: np.ndarray) -> tuple[str, ...]:
    return tuple(name for name, take in zip(names, chosen, strict=True) if take)


def correlation(recording: Recording) -> Matrix:
    """Return the correlation of the set-points, (motors, motors); NaN with a motor that never moves."""
    u = recording.set_points - recording.set_points.mean(axis=0)
    std = u.std(axis=0)
    still = std <= 1e-9
    z = np.divide(u, std, out=np.full_like(u, np.nan), where=~still)
    return np.clip(z.T @ z / len(z), -1.0, 1.0)
