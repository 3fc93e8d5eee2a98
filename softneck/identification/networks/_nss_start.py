"""The start of a neural state space: the linear output-error model, its states whitened."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording, redefine

from ..linear._oe_fit import OutputErrorFit, default_starts, fit_output_error, pole_radius
from ..models._loaded_drive import LoadedDrive, drive_start
from ._contraction import whitening
from ._nss_problem import Records, Shape, free_run

# Dead times of the sensor to try [samples]; what is longer hides in the poles.
_DELAYS = (0, 1, 2, 3, 4)
# Co-contraction stiffens, and compresses more slowly than the neck bends [1/s].
_COCONTRACTION_RATE = 1.5
# A pole beyond this remembers for longer than a window [s].
_SLOWEST = 5.0
# A slower pole of the linear model is a drift; training starts from one that is not [s].
_SLOWEST_START = 2.0
# What the observer behind windows takes for granted: errors of state and of output, in parts of their spread.
_STATE_NOISE, _OUTPUT_NOISE = 0.05, 0.01


def linear_start(recording: Recording, drive: LoadedDrive, order: int) -> tuple[list[OutputErrorFit], int]:
    """Return the output-error models of both axes from simulated motors, and the dead time of the least cost.

    Raises:
        DataError: no stable model.
    """
    axes: list[list[tuple[Vector, Vector]]] = [[], []]
    for run in recording.runs():
        U = redefine(drive.simulate(run.set_points, drive_start(run)))
        for axis in range(2):
            if np.isfinite(run.outputs[:, axis]).any():
                axes[axis].append((U[:, axis], run.outputs[:, axis]))
    for axis, runs in enumerate(axes):
        middle = np.nanmean(np.concatenate([y for _, y in runs]))
        rest = np.mean(np.concatenate([u for u, _ in runs]))
        axes[axis] = [(np.ascontiguousarray(u - rest), y - middle) for u, y in runs]
    best: tuple[float, int, list[OutputErrorFit]] | None = None
    for delay in _DELAYS:
        fits = [fit_output_error(runs, order, order, delay, _starts(order, recording.sample_time)) for runs in axes]
        found = [fit for fit in fits if fit is not None]
        if len(found) < 2:
            continue
        cost = sum(fit.cost / max(_power(runs), 1e-12) for fit, runs in zip(found, axes, strict=True))
        if best is None or cost < best[0]:
            best = (cost, delay, found)
    if best is None:
        raise DataError("no stable linear model to start from; record with more excitation.")
    return best[2], best[1]


def largest_rate(sample_time: float) -> float:
    """Return by what at least the distance of two states falls in each step: what was is forgotten in seconds."""
    return float(np.exp(-sample_time / _SLOWEST))


def _starts(order: int, sample_time: float) -> list[Vector]:
    return default_starts(order, sample_time, None)


def _power(runs: list[tuple[Vector, Vector]]) -> float:
    return float(sum(np.nansum(y**2) for _, y in runs))


def whitened(fits: list[OutputErrorFit], records: Records, neurons: int) -> tuple[Shape, Vector, Matrix]:
    """Return shape, weights without neurons, and an observer's gain (n, 2), states of unit covariance.

    States are those of both axes and one of co-contraction, which no output shows yet.
    """
    from scipy.linalg import block_diag, solve_discrete_are

    scales = records.scales
    chain = scales.inputs.size // 3
    parts = [_observer_form(fit, np.exp(-records.sample_time / _SLOWEST_START)) for fit in fits]
    slow = np.exp(-_COCONTRACTION_RATE * records.sample_time)
    A = np.asarray(block_diag(*(F for F, _ in parts), slow))
    n = len(A)
    B, C = np.zeros((n, scales.inputs.size)), np.zeros((2, n))
    at = 0
    for axis, (F, g) in enumerate(parts):
        B[at : at + len(F), axis * chain] = g * scales.inputs[axis * chain] / scales.outputs[axis]
        C[axis, at] = 1.0
        at += len(F)
    B[at, 2 * chain] = 1.0 - slow
    shape = Shape(n, scales.inputs.size, neurons)
    w = shape.vector({name: np.zeros(size) for name, size in shape.shapes.items()} | {"A": A, "B": B, "C": C})
    Y, X = free_run(shape, w, records)
    states = X[records.own]
    P = np.cov(states, rowvar=False)
    L = whitening(A, P, 0.9999 * largest_rate(records.sample_time))
    inverse = np.linalg.inv(L)
    arrays = shape.arrays(w) | {"A": inverse @ A @ L, "B": inverse @ B, "C": C @ L}
    arrays["c"] = np.nanmean((records.outputs - Y)[records.settled], axis=0)
    Q, R = _STATE_NOISE**2 * np.eye(n), _OUTPUT_NOISE**2 * np.eye(2)
    P = np.asarray(solve_discrete_are(arrays["A"].T, arrays["C"].T, Q, R))
    gain = P @ arrays["C"].T @ np.linalg.inv(arrays["C"] @ P @ arrays["C"].T + R)
    return shape, shape.vector(arrays), gain


def _observer_form(fit: OutputErrorFit, radius: float) -> tuple[Matrix, Vector]:
    """Return A (n, n) and B (n,) of one axis, its output the first state, its poles drawn within `radius`."""
    drawn = min(1.0, radius / max(pole_radius(fit.f), 1e-9))
    F = np.eye(fit.f.size, k=1)
    F[:, 0] = -fit.f * drawn ** np.arange(1, fit.f.size + 1)
    return F, fit.b
