"""Drive units: round trips, the data's own quantum, and what does not fit."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, SettingsError
from softneck.drives.bus._units import (
    DriveScale,
    acceleration_to_internal,
    counts_to_position,
    current_to_internal,
    internal_to_current,
    internal_to_speed,
    position_to_counts,
    speed_to_internal,
)

SCALES = st.builds(
    DriveScale,
    peak_current=st.sampled_from([10.0, 20.0]),
    slow_loop=st.sampled_from([0.5e-3, 0.8e-3, 1e-3]),
    reversed=st.booleans(),
)
PAIRS = [
    pytest.param(position_to_counts, counts_to_position, 6.0, id="position"),
    pytest.param(speed_to_internal, internal_to_speed, 15.6, id="speed"),
    pytest.param(current_to_internal, internal_to_current, 5.0, id="current"),
]


@pytest.mark.parametrize(("to_units", "from_units", "largest"), PAIRS)
@given(scale=SCALES, part=st.floats(-1.0, 1.0))
def test_a_value_comes_back_within_half_a_unit(
    to_units: Callable[[float, DriveScale], int],
    from_units: Callable[[int, DriveScale], float],
    largest: float,
    scale: DriveScale,
    part: float,
) -> None:
    value = part * largest
    quantum = abs(from_units(1, scale))
    # Half a unit of rounding, and the last bits of two multiplications.
    assert abs(from_units(to_units(value, scale), scale) - value) <= 0.5 * quantum * (1 + 1e-9) + 1e-14 * largest


@pytest.mark.parametrize(("to_units", "from_units", "largest"), PAIRS)
@given(scale=SCALES, units=st.integers(-8000, 8000))
def test_units_come_back_exactly(
    to_units: Callable[[float, DriveScale], int],
    from_units: Callable[[int, DriveScale], float],
    largest: float,
    scale: DriveScale,
    units: int,
) -> None:
    assert to_units(from_units(units, scale), scale) == units


def test_the_recordings_were_scaled_with_the_gear_as_it_is_sold() -> None:
    # Their quantum is 1.278e-4 rad (four digits): that of 24:1, not of 1539/65.
    assert counts_to_position(1, DriveScale(peak_current=10.0, gear=24.0)) == pytest.approx(1.278e-4, rel=5e-4)


def test_a_turn_of_the_winch_is_48490_counts() -> None:
    # 1539/65 x 2048 = 48,490.3: the hardware facts give it as 48,490.
    assert position_to_counts(2.0 * math.pi, DriveScale(peak_current=10.0)) == 48490


def test_one_count_per_slow_loop_sample_is_65536() -> None:
    scale = DriveScale(peak_current=10.0, slow_loop=1e-3)
    one_count_per_ms = counts_to_position(1, scale) / 1e-3
    assert speed_to_internal(one_count_per_ms, scale) == 65536
    assert acceleration_to_internal(one_count_per_ms / 1e-3, scale) == 65536


def test_the_peak_current_is_half_the_range() -> None:
    assert current_to_internal(10.0, DriveScale(peak_current=10.0)) == 32760
    # The lab's limit of 29.9 mA is some tens of units: a wrong peak current matters.
    assert current_to_internal(0.0299, DriveScale(peak_current=10.0)) == 98
    assert current_to_internal(0.0299, DriveScale(peak_current=20.0)) == 49


def test_a_reversed_drive_counts_backwards() -> None:
    there, back = DriveScale(peak_current=10.0), DriveScale(peak_current=10.0, reversed=True)
    for convert in (position_to_counts, speed_to_internal, acceleration_to_internal, current_to_internal):
        assert convert(1.5, back) == -convert(1.5, there)


@pytest.mark.parametrize(
    ("convert", "value", "error", "message"),
    [
        (current_to_internal, 11.0, DataError, r"`current` 11 \[A\] is 36036 in the drive's units"),
        (position_to_counts, 1e6, DataError, "is the value in SI"),
        (speed_to_internal, math.nan, SettingsError, "`speed` must be a finite number"),
    ],
    ids=["current", "position", "nan"],
)
def test_what_does_not_fit_is_refused(
    convert: Callable[[float, DriveScale], int], value: float, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        convert(value, DriveScale(peak_current=10.0))


def test_a_scale_needs_positive_numbers() -> None:
    with pytest.raises(SettingsError, match="`gear` must be positive"):
        DriveScale(peak_current=10.0, gear=0.0)
