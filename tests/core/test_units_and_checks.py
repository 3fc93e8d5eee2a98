"""Units and the checks at the public edge."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import (
    SI_BASES,
    DataError,
    SettingsError,
    _units,
    require_between,
    require_finite,
    require_one_of,
    require_positive,
    spelled_unit,
    to_si,
)
from softneck.core._checks import finite_vector

PAIRS = [("deg", "rad", math.pi / 180), ("deg/s", "rad/s", math.pi / 180), ("ms", "s", 1e-3), ("mm", "m", 1e-3),
         ("g", "kg", 1e-3)]  # fmt: skip


@pytest.mark.parametrize(("unit", "si", "factor"), PAIRS)
def test_a_unit_has_its_si_unit_and_factor(unit: str, si: str, factor: float) -> None:
    assert to_si(unit) == (factor, si)
    # An SI unit is its own: converting twice changes nothing.
    assert to_si(si) == (1.0, si)


@pytest.mark.parametrize(
    ("text", "unit"),
    [("mPa", "MPa"), ("MPa", "MPa"), ("mN", "mN"), ("µs", "us"), ("μm", "um"), ("GRAD/s", "deg/s"), ("°", "deg"),
     ("Nm", "Nm"), ("rev", "turns"), ("KPA", "kPa"), ("bar/s", "bar/s"),
     ("kV", "kV"), ("µN", "uN"), ("N m", "Nm"), ("mN·m", "mNm"), ("kN*m", "kNm"), ("N mm", "Nmm"), ("kΩ", "kOhm"),
     ("mL/min", "ml/min"), ("MHz", "MHz"), ("MV", "mV"), ("m/s/s", None),
     ("foo", None), ("", None), ("foo/s", None), ("c", None)],
)  # fmt: skip
def test_a_spelling_of_logs_is_one_unit_or_none(text: str, unit: str | None) -> None:
    assert spelled_unit(text) == unit


def test_prefixes_and_products_have_the_factors_of_their_parts() -> None:
    # One product: half a unit in the last place.
    for unit, factor, of in (("kV", 1e3, "V"), ("uNm", 1e-6, "Nm"), ("MPa", 1e6, "Pa"), ("mbar", 1e-3, "bar")):
        assert to_si(unit) == (pytest.approx(factor * to_si(of)[0], rel=1e-15), to_si(of)[1])
    # The definitions of litre and minute: 60,000 l/min are a cubic metre a second.
    assert to_si("l/min") == (pytest.approx(1.0 / 60_000.0, rel=1e-15), "m3/s")


def test_every_unit_spells_itself_and_no_spelling_is_of_two_units() -> None:
    words = [word for _, _, others in _units._UNITS.values() for word in others.split()]
    assert len(set(words)) == len(words)
    assert not set(words) & {unit.lower() for unit in _units._UNITS}
    for unit in _units._UNITS:
        assert spelled_unit(unit) == unit
        factor, si = to_si(unit)
        assert factor > 0.0
        assert to_si(si) == (1.0, si)
        assert si in SI_BASES


@given(value=st.floats(-1e6, 1e6), unit=st.sampled_from([pair[0] for pair in PAIRS]))
def test_a_value_survives_the_way_to_si_and_back(value: float, unit: str) -> None:
    factor, _ = to_si(unit)
    # One product and one quotient: two roundings, half a unit in the last place each; below 1e-300 digits are lost.
    assert value * factor / factor == pytest.approx(value, rel=2.3e-16, abs=1e-300)


@pytest.mark.parametrize("unit", ["", "degrees", "Deg", "rad ", "°"])
def test_an_unknown_unit_names_those_that_are_known(unit: str) -> None:
    with pytest.raises(DataError, match=r"unknown unit `.*`; use one of rad, deg"):
        to_si(unit)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_every_check_refuses_what_is_not_finite(value: float) -> None:
    for check in (
        lambda: require_finite("gain", value, "N"),
        lambda: require_positive("gain", value, "N"),
        lambda: require_between("gain", value, 0, 1, "N"),
    ):
        with pytest.raises(SettingsError, match=r"`gain` must be a finite number \[N\]; got"):
            check()


def test_checks_name_the_argument_the_rule_and_what_came() -> None:
    with pytest.raises(SettingsError, match=r"`mass` must be positive \[kg\]; got 0"):
        require_positive("mass", 0.0, "kg")
    with pytest.raises(SettingsError, match=r"`part` must be between 0 and 1; got 1\.5"):
        require_between("part", 1.5, 0, 1)
    with pytest.raises(SettingsError, match="`form` must be one of a, b; got 'c'"):
        require_one_of("form", "c", ("a", "b"))
    with pytest.raises(DataError, match="`inputs` must have 3 entries; got 2"):
        finite_vector("inputs", [1, 2], 3)
    with pytest.raises(DataError, match="`inputs` must be finite"):
        finite_vector("inputs", [1, math.nan, 2], 3)


def test_borders_belong_to_the_range() -> None:
    for value in (0.0, 1.0):
        require_between("part", value, 0, 1)
    np.testing.assert_array_equal(finite_vector("inputs", [[1, 2, 3]], 3), [1.0, 2.0, 3.0])
