"""From undisturbed motion to a baseline: each number is of what it says, on three short runs in virtual time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from softneck.drives import default_drives
from softneck.drives.supervision import _calibrate
from softneck.drives.supervision._calibrate import calibrate
from softneck.drives.supervision._detection import Budget
from softneck.drives.supervision._motor_models import Motion

from ..bench import TS, T
from ..plausible import watched
from ..undisturbed import undisturbed

_SECONDS = 20.0


@cache
def motions() -> tuple[Motion, ...]:
    """Some seconds each of slow set-points; every tenth sample of the tilt did not come."""
    played = [undisturbed(watched(seed, "open"), _SECONDS)[0] for seed in (1, 2, 3)]
    for motion in played:
        motion.values[np.flatnonzero(motion.due)[5::10]] = np.nan
    return tuple(replace(motion, references=None) for motion in played)


calibrated = partial(calibrate, cycle=T, sample_cycles=2, slack=default_drives().limits.slack)


@pytest.mark.slow
def test_a_quarter_of_the_slow_error_of_each_output_and_each_sample_that_is_missing_is_known() -> None:
    part, whole = calibrated(motions()), calibrated(motions(), known_bias=1.0)
    assert len(part.tilt_bias) == part.outputs
    assert whole.tilt_bias == pytest.approx([4.0 * bias for bias in part.tilt_bias])
    assert min(part.tilt_bias) > 0.0
    assert part.missing == pytest.approx(0.1, abs=0.001)


def test_budgets_are_told_in_the_steps_of_their_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motors are judged each cycle, the tilt each sample; a step that is too short is a budget that is too small."""
    told: list[tuple[int, Budget]] = []
    real = _calibrate.thresholds

    def kept(scores: list[np.ndarray], budget: Budget, rng: np.random.Generator) -> np.ndarray:
        told.append((len(scores[0]), budget))
        return real(scores, budget, rng)

    monkeypatch.setattr(_calibrate, "thresholds", kept)
    made = calibrated(motions())
    assert [round(_SECONDS / budget.step) for _, budget in told] == [rows for rows, _ in told]
    assert [budget.step for _, budget in told] == [T, TS]
    # Shared by all of them, and the one that counts the samples.
    assert {budget.charts for _, budget in told} == {len(made.motor_thresholds) + len(made.tilt_thresholds) + 1}
