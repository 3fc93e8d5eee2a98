"""The unscented filter over recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording

from ._offline import Estimates, measured_angles

if TYPE_CHECKING:
    from ._ukf import UkfObserver


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """What one step made: numbers of the next state, outputs, and the entries of `Estimates`."""

    values: Vector
    outputs: Vector
    judged: bool
    accepted: bool
    log_det: float
    aligned: Vector
    covariance: Matrix


def estimate_recording(observer: UkfObserver, recording: Recording) -> Estimates:
    """Return what the filter makes of each run."""
    if not math.isclose(recording.sample_time, observer.sample_time, rel_tol=1e-6):
        raise DataError(
            f"the recording has sample time {recording.sample_time:g} s, the model {observer.sample_time:g} s; "
            "resample it or identify the model at its sample time."
        )
    rows = [row for run in recording.runs() for row in _run(observer, run)]
    outputs = np.array([row.outputs for row in rows])
    return Estimates(
        time=recording.time,
        pitch=outputs[:, 0].copy(),
        roll=outputs[:, 1].copy(),
        pitch_rate=outputs[:, 2].copy(),
        roll_rate=outputs[:, 3].copy(),
        innovation=outputs[:, 4].copy(),
        accepted=np.array([row.accepted for row in rows]),
        healthy=outputs[:, 5] > 0.5,
        judged=np.array([row.judged for row in rows]),
        aligned=np.array([row.aligned for row in rows]),
        covariance=np.array([row.covariance for row in rows]),
        log_det=np.array([row.log_det for row in rows]),
    )


def _run(observer: UkfObserver, run: Recording) -> list[Row]:
    z = measured_angles(run)
    # The set-points of t_k are commanded after the measurement of t_k: the filter knows those before. In a Jacobi loop
    # the observer sees them a sample younger.
    late = 0 if observer.settings.order == "jacobi" else 1
    setpoints = run.set_points[np.maximum(np.arange(len(run)) - late, 0)]
    values, rows = observer.initial_state().values, []
    for u, y in zip(setpoints, z, strict=True):
        rows.append(observer.advance(values, np.concatenate([u, y, [1.0]])))
        values = rows[-1].values
    return rows
