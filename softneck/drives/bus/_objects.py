"""Objects of a drive that a run needs, and their values, per profile."""

from __future__ import annotations

from typing import NamedTuple

from ._file import DriveEntry, DrivesFile
from ._units import (
    acceleration_to_internal,
    current_to_internal,
    internal_to_current,
    internal_to_speed,
    position_to_counts,
    speed_to_internal,
)

# Home offset [counts] that `softneck drives commission --only zero` sets: no drive has it after a reset, so it proves
# the zero.
HOMED_MARK = 1
CSP = 8
# How long a drive may be beyond its window (6066h) [ms]: the fault table's 200 ms.
_FOLLOWING_TIME = 200
# Our own node number, for heartbeats.
MASTER_NODE = 127
# Speeds of the profile ds402: counts per second.
_RAW_PROFILE = "ds402"

_CURRENT = {"ipos2015": 0x207E, "ds402": 0x6078}
# Rated current of the motor, to which 6073h and 6078h are relative (maxon 118739) [A].
RATED_CURRENT = 0.060


class Write(NamedTuple):
    """A value for the object `at`, subindex `sub`, to be read back."""

    at: int
    sub: int
    value: int


# What a drive needs to be guarded: a heartbeat consumer and producer, or life guarding.
GUARDED_BY = {"heartbeat": (0x1016, 0x1017), "life": (0x100C, 0x100D)}
GUARDING_OBJECTS = ((0x1016, 1), (0x1017, 0), (0x100C, 0), (0x100D, 0))
_ANY_GUARDING = frozenset(index for index, _ in GUARDING_OBJECTS)


def speed_units(speed: float, entry: DriveEntry, profile: str) -> int:
    """Return a speed [rad/s] in the drive's units."""
    if profile == _RAW_PROFILE:
        return round(speed * entry.scale.counts_per_radian)
    return speed_to_internal(speed, entry.scale)


def speed_of_units(units: int, entry: DriveEntry, profile: str) -> float:
    """Return a speed [rad/s] of the drive's units."""
    return units / entry.scale.counts_per_radian if profile == _RAW_PROFILE else internal_to_speed(units, entry.scale)


def current_write(current: float, entry: DriveEntry, profile: str) -> Write:
    """Return the write that limits the motor's current [A]."""
    if profile == _RAW_PROFILE:
        return Write(0x6073, 0, round(1000.0 * current / RATED_CURRENT))
    return Write(0x207F, 0, abs(current_to_internal(current, entry.scale)))


def ampere(entry: DriveEntry, profile: str) -> float:
    """Return the current of one unit of the drive's reading [A]."""
    return 1e-3 * RATED_CURRENT if profile == _RAW_PROFILE else abs(internal_to_current(1, entry.scale))


def _acceleration(value: float, entry: DriveEntry, profile: str) -> int:
    if profile == _RAW_PROFILE:
        return abs(round(value * entry.scale.counts_per_radian))
    return abs(acceleration_to_internal(value, entry.scale))


def option_writes() -> list[Write]:
    """Reactions of a drive to a failure of connection, master or itself: Fault after a quick-stop ramp."""
    return [Write(0x6007, 0, 1), Write(0x605E, 0, 2), Write(0x605A, 0, 2)]


def limit_writes(file: DrivesFile, entry: DriveEntry) -> list[Write]:
    """Position limits, quick stop, following error, current."""
    # Pulled no further than the robot allows. Paid out a winch may be that unwound without power: it must come back.
    _, high, _ = file.ranges[file.drives.index(entry)]
    edges = [position_to_counts(edge, entry.scale) + HOMED_MARK for edge in (-file.limits.position, high)]
    window = abs(position_to_counts(file.following, entry.scale))
    return [
        Write(0x607D, 1, min(edges)),
        Write(0x607D, 2, max(edges)),
        Write(0x6083, 0, _acceleration(file.quick_stop, entry, file.profile)),
        Write(0x6085, 0, _acceleration(file.quick_stop, entry, file.profile)),
        Write(0x6065, 0, window),
        Write(0x6066, 0, _FOLLOWING_TIME),
        current_write(entry.current_limit, entry, file.profile),
    ]


def guarding_writes(file: DrivesFile, kind: str, master: int, has: frozenset[int] = _ANY_GUARDING) -> list[Write]:
    """Life guarding, or heartbeat both ways; the other is switched off in a drive that `has` its objects."""
    if kind == "life":
        period = max(1, round(1000.0 * file.guarding.time / 5.0))
        off, on = [(0x1017, 0)], [(0x100C, 0, period), (0x100D, 0, 5)]
    else:
        milliseconds = round(1000.0 * file.guarding.time)
        off, on = [(0x100C, 0), (0x100D, 0)], [(0x1017, 0, max(10, milliseconds // 2))]
        on.append((0x1016, 1, (master << 16) | milliseconds))
    values = [(index, subindex, 0) for index, subindex in off if index in has] + on
    return [Write(index, subindex, value) for index, subindex, value in values]


def disarm_writes(kind: str) -> list[Write]:
    """The end of guarding, so that a drive that is left alone does not fault."""
    if kind == "life":
        return [Write(0x100C, 0, 0), Write(0x100D, 0, 0)]
    return [Write(0x1016, 1, 0), Write(0x1017, 0, 0)]


def pdo_writes(entry: DriveEntry, profile: str) -> list[Write]:
    """RPDO 1: control word, target; TPDO 1: status word, position, current; both with each SYNC."""
    node = entry.node
    current = _CURRENT[profile] << 16 | 0x0010
    disabled = 0x80000000
    return [
        Write(0x1400, 1, disabled | 0x200 + node),
        Write(0x1600, 0, 0),
        Write(0x1600, 1, 0x60400010),
        Write(0x1600, 2, 0x607A0020),
        Write(0x1600, 0, 2),
        Write(0x1400, 2, 1),
        Write(0x1400, 1, 0x200 + node),
        Write(0x1800, 1, disabled | 0x180 + node),
        Write(0x1A00, 0, 0),
        Write(0x1A00, 1, 0x60410010),
        Write(0x1A00, 2, 0x60640020),
        Write(0x1A00, 3, current),
        Write(0x1A00, 0, 3),
        Write(0x1800, 2, 1),
        Write(0x1800, 1, 0x180 + node),
    ]


def mode_writes(file: DrivesFile) -> list[Write]:
    """Cyclic synchronous position with the bus period as interpolation period."""
    exponent, period = -3, file.cycle * 1e3
    if abs(period - round(period)) > 1e-6:
        exponent, period = -4, file.cycle * 1e4
    return [Write(0x60C2, 1, round(period)), Write(0x60C2, 2, exponent), Write(0x6060, 0, CSP)]
