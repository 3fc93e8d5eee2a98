"""A setting may be given in a unit of its own; one of another quantity is refused."""

from __future__ import annotations

import math

import pytest

from softneck.cli.shared._options import apply_settings
from softneck.core import KINDS, SettingsError, resolve


@pytest.mark.parametrize(
    ("kind", "given", "key", "value"),
    [
        ("rls", "delay_ms=80", "delay", 0.08),
        ("rls", "delay=0.08", "delay", 0.08),
        ("nlsm", "epsilon_mm=2", "epsilon", 2e-3),
        ("nlsm", "epsilon_deg=0.5", "epsilon", math.radians(0.5)),
        ("pi", "phase_margin_deg=60", "phase_margin", math.radians(60.0)),
        ("pi", "reference_time_ms=300", "reference_time", 0.3),
        ("pi", "least_cocontraction_kPa=20", "least_cocontraction", 2e4),
        ("mpc", "minimum_tautness_deg=-10", "minimum_tautness", -math.radians(10.0)),
        ("lqg", "lead_limit_V=2", "lead_limit", 2.0),
    ],
)
def test_a_unit_behind_the_key_is_converted(kind: str, given: str, key: str, value: float) -> None:
    settings = apply_settings(resolve(KINDS[kind].settings), [given])
    # One product is rounded.
    assert getattr(settings, key) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("kind", "given", "line"),
    [
        ("rls", "delay_deg=8", "`delay_deg`: `delay` is in s, and deg is no unit of that"),
        ("pi", "phase_margin_ms=8", "`phase_margin_ms`: `phase_margin` is in rad, and ms is no unit of that"),
        ("nlsm", "epsilon_furlong=1", "`epsilon_furlong`: unknown unit `furlong`"),
        ("rls", "delay_ms=soon", "`delay_ms` takes a number; got 'soon'"),
        ("rls", "na_ms=1", "unknown setting `na_ms`"),
    ],
)
def test_another_quantity_is_one_line(kind: str, given: str, line: str) -> None:
    with pytest.raises(SettingsError, match=line):
        apply_settings(resolve(KINDS[kind].settings), [given])
