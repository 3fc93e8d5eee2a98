"""Gaps show what noise levels cost that a likelihood may reward."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softneck.core import DataError
from softneck.estimation import KalmanSettings
from softneck.estimation._consistency import bridging_error

from .necks import neck, recording


def test_levels_that_trust_any_measurement_bridge_a_gap_worse_than_the_true_ones() -> None:
    data, observer = recording(noise_deg=0.2), KalmanSettings().design(neck())
    true = observer.with_noise((math.radians(0.2), math.radians(1e-3), math.radians(1e-3)), sensor="true")
    greedy = observer.with_noise((math.radians(1e-3), math.radians(1e-3), math.radians(2.0)), sensor="greedy")
    # The model is exact: what is left is the sensor's noise, of some 600 angles, known to 5 % (three deviations: 9 %).
    assert bridging_error(true, data) == pytest.approx(math.radians(0.2), rel=0.1)
    # That which believes the last sample before the gap carries that one's noise as well: sqrt(2) times the error.
    assert bridging_error(greedy, data) > 1.3 * bridging_error(true, data)


def test_the_measurement_in_a_gap_is_hidden_from_the_filter() -> None:
    data, observer = recording(rows=200), KalmanSettings().design(neck())
    spoilt = data.with_channels(pitch=data.channels["pitch"] + 1.0)  # the truth, which no filter sees
    assert bridging_error(observer, spoilt) == bridging_error(observer, data)
    rows = np.arange(200)
    gap = (rows >= 50) & (rows % 25 >= 20)
    moved = data.with_channels(pitch_measured=data.channels["pitch_measured"] + np.where(gap, 0.3, 0.0))
    # Moved by 0.3 rad where nothing is seen, the error is those 0.3 rad on one of two axes.
    assert bridging_error(observer, moved) == pytest.approx(0.3 / math.sqrt(2.0), rel=0.05)


def test_runs_without_a_gap_are_refused() -> None:
    with pytest.raises(DataError, match="runs of more than 75 rows are needed"):
        bridging_error(KalmanSettings().design(neck()), recording(rows=60))
