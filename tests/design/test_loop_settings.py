"""What all designs around a linear plant share: limits, delays of the loop and the doubts about the plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import control
import pytest

from softneck.core import SettingsError
from softneck.design import (
    AdaptiveSettings,
    ControllerLimits,
    CustomSettings,
    FopiSettings,
    HinfSettings,
    LqgSettings,
    NcfSettings,
    PidSettings,
    PiSettings,
    ScheduledSettings,
)
from softneck.robot import Robot

_K = control.TransferFunction([4.0, -3.5], [1.0, -1.0], 0.02)


def _custom(**settings: Any) -> CustomSettings:
    return CustomSettings(controller=_K, **settings)


KINDS: dict[str, Callable[..., Any]] = {
    "pi": PiSettings, "pid": PidSettings, "fopi": FopiSettings, "hinf": HinfSettings, "ncf": NcfSettings,
    "lqg": LqgSettings, "custom": _custom, "scheduled": ScheduledSettings, "adaptive": AdaptiveSettings,
}  # fmt: skip
LIMITS: dict[str, Any] = {
    "position_limit": 3.0, "slew_limit": 5.0, "lead_limit": 0.7, "least_position": -0.5, "least_cocontraction": 0.25
}  # fmt: skip


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_every_kind_hands_its_limits_on(make: Callable[..., Any]) -> None:
    assert make(**LIMITS).limits() == ControllerLimits(**LIMITS)


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_the_order_of_the_loop_adds_the_samples_of_controller_and_observer(make: Callable[..., Any]) -> None:
    assert make().extra_delay == 0
    assert make(order="jacobi").extra_delay == 2
    assert make(order="jacobi", observer=False).extra_delay == 1


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"position_limit": 6.1}, "`position_limit` must be between 0.01 and 6"),
        ({"slew_limit": 1001.0}, "`slew_limit` must be between 0.01 and 1000"),
        ({"lead_limit": 0.0}, "`lead_limit` must be between 0.01 and 12"),
        ({"least_position": 2.0, "position_limit": 1.0}, "`least_position` must be below `position_limit`"),
        ({"order": "random"}, "`order` must be"),
        ({"least_delay": -0.1}, "`least_delay` must be between 0 and 1"),
        ({"small_move_pole": -1.0}, "`small_move_pole` must be between 0 and 1000"),
    ],
)
def test_every_kind_refuses_the_same(make: Callable[..., Any], settings: dict[str, Any], match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        make(**settings)


def test_limits_of_a_necks_own_file_hold_where_they_are_stricter() -> None:
    preset = Robot.preset("neck")
    own = replace(preset, motors=replace(preset.motors, setpoint_max=(4.0,) * 3, rate_limit=(5.0,) * 3))
    lag = control.TransferFunction([0.009], [1.0, -0.9, 0.0], 0.02)

    class OwnNeck:
        robot, sample_time = own, 0.02

        def tf(self, _output: str, /) -> control.TransferFunction:
            return lag

    settings = ScheduledSettings(inclinations=(0.05, 0.3))
    limits = settings.design([OwnNeck(), OwnNeck()]).limits
    assert (limits.position_limit, limits.slew_limit) == (4.0, 5.0)
    given = replace(settings, slew_limit=9.0).limits(own)
    assert (given.position_limit, given.slew_limit) == (4.0, 9.0)
