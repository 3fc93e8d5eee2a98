"""The sample time is found from positions and velocities, in any unit of time, never across runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError
from softneck.signals import import_log, read_layout
from softneck.signals.importing._clocks import estimate_sample_time

from ..data import LAYOUTS


def turning(period: float, rows: int = 400) -> dict[str, np.ndarray]:
    k = np.arange(rows)
    x = {f"motor_position_{j}": np.sin(0.1 * j * k) for j in (1, 2, 3)}
    return x | {f"motor_velocity_{j}": 0.1 * j / period * np.cos(0.1 * j * k) for j in (1, 2, 3)}


@given(period=st.floats(1e-4, 10))
def test_a_sine_gives_its_period_back(period: float) -> None:
    found = estimate_sample_time(turning(period), np.zeros(400))
    # The trapezoid's error over one sample is (w T)^2 / 12 with w T = 0.1 to 0.3.
    assert found.value == pytest.approx(period, rel=0.01)
    assert not found.contradicts(period)
    assert found.contradicts(2 * period)


def test_a_jump_at_a_border_of_runs_is_no_motion() -> None:
    channels = turning(0.02)
    for j in (1, 2, 3):
        channels[f"motor_position_{j}"][200:] += 100.0
    assert estimate_sample_time(channels, np.repeat([0, 1], 200)).value == pytest.approx(0.02, rel=0.01)


@pytest.mark.parametrize("sign", [0.0, -1.0], ids=["none", "wrong sign"])
def test_velocities_that_do_not_agree_are_refused(sign: float) -> None:
    channels = {name: sign * c if "velocity" in name else c for name, c in turning(0.02).items()}
    with pytest.raises(DataError, match="the sample time cannot be estimated: no motor"):
        estimate_sample_time(channels, np.zeros(400))


def test_the_open_loop_recording_means_21_ms(shared_data: Path, tmp_path: Path) -> None:
    """The lab's `cs` and `ev` are the velocity command and its error, in rpm."""
    text = (LAYOUTS / "neck_openloop.toml").read_text()
    velocity = [
        f"[channels.motor_velocity_{j}]\nunit = 'rpm'\n"
        f"terms = [{{ column = 'cs{j}' }}, {{ column = 'ev{j}', factor = -1 }}]"
        for j in (1, 2, 3)
    ]
    log = shared_data / "neck_openloop/spring_test_0gr.csv"
    for number, expected in (('"estimate"', "sample time estimated"), ("0.01", "warning: 10 ms does not fit")):
        path = tmp_path / "layout.toml"
        path.write_text("\n".join([text.replace("sample_time_s = 0.021", f"sample_time_s = {number}"), *velocity]))
        done = import_log(log, read_layout(path))
        assert any(note.startswith(expected) for note in done.notes)
        if number == '"estimate"':
            # The README of the recordings says 20.3 to 22.4 ms.
            assert 0.0203 < done.recording.sample_time < 0.0224


def test_the_arms_20_ms_are_confirmed_in_silence(shared_data: Path) -> None:
    done = import_log(shared_data / "arm_multisine/arm_multisine_400s.csv", read_layout(LAYOUTS / "arm_multisine.toml"))
    assert done.notes == ()
