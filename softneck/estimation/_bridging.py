"""How well a filter bridges what its sensor misses: a check on rows that its noise levels were not fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softneck.core import DataError
from softneck.signals import Recording

from ._kalman import KalmanObserver

# Five samples of every 25 are withheld: 0.1 s of 0.5 s at 20 ms, after which the filter may be off by what it knows.
_PERIOD, _GAP = 25, 5
# Rows at the start of each run in which the filter is still uncertain of everything.
_SETTLE = 50


def bridging_error(observer: KalmanObserver, recording: Recording) -> float:
    """Return the RMS [rad] between angles measured in gaps of five samples and what the filter says without them.

    Likelihood rewards levels that trust any measurement where the model is wrong; a gap shows what they cost.

    Args:
        observer: the filter.
        recording: of its sample time; best rows that its noise levels were not fitted to.

    Raises:
        DataError: no gap fits into the runs.
    """
    row = np.concatenate([np.arange(len(run)) for run in recording.runs()])
    gap = (row >= _SETTLE) & (row % _PERIOD >= _PERIOD - _GAP)
    # As `measured_angles` takes them: beside a column of the measurement, `pitch` is the truth.
    kind = "_measured" if {"pitch_measured", "roll_measured"} <= set(recording.channels) else ""
    names = (f"pitch{kind}", f"roll{kind}")
    measured = np.column_stack([recording.channels[name] for name in names])
    judged = gap & np.isfinite(measured).all(axis=1)
    if not judged.any():
        raise DataError(f"runs of more than {_SETTLE + _PERIOD} rows are needed to check a filter; record longer.")
    angles = {name: np.where(gap, np.nan, recording.channels[name]) for name in names}
    hidden = replace(recording, channels={**recording.channels, **angles})
    error = observer.estimate(hidden).aligned[judged] - measured[judged]
    return float(np.sqrt((error**2).mean()))
