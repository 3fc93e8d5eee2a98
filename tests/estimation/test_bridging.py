"""Gaps, and the way to now, show what noise levels cost that a likelihood may reward."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from softneck.core import DataError
from softneck.estimation import KalmanSettings
from softneck.estimation._noise import look_ahead_error
from softneck.signals import Recording, concatenate

from .necks import IN_TIME, neck, recording

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")


def test_levels_that_trust_any_measurement_bridge_a_gap_worse_than_the_true_ones() -> None:
    data, observer = recording(noise_deg=0.2), IN_TIME.design(neck())
    true = observer.with_noise((math.radians(0.2), math.radians(1e-3), math.radians(1e-3)), sensor="true")
    greedy = observer.with_noise((math.radians(1e-3), math.radians(1e-3), math.radians(2.0)), sensor="greedy")
    # The model is exact: what is left is the sensor's noise, of some 600 angles, known to 5 % (three deviations: 9 %).
    assert look_ahead_error(true, data) == pytest.approx(math.radians(0.2), rel=0.1)
    # That which believes the last sample before the gap carries that one's noise as well: sqrt(2) times the error.
    assert look_ahead_error(greedy, data) > 1.3 * look_ahead_error(true, data)


def test_the_measurement_in_a_gap_is_hidden_from_the_filter() -> None:
    data, observer = recording(rows=200), IN_TIME.design(neck())
    spoilt = data.with_channels(pitch=data.channels["pitch"] + 1.0)  # the truth, which no filter sees
    assert look_ahead_error(observer, spoilt) == look_ahead_error(observer, data)
    rows = np.arange(200)
    gap = (rows >= 50) & (rows % 25 >= 20)
    moved = data.with_channels(pitch_measured=data.channels["pitch_measured"] + np.where(gap, 0.3, 0.0))
    # Moved by 0.3 rad where nothing is seen, the error is those 0.3 rad on one of two axes.
    assert look_ahead_error(observer, moved) == pytest.approx(0.3 / math.sqrt(2.0), rel=0.05)


def test_an_outlier_of_the_sensor_is_no_error_of_the_filter() -> None:
    data, observer = recording(rows=400), IN_TIME.design(neck())
    wild = data.channels["pitch_measured"].copy()
    wild[[101, 207]] += 1.0
    assert look_ahead_error(observer, data.with_channels(pitch_measured=wild)) < 1.1 * look_ahead_error(observer, data)


def test_what_a_late_sensor_says_later_judges_what_was_said_to_be_now() -> None:
    """The model's dead time is the sensor's, so a filter that is told so sees two samples ahead of its measurement."""
    data = recording(noise_deg=0.0)
    late = replace(IN_TIME, sensor_delay=0.04, disturbance_noise_std=1e-6).design(neck())
    early = replace(IN_TIME, disturbance_noise_std=1e-6).design(neck())
    assert look_ahead_error(late, data.rows(400, 1500)) < 0.2 * look_ahead_error(early, data.rows(400, 1500), 0.04)


@dataclass(frozen=True)
class _Told:
    """An observer that tells the truth and an error, given by the row and the output."""

    error: np.ndarray
    lead: float = 0.0
    sample_time: float = 0.02

    def estimate(self, run: Recording) -> SimpleNamespace:
        return SimpleNamespace(outputs=run.outputs + self.error[: len(run)])


def test_a_larger_error_of_an_observer_never_improves_its_figure_and_one_that_diverged_has_the_worst() -> None:
    """Rows, outputs and runs count alike; what is no number where a measurement is known does not vanish."""
    data = recording(rows=400, noise_deg=0.0)
    rng = np.random.default_rng(0)
    error = 1e-3 * (1.0 + rng.random((400, 2)))
    rows = np.arange(400)
    gap = (rows >= 50) & (rows % 25 >= 20)

    def of(error: np.ndarray, recording: Recording = data) -> float:
        return look_ahead_error(_Told(error), recording)  # pyright: ignore[reportArgumentType]

    # The measurements are those of the truth but for rounding.
    assert of(error) == pytest.approx(math.sqrt(np.mean(error[gap] ** 2)), rel=1e-9)
    for row in np.flatnonzero(gap)[[0, 17, -1]]:
        for output in (0, 1):
            for worse in (2.0, -2.0, math.nan, math.inf, -math.inf):
                moved = error.copy()
                moved[row, output] *= worse
                found = of(moved)
                assert found == math.inf if not math.isfinite(worse) else found >= of(error)
    assert of(1.5 * error) == pytest.approx(1.5 * of(error), rel=1e-9)
    # A run that is worse never improves it, wherever it stands.
    both = concatenate([data, data])
    for first, second in ((error, 2.0 * error), (2.0 * error, error)):
        observer = SimpleNamespace(lead=0.0, sample_time=0.02, parts=[first, second])
        observer.estimate = lambda run, o=observer: SimpleNamespace(outputs=run.outputs + o.parts.pop(0))
        found = look_ahead_error(observer, both)  # pyright: ignore[reportArgumentType]
        assert found == pytest.approx(math.sqrt(2.5) * of(error), rel=1e-9)


def test_runs_without_a_gap_are_refused() -> None:
    with pytest.raises(DataError, match="runs of more than 75 rows are needed"):
        look_ahead_error(KalmanSettings().design(neck()), recording(rows=60))
