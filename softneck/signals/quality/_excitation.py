"""What the inputs tell: spectrum against the bandwidth, and correlation.

Inputs are a neck's theta_i, phi_i and delta_i, and the set-points of another robot's motors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

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


def spectrum(recording: Recording, bandwidth: float) -> Spectrum:
    """Return the spectrum of the inputs, averaged over runs by their rows."""
    from scipy.signal import welch

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
            density += len(u) * welch(u, 1.0 / recording.sample_time, nperseg=length, nfft=size, axis=0)[1]
            rows += len(u)
    omega = 2.0 * np.pi * f
    density /= 2.0 * np.pi * max(rows, 1)
    pooled = np.concatenate(runs)
    names = INPUTS if neck else recording.robot.set_points
    ranges = np.column_stack([pooled.min(axis=0), pooled.max(axis=0)])
    return Spectrum(names, bandwidth, omega, density, *_shares(omega, density, bandwidth), _crest(pooled), ranges)


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


def correlation(recording: Recording) -> Matrix:
    """Return the correlation of the set-points, (motors, motors); NaN with a motor that never moves."""
    u = recording.set_points - recording.set_points.mean(axis=0)
    std = u.std(axis=0)
    still = std <= 1e-9
    z = np.divide(u, std, out=np.full_like(u, np.nan), where=~still)
    return np.clip(z.T @ z / len(z), -1.0, 1.0)
