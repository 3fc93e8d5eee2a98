"""SI to and from the internal units of Technosoft iPOS drives (manual P091.063, 2015).

Angles, speeds and accelerations are those of the winch, behind the gear. The factor group of a drive
(6093h, 6094h, 6097h) must be neutral for these to hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from softneck.core import DataError, require_finite, require_positive

# maxon 134777, sold as "24:1"; the lab's logged positions are scaled with 24, 1.4 % less than the winch turned.
_GEAR_RATIO = 1539.0 / 65.0
# maxon 201937: 512 lines, four edges each.
_COUNTS_PER_TURN = 2048.0
# 6081h, 60FFh, 606Ch: 65536 is one count per slow-loop sample; 6083h, 6085h the same per sample squared.
_COUNTS_PER_SAMPLE_SCALE = 65536.0
# Current in internal units: A x 65520 / (2 I_peak).
_CURRENT_RANGE = 65520.0
_INT16, _INT32 = 2**15 - 1, 2**31 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveScale:
    """Factors from SI to a drive's units.

    Attributes:
        peak_current: of the drive [A]: 10 or 20, by its type (iPOS4808 or iPOS3604 and their set-up); no default,
            for a wrong one doubles or halves every current limit.
        gear: motor turns for one of the winch.
        counts_per_turn: encoder counts for one turn of the motor.
        slow_loop: sample time of the drive's slow loop [s]; 0.0005 to 0.001 were found.
        reversed: the winch pulls when the counts fall.
    """

    peak_current: float
    gear: float = _GEAR_RATIO
    counts_per_turn: float = _COUNTS_PER_TURN
    slow_loop: float = 1e-3
    reversed: bool = False

    def __post_init__(self) -> None:
        require_positive("peak_current", self.peak_current, "A")
        require_positive("gear", self.gear)
        require_positive("counts_per_turn", self.counts_per_turn)
        require_positive("slow_loop", self.slow_loop, "s")

    @property
    def counts_per_radian(self) -> float:
        """Encoder counts for one radian of the winch, with the sign of `reversed`."""
        size = self.gear * self.counts_per_turn / (2.0 * math.pi)
        return -size if self.reversed else size


def position_to_counts(position: float, scale: DriveScale) -> int:
    """Return the encoder counts nearest to a winch position [rad] (607Ah, 6064h).

    Raises DataError: beyond what 32 bits hold.
    """
    return _whole("position", position, scale.counts_per_radian, "rad", _INT32)


def counts_to_position(counts: int, scale: DriveScale) -> float:
    """Return the winch position [rad] of encoder counts."""
    return counts / scale.counts_per_radian


def speed_to_internal(speed: float, scale: DriveScale) -> int:
    """Return the internal units nearest to a winch speed [rad/s] (6081h, 60FFh, 606Ch).

    Raises DataError: beyond what 32 bits hold.
    """
    return _whole("speed", speed, _speed_factor(scale), "rad/s", _INT32)


def internal_to_speed(units: int, scale: DriveScale) -> float:
    """Return the winch speed [rad/s] of internal units."""
    return units / _speed_factor(scale)


def acceleration_to_internal(acceleration: float, scale: DriveScale) -> int:
    """Return the internal units nearest to a winch acceleration [rad/s^2] (6083h, 6085h).

    Raises DataError: beyond what 32 bits hold.
    """
    return _whole("acceleration", acceleration, _speed_factor(scale) * scale.slow_loop, "rad/s^2", _INT32)


def current_to_internal(current: float, scale: DriveScale) -> int:
    """Return the internal units nearest to a motor current [A]: `current * 65520 / (2 I_peak)`.

    Raises DataError: beyond what 16 bits hold, which is the peak current of the drive.
    """
    return _whole("current", current, _current_factor(scale), "A", _INT16)


def internal_to_current(units: int, scale: DriveScale) -> float:
    """Return the motor current [A] of internal units."""
    return units / _current_factor(scale)


def _speed_factor(scale: DriveScale) -> float:
    return _COUNTS_PER_SAMPLE_SCALE * scale.counts_per_radian * scale.slow_loop


def _current_factor(scale: DriveScale) -> float:
    size = _CURRENT_RANGE / (2.0 * scale.peak_current)
    return -size if scale.reversed else size


def _whole(name: str, value: float, factor: float, unit: str, largest: int) -> int:
    require_finite(name, value, unit)
    units = round(value * factor)
    if abs(units) > largest:
        raise DataError(
            f"`{name}` {value:g} [{unit}] is {units} in the drive's units, beyond +-{largest}; "
            "is the value in SI, and the scale that of the drive?"
        )
    return units
