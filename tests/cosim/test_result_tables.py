"""The result of a loop as a table, as a Dataset and as a figure."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.cosim import Result, simulate
from softneck.design import PiSettings

from ..verification.necks import linear_neck


@pytest.fixture(scope="module")
def result() -> Result:
    step = {"kind": "step", "pitch_deg": 10.0, "at_s": 0.5}
    limits = {"pitch.overshoot_pct": 30.0, "pitch.settling_s": 1.5}
    controller = PiSettings().design(linear_neck())
    loop = {"duration_s": 2.0, "plant": "paper", "controller": controller, "reference": step, "limits": limits}
    return simulate(loop)


def test_a_table_has_every_signal_in_si_over_time(result: Result) -> None:
    frame = result.to_pandas()
    assert set(frame) == set(result.signals.signals)
    for name in frame:
        np.testing.assert_array_equal(frame[name], result[str(name)])
    np.testing.assert_array_equal(frame.index, result.signals.time)
    assert frame.attrs["units"]["pitch"] == "rad"


def test_a_dataset_is_asked_for_in_a_line_where_xarray_is_absent(result: Result) -> None:
    if find_spec("xarray") is None:
        with pytest.raises(SettingsError, match="xarray"):
            result.to_xarray()
        return
    assert set(result.to_xarray()) == set(result.signals.signals)


def test_a_figure_shows_the_limits_of_the_step(result: Result) -> None:
    pitch = result.plot("step").axes[0]
    names = {line.get_label(): line for line in pitch.lines}
    # 10 deg and 30 % of it; the step is at 0.5 s.
    assert np.asarray(names["overshoot at most 30 %"].get_ydata(), dtype=float)[0] == pytest.approx(13.0)
    assert np.asarray(names["settled after 1.5 s"].get_xdata(), dtype=float)[0] == pytest.approx(2.0)
    low, high = pitch.get_ylim()
    assert low < 0.0 < 13.0 < high
