"""What all designs around a linear plant share: limits, delays of the loop and the doubts about the plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import pytest

from softneck.core import SettingsError, load, read_archive
from softneck.cosim import make_loop
from softneck.design import (
    AdaptiveSettings,
    ControllerLimits,
    CustomSettings,
    FopiSettings,
    HinfSettings,
    LqgSettings,
    MpcSettings,
    NcfSettings,
    NmpcSettings,
    PidSettings,
    PiSettings,
    ScheduledSettings,
)
from softneck.estimation import KalmanSettings
from softneck.robot import Robot

from .test_robots import plant as lag_of

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
        ({"lead_limit": 12.1}, "`lead_limit` must be between 0.01 and 12"),
        ({"least_position": 2.0, "position_limit": 1.0}, "`least_position` must be below `position_limit`"),
        ({"order": "random"}, "`order` must be"),
        ({"least_delay": -0.1}, "`least_delay` must be between 0 and 1"),
        ({"small_move_pole": -1.0}, "`small_move_pole` must be between 0 and 1000"),
    ],
)
def test_every_kind_refuses_the_same(make: Callable[..., Any], settings: dict[str, Any], match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        make(**settings).limits()


@pytest.mark.parametrize("make", [*KINDS.values(), MpcSettings, NmpcSettings], ids=[*KINDS, "mpc", "nmpc"])
@pytest.mark.parametrize("setting", ["position_limit", "slew_limit", "lead_limit"])
def test_limits_are_those_of_a_robot_and_none_without_one(make: Callable[..., Any], setting: str) -> None:
    assert getattr(make(**{setting: 2e5}), setting) == 2e5
    with pytest.raises(SettingsError, match=f"`{setting}` must be positive"):
        make(**{setting: 0.0})


_PRESET = Robot.preset("neck")
_OWN = replace(
    _PRESET, name="stiff neck", motors=replace(_PRESET.motors, setpoint_max=(4.0,) * 3, rate_limit=(5.0,) * 3)
)


class OwnNeck:
    """A linear model of a neck with a file of its own."""

    def __init__(self, robot: Robot = _OWN) -> None:
        self.robot, self.sample_time = robot, 0.02

    def tf(self, _output: str, /) -> control.TransferFunction:
        return control.TransferFunction([0.009], [1.0, -0.9, 0.0], 0.02)


@pytest.mark.parametrize(
    "settings",
    [PiSettings(), AdaptiveSettings(), MpcSettings(bandwidth=5.0, horizon=8, moves=3), KalmanSettings()],
    ids=lambda settings: type(settings).__name__,
)
def test_files_of_a_neck_with_a_file_of_its_own_carry_it(settings: Any, tmp_path: Path) -> None:
    settings.design(OwnNeck()).save(tmp_path / "own.npz")
    settings.design(OwnNeck(_PRESET)).save(tmp_path / "preset.npz")
    found = load(tmp_path / "own.npz").robot
    assert (found.name, found.motors.setpoint_max) == ("stiff neck", (4.0,) * 3)
    # The paper's neck is what a file without a robot is of, and its files stay as they are.
    assert "robot" not in read_archive(tmp_path / "preset.npz")[0]
    if not isinstance(settings, KalmanSettings):
        table = {"duration_s": 0.1, "reference": {"kind": "step"}, "controller": str(tmp_path / "own.npz")}
        with pytest.raises(
            SettingsError, match=r"`stiff neck` .* and .*robot `antagonist`|`antagonist` .* `stiff neck`"
        ):
            make_loop({**table, "plant": lag_of(Robot.preset("antagonist"))})


def test_limits_of_a_necks_own_file_hold_where_they_are_stricter() -> None:
    own = _OWN
    settings = ScheduledSettings(inclinations=(0.05, 0.3))
    limits = settings.design([OwnNeck(), OwnNeck()]).limits
    assert (limits.position_limit, limits.slew_limit) == (4.0, 5.0)
    given = replace(settings, slew_limit=9.0).limits(own)
    assert (given.position_limit, given.slew_limit) == (4.0, 9.0)
