"""The lab's own closed-loop recordings: smoother than raw, and how much later."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck.core import Vector
from softneck.estimation import KalmanSettings
from softneck.identification import Rls
from softneck.signals import Recording, import_log, read_layout

from ..data import LAYOUTS
from .necks import with_levels

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")


def read(shared_data: Path, payload: str) -> Recording:
    path = shared_data / f"neck_closedloop/frontier_test_{payload}gr.csv"
    return import_log(path, read_layout(LAYOUTS / "neck_closedloop.toml")).recording


def roughness(y: Vector) -> float:
    """Mean square of the second difference: what jerks a derivative action."""
    return float(np.mean(np.diff(y, 2) ** 2))


def lag(raw: Vector, filtered: Vector) -> float:
    """Samples by which `filtered` is behind `raw`: where the mean square of their difference is least.

    Shifts of -3 to 5 samples, between them by straight lines, so that parts of a sample show.
    """
    k = np.arange(10, raw.size - 10)
    shifts = np.linspace(-3.0, 5.0, 161)
    misses = [np.mean((np.interp(k + shift, np.arange(raw.size), filtered) - raw[k]) ** 2) for shift in shifts]
    return float(shifts[int(np.argmin(misses))])


@pytest.mark.parametrize("payload", ["400", "1000"])
def test_the_real_inclinometer_becomes_smoother_by_less_than_a_sample_of_lag(shared_data: Path, payload: str) -> None:
    model = Rls().fit([read(shared_data, "000")])
    # The model is of the empty platform: with a payload it misses more than the 0.15 deg of the default.
    # Judged against what the sensor says when it says it: no look-ahead over its delay.
    settings = KalmanSettings(sensor="mpu9250", sensor_delay=0.0, disturbance_noise_std=np.radians(0.2))
    observer = with_levels(settings.design(model), model_noise_std=np.radians(0.4))
    timed = 0
    for run in read(shared_data, payload).runs():
        estimates = observer.estimate(run)
        assert estimates.accepted.all()
        for axis, column in (("pitch", estimates.pitch), ("roll", estimates.roll)):
            raw = run.channels[axis]
            if np.ptp(raw) < np.radians(5.0):
                continue  # the axis that the step left alone: nothing to time
            timed += 1
            rough, late = roughness(column) / roughness(raw), lag(raw, column)
            print(f"{payload} g, {axis}: roughness {rough:.2f} of raw, lag {late:.2f} samples")
            # Issue 10; found: 0.46 to 0.95 of the raw roughness (0.95 where the log jumps) and 0.05 to 0.15 samples.
            assert rough < 0.97
            assert late <= 0.5
    assert timed >= 4
