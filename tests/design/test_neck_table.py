"""The table of steps on the virtual neck: what its figures are, and that a failure becomes a reason."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.loop import metrics

from ..oracles.neck_table import NECK_HEAD, NeckRow, NeckSteps, neck_step, neck_table, table_cells

TS = 0.02


def neck() -> LinearNeck:
    """Near the virtual neck: 5 deg/rad, 5.3 1/s, four samples late."""
    pole = math.exp(-5.3 * TS)
    axis = control.TransferFunction([math.radians(5.0) * (1.0 - pole)], [1.0, -pole, 0.0, 0.0, 0.0, 0.0], TS)
    return LinearNeck(pitch=axis, roll=axis)


def few() -> NeckSteps:
    return NeckSteps(orientations=(0.0, math.radians(45.0)), payloads=(0.0, 0.4), duration=6.0)


def test_a_case_is_the_worse_axis_of_its_run() -> None:
    controller, observer = PiSettings().design(neck()), KalmanSettings().design(neck())
    (row,) = neck_table({"pi": controller}, observer, few())
    assert [(case.orientation, case.payload) for case in row.cases] == few().cases()
    for i, case in enumerate(row.cases):
        found = metrics(neck_step(controller, observer, few(), i))
        stepped = ["pitch"] if case.orientation == 0.0 else ["pitch", "roll"]
        overshoots = [found[axis]["overshoot_pct"] for axis in stepped]
        assert case.overshoot == max(value for value in overshoots if value is not None)
        assert found["roll"]["overshoot_pct"] is None or len(stepped) == 2
        assert case.steady == max(found[axis]["steady_rms_deg"] or 0.0 for axis in ("pitch", "roll"))


def test_the_payload_is_there_and_the_step_reaches_its_size() -> None:
    controller = PiSettings().design(neck())
    light, heavy = (neck_step(controller, None, few(), case) for case in (2, 3))
    # At rest before the step: 0.4 kg weigh 3.9 N, of which the stiff tendons give up the larger part.
    slack = sum(light[f"tension_{j}"][90] - heavy[f"tension_{j}"][90] for j in (1, 2, 3))
    assert 2.0 < slack < 3.9
    for result in (light, heavy):
        # Integral action takes the neck to its reference; noise and friction leave less than 0.2 deg.
        size = math.hypot(result["pitch"][-1], result["roll"][-1])
        assert math.degrees(size) == pytest.approx(15.0, abs=0.3)


def test_each_run_has_noise_of_its_own_and_repeats() -> None:
    controller = PiSettings().design(neck())
    steps = NeckSteps(orientations=(0.0,), payloads=(0.0, 0.0), duration=4.0)
    first, second, again = (neck_step(controller, None, steps, case)["pitch_measured"] for case in (0, 1, 0))
    assert np.any(first != second)
    np.testing.assert_array_equal(first, again)


def test_what_fails_is_skipped_with_its_reason() -> None:
    slow = PiSettings().design(neck())
    (row,) = neck_table({"pi": slow}, None, NeckSteps(neck="nowhere.toml"))
    assert not row.cases
    assert not row.holds
    assert "nowhere.toml: no such file" in row.skipped
    assert table_cells([row])[0][-1].startswith("skipped: nowhere.toml")


def test_the_cells_fit_the_head_and_a_missed_rise_does_not_hold() -> None:
    rows = neck_table({"pi": PiSettings(reference_time=30.0).design(neck())}, None, few())
    assert {len(cells) for cells in table_cells(rows)} == {len(NECK_HEAD)}
    assert rows[0].worst("rise") == math.inf
    assert not rows[0].holds
    assert not NeckRow(name="none").holds


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": 15.0}, r"`size` must be between 0\.001 and 0\.8 \[rad\]"),
        ({"payloads": (-0.1,)}, "`payloads` must be between 0 and 5"),
        ({"payloads": ()}, "at least one orientation and one payload"),
        ({"duration": 2.5}, "`duration` must be between 3"),
        ({"order": "other"}, "`order` must be one of"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        NeckSteps(**settings)
