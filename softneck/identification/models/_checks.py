"""What every estimator asks of its data before it starts."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError
from softneck.signals import Recording

# Less than 2 s at 20 ms says nothing about a neck with a time constant of 0.2 s.
MIN_ROWS = 100


def check_training(recording: Recording) -> None:
    """Raise DataError for a record too short, without excitation, or with an output that never moves."""
    if len(recording) < MIN_ROWS:
        raise DataError(
            f"{len(recording)} rows are too few to identify from; at least {MIN_ROWS} are needed. Record longer."
        )
    span = np.ptp(recording.set_points, axis=0)
    if span.max() < 1e-6:
        raise DataError(
            "the motor set-points are constant; nothing can be identified. Record with an excitation such as `eq22`."
        )
    outputs = recording.outputs
    for axis, name in enumerate(recording.robot.outputs.names):
        values = outputs[np.isfinite(outputs[:, axis]), axis]
        if values.size < MIN_ROWS:
            raise DataError(f"`{name}` has only {values.size} samples that were not missed; {MIN_ROWS} are needed.")
        if np.ptp(values) < 1e-9:
            raise DataError(f"`{name}` is constant; is its sensor connected?")
