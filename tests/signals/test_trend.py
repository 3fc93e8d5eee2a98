"""A trend is a line per run: taken out, put back, stored."""

from __future__ import annotations

import json

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError
from softneck.signals import Recording, Trend, concatenate

from ..data import neck_recording


def drifting() -> Recording:
    """Two runs with lines of their own and missed samples."""
    runs = []
    for level, slope in ((0.2, 0.03), (-0.1, -0.05)):
        r = neck_recording(150, noise=0.0)
        pitch = level + slope * r.time
        pitch[[3, 77]] = np.nan
        runs.append(r.with_channels(pitch=pitch))
    return concatenate(runs)


def test_a_line_is_found_and_taken_out() -> None:
    trend = Trend.of(drifting(), ("pitch",))
    # Exact lines: rounding of sums over 150 samples.
    np.testing.assert_allclose(trend.level["pitch"], [0.2, -0.1], rtol=1e-12)
    np.testing.assert_allclose(trend.slope["pitch"], [0.03, -0.05], rtol=1e-12)
    flat = trend.apply(drifting()).outputs[:, 0]
    np.testing.assert_allclose(flat[np.isfinite(flat)], 0, atol=1e-15)


def test_the_residual_has_neither_mean_nor_slope() -> None:
    r = neck_recording(400)
    flat = Trend.of(r).apply(r)
    for x in flat.outputs.T:
        # Sums of 400 numbers below 1 rad over 8 s: 400 x 8 x eps = 7e-13.
        assert abs(x.sum()) < 1e-12
        assert abs(x @ r.time) < 1e-11


def test_the_round_trip_is_exact_to_rounding_and_leaves_missed_samples_alone() -> None:
    r = drifting()
    trend = Trend.of(r)
    again = Trend.from_dict(json.loads(json.dumps(trend.as_dict())))
    assert again == trend
    back = again.invert(again.apply(r))
    # One difference and one sum of numbers below 1: an ulp of each.
    np.testing.assert_allclose(back.outputs, r.outputs, rtol=0, atol=2.3e-16)
    np.testing.assert_array_equal(np.isnan(back.outputs), np.isnan(r.outputs))
    np.testing.assert_array_equal(back.set_points, r.set_points)


def test_a_part_of_each_run_lies_on_the_same_line() -> None:
    r = drifting()
    whole = Trend.of(r).apply(r)
    for part, expected in zip(r.split(0.6), whole.split(0.6), strict=True):
        np.testing.assert_array_equal(Trend.of(r).apply(part).outputs, expected.outputs)


def test_a_run_without_samples_has_no_line() -> None:
    r = neck_recording(120)
    r = concatenate([r, r.with_channels(pitch=np.full(120, np.nan))])
    assert Trend.of(r, ("pitch",)).level["pitch"][1] == 0.0


def test_what_does_not_fit_is_named() -> None:
    r = drifting()
    with pytest.raises(DataError, match="the recording has no channel `payload`"):
        Trend.of(r, ("payload",))
    with pytest.raises(DataError, match=r"the trend is one of 2 run\(s\); this recording has 1"):
        Trend.of(r).apply(r.runs()[0])
    plain = concatenate([neck_recording(120, positions=False)] * 2)
    with pytest.raises(DataError, match="has a line for `motor_position_1`, which this recording does not have"):
        Trend.of(r, ("motor_position_1",)).apply(plain)
    for content in (
        {},
        {"origin": [0], "level": 5, "slope": {}},
        {"origin": [], "level": {}, "slope": {}},
        {"origin": [0], "level": {"pitch": [1, 2]}, "slope": {"pitch": [1, 2]}},
        {"origin": [0], "level": {"pitch": ["nan"]}, "slope": {"pitch": [1]}},
    ):
        with pytest.raises(FileFormatError, match="holds no trend"):
            Trend.from_dict(content)
