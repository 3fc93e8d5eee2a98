"""What all designs around a linear plant share: limits, delays of the loop and the doubts about the plant."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import KINDS as KINDS_TABLE
from softneck.core import SettingsError, load, read_archive, resolve
from softneck.cosim import make_loop
from softneck.design import (
    AdaptiveSettings,
    ControllerLimits,
    CustomSettings,
    FopiSettings,
    HinfSettings,
    LqgSettings,
    MpcSettings,
    PidSettings,
    PiSettings,
    design_controller,
)
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.estimation._axis import axis_plant
from softneck.robot import Robot

from ..oracles.bake_off import neck_within
from .test_robots import plant as lag_of

_K = control.TransferFunction([4.0, -3.5], [1.0, -1.0], 0.02)


def _custom(**settings: Any) -> CustomSettings:
    return CustomSettings(controller=_K, **settings)


KINDS: dict[str, Callable[..., Any]] = {
    "pi": PiSettings, "pid": PidSettings, "fopi": FopiSettings, "hinf": HinfSettings,
    "lqg": LqgSettings, "custom": _custom, "adaptive": AdaptiveSettings,
}  # fmt: skip
LIMITS: dict[str, Any] = {"lead_limit": 0.7, "least_cocontraction": 0.25}


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_every_kind_hands_its_limits_on(make: Callable[..., Any]) -> None:
    own = neck_within(3.0, 5.0, lowest=-0.5)
    expected = ControllerLimits(position_limit=3.0, slew_limit=5.0, least_position=-0.5, robot=own, **LIMITS)
    assert make(**LIMITS).limits(own) == expected


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_a_kind_has_at_most_eight_settings(make: Callable[..., Any]) -> None:
    assert len(fields(make())) <= 8


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_the_order_of_the_loop_adds_the_samples_of_controller_and_observer(make: Callable[..., Any]) -> None:
    assert make().extra_delay == 0
    assert make(order="jacobi").extra_delay == 2


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"lead_limit": 12.1}, "`lead_limit` must be between 0.01 and 12"),
        ({"lead_limit": 0.0}, "`lead_limit` must be positive"),
        ({"least_cocontraction": 7.0}, "`least_cocontraction` must be between -6 and 6"),
        ({"order": "random"}, "`order` must be"),
    ],
)
def test_every_kind_refuses_the_same(make: Callable[..., Any], settings: dict[str, Any], match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        make(**settings).limits(_PRESET)


@pytest.mark.parametrize("kind", [*KINDS, "mpc"])
@pytest.mark.parametrize("setting", ["position_limit", "slew_limit", "least_position", "tendon_angles", "sample_time"])
def test_what_is_the_robots_is_in_its_file(kind: str, setting: str) -> None:
    if setting in {field.name for field in fields(resolve(KINDS_TABLE[kind].settings))}:
        pytest.skip("a setting still")
    values: dict[str, Any] = {setting: 1.0}
    with pytest.raises(SettingsError, match=f"`{setting}` is the robot's: set .* in robot.toml"):
        design_controller(kind, OwnNeck(), **values)


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
    [PiSettings(), AdaptiveSettings(), MpcNumbers(bandwidth=5.0, horizon=8, moves=3), KalmanSettings()],
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
    limits = AdaptiveSettings().design(OwnNeck()).limits
    assert (limits.position_limit, limits.slew_limit) == (4.0, 5.0)
    # `robot=` counts more than what the plant says.
    limits = AdaptiveSettings().design(OwnNeck(), robot=neck_within(5.0, 9.0)).limits
    assert (limits.position_limit, limits.slew_limit, limits.least_position) == (5.0, 9.0, -6.0)
    # And what a neck's file allows beyond the usual is not used up.
    assert AdaptiveSettings().design(OwnNeck(_PRESET)).limits.slew_limit == 12.5


def _hiding(pole: float, zero: float) -> LinearNeck:
    """Return a neck with one pole more, next to a zero."""
    a = math.exp(-3.0 * 0.02)
    denominator = np.convolve(np.convolve([1.0, -a], [1.0, -pole]), [1.0, 0.0, 0.0, 0.0, 0.0])
    tf = control.TransferFunction(0.01 * np.array([1.0, -zero]), denominator, 0.02)
    return LinearNeck(tf, tf)


# 0.9979 beside 0.998: a twentieth of the static gain, with a time constant of 10 s.
HIDDEN, HIDES = 0.998, 0.9979


def test_a_small_move_is_as_quick_whatever_slow_pole_hides_behind_a_zero() -> None:
    w = np.geomspace(1.0, 100.0, 50)
    plain, with_it = (
        axis_plant(_hiding(pole, zero), "pitch").with_faster_pole(5.293).response(w)
        for pole, zero in ((0.0, 0.0), (HIDDEN, HIDES))
    )
    # What the pair itself does at 1 rad/s: 5e-3 / (1 rad/s * 1 s).
    np.testing.assert_allclose(with_it / plain, 1.0, atol=6e-3)


@pytest.mark.parametrize("kind", ["pi", "pid", "fopi", "hinf", "lqg"])
def test_a_slow_pole_that_hides_behind_a_zero_spoils_no_design(kind: str) -> None:
    """Taken for what small moves are quicker by, it made the plant sixty times as loud: most kinds had no solution."""
    plain, with_it = (
        KINDS[kind]().design(_hiding(pole, zero)).design["pitch"]["margins"]["crossover"]
        for pole, zero in ((0.0, 0.0), (HIDDEN, HIDES))
    )
    # Searches end within some percent, and that of `pid` in another optimum, 16 % away.
    assert with_it == pytest.approx(plain, rel=0.25)


@pytest.mark.slow
def test_a_slow_pole_that_hides_behind_a_zero_is_asked_nothing_of_by_mpc() -> None:
    """No weight on moves makes it faster: none of a bandwidth of 1 rad/s on kept any bound."""
    plain, with_it = (
        MpcSettings().design(_hiding(pole, zero)).design["bandwidth_rad_s"]
        for pole, zero in ((0.0, 0.0), (HIDDEN, HIDES))
    )
    # Bounds bind elsewhere by what the pair itself adds: 2.9 and 2.3 rad/s.
    assert with_it == pytest.approx(plain, rel=0.25)


def test_what_the_output_shows_is_the_plant_without_the_pole_that_hides() -> None:
    plain, with_it = (axis_plant(_hiding(pole, zero), "pitch") for pole, zero in ((0.0, 0.0), (HIDDEN, HIDES)))
    assert plain.remove_hidden_poles() is plain
    shown = with_it.remove_hidden_poles()
    assert shown.static_gain == pytest.approx(with_it.static_gain, rel=1e-9)
    np.testing.assert_allclose(np.roots(shown.denominator), [math.exp(-3.0 * 0.02)], atol=1e-9)
