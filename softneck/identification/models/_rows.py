"""Rows known by hash: a model remembers what it was trained on, so that validation can leave it out."""

from __future__ import annotations

import numpy as np

from softneck.signals import Recording

# A row is told apart by itself and those before it: at rest, logged rows repeat to the last digit.
_CONTEXT = 5
# Files round angles to degrees and back; nine digits of a radian survive that.
_DIGITS = 9


def row_hashes(recording: Recording) -> np.ndarray:
    """Return one uint64 per row (time,): of its set-points and outputs and those of the 4 rows before it."""
    parts = [_run_hashes(run) for run in recording.runs()]
    return np.concatenate(parts)


def known_rows(recording: Recording, hashes: np.ndarray) -> np.ndarray:
    """Return a mask (time,) of the rows whose hash is in `hashes`."""
    return np.isin(row_hashes(recording), hashes)


def _run_hashes(run: Recording) -> np.ndarray:
    values = np.round(np.column_stack([run.set_points, run.outputs]), _DIGITS) + 0.0  # no -0.0
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.uint64)
    single = np.zeros(len(run), dtype=np.uint64)
    for column in range(bits.shape[1]):
        single = _mix(single ^ bits[:, column])
    combined = np.zeros_like(single)
    for back in range(min(_CONTEXT, len(run))):
        shifted = np.zeros_like(single)
        shifted[back:] = single[: single.size - back]
        combined = _mix(combined ^ shifted)
    return combined


def _mix(x: np.ndarray) -> np.ndarray:
    """Finaliser of splitmix64 (Steele, Lea and Flood 2014); integer overflow is meant."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
