"""Logs of robots that nobody here made: what our kinds reach on them (`shared/data/other_robots`, if it is there)."""

from __future__ import annotations

from pathlib import Path

import pytest

from softneck import identify, validate
from softneck.core import Matrix
from softneck.signals import Recording, import_log
from softneck.signals.importing._robot_guess import guess_robot

pytestmark = pytest.mark.slow


def imported(folder: Path, name: str) -> Recording:
    path = folder / "other_robots" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent on this machine")
    return import_log(path, guess_robot(path).layout).recording


def test_a_pneumatic_arm_of_three_chambers_runs_free(shared_data: Path) -> None:
    head, tail = imported(shared_data, "pneumatic_arm_two_trials.csv").split(0.7)
    # Fixed directions and seconds reached -78/3 %, a ridge on learned directions 64/86 %.
    model = identify("play", head, train=1.0, degree=2, widths=())
    fits = validate(model, tail, horizons=(1, "inf")).fits["inf"]
    assert fits["x"] is not None
    assert fits["y"] is not None
    assert fits["x"] > 85.0
    assert fits["y"] > 90.0


def test_cascaded_tanks_at_their_own_4_s(shared_data: Path) -> None:
    recording = imported(shared_data, "cascaded_tanks_estimation.csv")
    assert recording.sample_time == 4.0
    model = identify("oe", recording, train=1.0)
    free: Matrix = model.simulate(recording)
    error = recording.outputs[25:, 0] - free[25:, 0]
    # On its own rows; two copies of the level and fixed seconds gave 0.78 V. The tanks are far from linear.
    assert (error**2).mean() ** 0.5 < 0.6
    assert model.findings["time_constants_s"][0] > 40.0
