"""Excitation of the inputs: spectrum against the bandwidth, correlation, and explained variance.

Inputs are the redefined ones and co-contraction if the robot gives its directions, else the motors' set-points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot, Scaling

from ..recording._recording import Recording
from ._followed import Mode, driven_mode

# [rad/s] Bandwidth of the neck (paper, section 3.1).
BANDWIDTH = 4.0
# 41 s at 20 ms: lines 0.15 rad/s apart, and several Welch segments in an identification recording.
_WELCH_ROWS = 2048
_NECK_STEP = 0.02 * BANDWIDTH
# -20 dB: 1 % of the mean density up to the bandwidth, a tenth of the amplitude.
_REAL_POWER = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Power spectral density of the inputs (Welch, Hann window, half overlapping, never across runs).

    Attributes:
        inputs: their names, (n,).
        bandwidth: of the outputs [rad/s]; NaN if unknown.
        omega: (frequencies,) [rad/s].
        density: (frequencies, n) [rad^2 s/rad, or by the unit of the motors].
        below_bandwidth: (n,) share of the power below the bandwidth.
        highest: (n,) highest frequency with at least 1 % of the mean density up to the bandwidth [rad/s].
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
        """Return the JSON values: the numbers of each input, without the curve."""
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

    names, T = _inputs(recording.robot)
    runs = [run.set_points @ T.T for run in recording.runs()]
    segment = _WELCH_ROWS
    if not np.isnan(bandwidth):
        # As many lines up to the bandwidth as for a neck.
        segment = max(16, round(_WELCH_ROWS * _NECK_STEP / (bandwidth * recording.sample_time)))
    size = min(segment, max(len(u) for u in runs))
    density, rows = np.zeros((size // 2 + 1, runs[0].shape[1])), 0
    f = np.fft.rfftfreq(size, recording.sample_time)
    for u in runs:
        if len(u) >= 8:
            # Runs shorter than a segment are padded with zeros, so that all share the same frequencies.
            length = min(size, len(u))
            density += len(u) * welch(u, 1.0 / recording.sample_time, nperseg=length, nfft=size, axis=0)[1]
            rows += len(u)
    omega = 2.0 * np.pi * f
    density /= 2.0 * np.pi * max(rows, 1)
    pooled = np.concatenate(runs)
    ranges = np.column_stack([pooled.min(axis=0), pooled.max(axis=0)])
    least = _least_motion(recording)
    shares = _shares(omega, density, bandwidth, least)
    return Spectrum(names, bandwidth, omega, density, *shares, _crest(pooled, least), ranges)


def _least_motion(recording: Recording) -> float:
    """Return the standard deviation of set-points [SI] below which motion is rounding."""
    return 1e-9 * Scaling.of(recording.robot, set_points=recording.set_points).motor_unit


def _inputs(robot: Robot) -> tuple[tuple[str, ...], Matrix]:
    """Return the names of the inputs and T (inputs, motors)."""
    if robot.weights() is None:
        return robot.set_points, np.eye(len(robot.set_points))
    T = robot.redefinition()[0]
    names = (*robot.input_names, robot.cocontraction_name)
    return (names, T) if T[-1].any() else (names[:-1], T[:-1])


def _shares(omega: Vector, density: Matrix, bandwidth: float, least: float) -> tuple[Vector, Vector]:
    """Return the share of power below the bandwidth and the highest excited frequency, both (n,)."""
    inputs = density.shape[1]
    if np.isnan(bandwidth):
        return np.full(inputs, np.nan), np.full(inputs, np.nan)
    low = omega <= bandwidth
    total = density.sum(axis=0)
    # Below this power an input is constant and its density is rounding.
    alive = total * bandwidth > BANDWIDTH * least**2
    share = np.divide(density[low].sum(axis=0), total, out=np.full(inputs, np.nan), where=alive)
    real = density >= _REAL_POWER * density[low].mean(axis=0)
    highest = np.array([omega[np.flatnonzero(real[:, i])[-1]] if alive[i] else 0.0 for i in range(inputs)])
    return share, highest


def _crest(inputs: Matrix, least: float) -> Vector:
    deviation = inputs - inputs.mean(axis=0)
    std = deviation.std(axis=0)
    return np.divide(np.abs(deviation).max(axis=0), std, out=np.full_like(std, np.nan), where=std > least)


def correlation(recording: Recording) -> Matrix:
    """Return the correlation of the set-points, (motors, motors); NaN for a motor that never moves."""
    u = recording.set_points - recording.set_points.mean(axis=0)
    std = u.std(axis=0)
    still = std <= _least_motion(recording)
    z = np.divide(u, std, out=np.full_like(u, np.nan), where=~still)
    return np.clip(z.T @ z / len(z), -1.0, 1.0)


# 10 s at 20 ms: fifty time constants of a neck, less than one slow wave of Eq. 22.
_FEW_ROWS = 500
# With fewer changes the set-points are a few steps, without excitation between them.
_FEW_CHANGES = 20
# Motions [standard deviations] below this share of the largest come from drives and sensors.
_NO_MOTION = 0.02
# Smallest R2 of an output by its motors; below it the output depends on something else.
_MIN_EXPLAINED_SHARE = 0.2
# Below this share a mode is searched; above it the lags of a regression last as long as the motion.
_MAX_EXPLAINED_SHARE = 0.7
# Smallest R2 of a mode on rows not fitted: 0.16 is the largest of 48 outputs of noise, drift and modes of their own.
_MIN_MODE_SHARE = 0.3
# Below this damping a step overshoots by half and rings visibly.
_LIGHT_DAMPING = 0.2
_BLOCK_COUNT = 10
# Singular values below this share of the largest are cut in a fit. A motion that is small in the fitted blocks and
# larger in the judged ones would be extrapolated by thousands of times. Several cuts are tried.
_SINGULAR_CUTS = (1e-6, 1e-4, 1e-2)
# Held-out outputs that move by a smaller share of their whole motion [standard deviations] cannot judge a model: the
# error of a good one, a twentieth of the motion in training, would read as a fit of 0 %.
_MIN_RELATIVE_MOTION = 0.05
# Lags [samples] of an output behind its motors: an octave apart, up to 5 s at 20 ms.
_LAGS = (0, *(2**k for k in range(9)))


def poor_excitation(recording: Recording) -> tuple[str, ...]:
    """Return the weaknesses of a recording as training data, as sentences."""
    problems = []
    if len(recording) < _FEW_ROWS:
        seconds = len(recording) * recording.sample_time
        problems.append(f"{len(recording)} rows ({seconds:.3g} s) are few to train on: record {_FEW_ROWS} or more.")
    spans, least = np.ptp(recording.set_points, axis=0), _least_motion(recording)
    still = [name for name, span in zip(recording.robot.set_points, spans, strict=True) if span < least]
    if still:
        problems.append(f"{', '.join(still)} never moves: its effect cannot be learned. Move every motor.")
    changes = _changes(recording)
    if spans.max() >= least and changes < _FEW_CHANGES:
        problems.append(
            f"the set-points change in {changes} rows only: a model between them is a guess. Record more levels."
        )
    outputs = recording.robot.outputs.names
    if independent_motions(recording) < min(len(outputs), len(spans)):
        problems.append(
            f"the motors move along {independent_motions(recording)} direction(s) for {len(outputs)} outputs: their "
            "separate effects cannot be learned. Move all of them independently, as `eq22` and `mixed` do."
        )
    followed = _followed(recording)
    problems += [
        f"`{name}` is lightly damped: the motors make it {mode}. Take a kind with two poles or more, such as `oe`."
        for name, _, mode in followed
        if mode is not None and mode.damping < _LIGHT_DAMPING
    ]
    problems += [
        f"`{name}` does not follow the motors (they explain {100.0 * max(share, 0.0):.0f} % of its variance): no model "
        "of set-points will predict it. Look for drift, a wrong column, or an output that nothing moves."
        for name, share, mode in followed
        if share < _MIN_EXPLAINED_SHARE and mode is None
    ]
    return tuple(problems)


def lightly_damped(recording: Recording) -> dict[str, Mode]:
    """Return the lightly damped mode of each output that the motors excite, by its name."""
    followed = _followed(recording)
    return {name: mode for name, _, mode in followed if mode is not None and mode.damping < _LIGHT_DAMPING}


def _changes(recording: Recording) -> int:
    """Count the rows in which a set-point changes."""
    return sum(int((np.diff(run.set_points, axis=0) != 0.0).any(axis=1).sum()) for run in recording.runs())


def _followed(recording: Recording) -> list[tuple[str, float, Mode | None]]:
    """Return name, explained variance and the mode that explains more of each output; nothing of a short recording."""
    if len(recording) < _FEW_ROWS or _changes(recording) < _FEW_CHANGES:
        return []
    found = []
    for output, share in enumerate(explained_variance(recording)):
        # What rings for longer than the lags shows in a mode with free frequency and damping only.
        mode = driven_mode(recording, output) if share < _MAX_EXPLAINED_SHARE else None
        if mode is not None and not mode.share >= max(_MIN_MODE_SHARE, share):
            mode = None
        found.append((recording.robot.outputs.names[output], float(share), mode))
    return found


def why_at_rest(held_out: Recording, whole: Recording) -> str | None:
    """Return why `held_out`, a part of `whole`, cannot judge a model; None if it can."""
    for name, judged, full in zip(whole.robot.outputs.names, held_out.outputs.T, whole.outputs.T, strict=True):
        there = np.isfinite(judged)
        if there.any() and np.nanstd(judged) < _MIN_RELATIVE_MOTION * np.nanstd(full):
            part = 100.0 * float(np.nanstd(judged) / np.nanstd(full))
            return f"the rows held out stand still: {name} moves by {part:.1f} % of what it does in all rows"
    return None


def independent_motions(recording: Recording) -> int:
    """Count the directions of the set-points whose motion is over 2 % of the largest motion."""
    U = recording.set_points
    sizes = np.linalg.svd(U - U.mean(axis=0), compute_uv=False)
    return int((sizes > _NO_MOTION * sizes[0]).sum()) if sizes[0] > 0.0 else 0


def explained_variance(recording: Recording) -> Vector:
    """Return the share of each output's variance that lagged set-points explain on rows not fitted, (outputs,).

    Least squares is fitted on every other of ten blocks and judged on the rest, and the other way round. A drift fits
    by chance where it is trained, and nowhere else. NaN for an output that was hardly measured or never moves.
    """
    X = np.concatenate([_lag_set_points(run.set_points) for run in recording.runs()])
    odd = np.arange(len(X)) * _BLOCK_COUNT // len(X) % 2 == 1
    found = []
    for y in recording.outputs.T:
        parts = [(X[rows] - X[rows].mean(axis=0), y[rows] - y[rows].mean()) for rows in _halves(odd, np.isfinite(y))]
        spread = sum(float(y @ y) for _, y in parts)
        if spread <= 1e-18 * float(np.nansum(y**2)) or min(len(y) for _, y in parts) < 2 * X.shape[1]:
            found.append(np.nan)
            continue
        found.append(1.0 - min(_cross_validated_error(parts, cut) for cut in _SINGULAR_CUTS) / spread)
    return np.array(found)


def _cross_validated_error(parts: list[tuple[Matrix, Vector]], cut: float) -> float:
    """Return the sum of squared errors of each half by the fit of the other."""
    fits = [np.linalg.lstsq(A, b, rcond=cut)[0] for A, b in parts]
    return sum(float(((b - A @ fit) ** 2).sum()) for (A, b), fit in zip(parts, fits[::-1], strict=True))


def _halves(odd: np.ndarray, there: np.ndarray) -> list[np.ndarray]:
    """Return the rows present in even and in odd blocks; one row if there is none."""
    return [np.flatnonzero(part & there) if (part & there).any() else np.zeros(1, dtype=int) for part in (odd, ~odd)]


def _lag_set_points(U: Matrix) -> Matrix:
    """Return set-points at all lags (time, lags * motors), continued by the first sample."""
    return np.column_stack(
        [np.vstack([np.repeat(U[:1], min(lag, len(U)), axis=0), U[: max(len(U) - lag, 0)]]) for lag in _LAGS]
    )
