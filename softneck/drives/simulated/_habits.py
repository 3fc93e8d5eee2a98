"""How simulated drives and their wire differ from the most obliging ones: each habit by itself, all off by default.

What of it a real drive has nobody knows before hardware is there; a master has to live with any of it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from softneck.core import SettingsError, require_between, require_one_of, require_whole

from ._sdo import NO_SUBINDEX, WRITE_ONLY, WRONG_STATE, WRONG_VALUE

# The object of the mode, and those that a drive may take and not tell: control word, mode, homing method,
# interpolation period, target speed.
_MODE = 0x6060
_NOT_TOLD = frozenset({0x6040, _MODE, 0x6098, 0x60C2, 0x60FF})
# What a run needs, and so no drive can lack.
_NEEDED = frozenset({0x1000, 0x1018, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6040, 0x6041, _MODE, 0x6064, 0x607A})
_PLAIN_TYPES = (1, 255)


@dataclass(frozen=True, slots=True, kw_only=True)
class WireHabits:
    """How strict simulated drives and their wire are; 0 and False are off.

    Attributes:
        sdo_latency: from an SDO request to its answer [s]; drives that are at work take 1 to 50 ms.
        queue: frames that a drive's controller holds; what comes when it is full is lost, and told by EMCY 8110h.
        bitrate: of the wire [bit/s]; the lowest identifier goes first.
        plain_sdo: no segmented download and no block transfer.
        one_abort: each refusal has the code 08000000h, which tells nothing.
        write_only: 6040h, 6060h, 6098h, 60C2h and 60FFh can be written and not read.
        mode_when: the mode (6060h) may be written "always", "off" (not in Operation Enabled) or "enabled" (only there).
        modes: that the drive has; 7 (PT and PVT) among them holds the motor.
        plain_pdo: of TPDO types 1 and 255 only, without timers, and no remote request is answered.
        lacks: indices of objects that the drive does not have.
        twin: number of a second device that answers there, 0 for none.
    """

    sdo_latency: float = 0.0
    queue: int = 0
    bitrate: float = 0.0
    plain_sdo: bool = False
    one_abort: bool = False
    write_only: bool = False
    mode_when: str = "always"
    modes: tuple[int, ...] = (1, 3, 6, 8)
    plain_pdo: bool = False
    lacks: tuple[int, ...] = ()
    twin: int = 0

    def __post_init__(self) -> None:
        require_between("sdo_latency", self.sdo_latency, 0.0, 1.0, "s")
        require_whole("queue", self.queue, 0, 1000)
        require_between("bitrate", self.bitrate, 0.0, 1e6, "bit/s")
        require_one_of("mode_when", self.mode_when, ("always", "off", "enabled"))
        require_whole("twin", self.twin, 0, 126)
        if needed := sorted(_NEEDED.intersection(self.lacks)):
            raise SettingsError(f"`lacks` may not hold {needed[0]:04X}h: a drive without it is none.")

    @property
    def on_wire(self) -> bool:
        """Whether frames do not just come out when they went in."""
        return bool(self.sdo_latency or self.queue or self.bitrate)

    def unreadable(self, index: int) -> int:
        """Return why an object cannot be read, an SDO abort code, or 0."""
        return WRITE_ONLY if self.write_only and index in _NOT_TOLD else 0

    def unwritable(self, index: int, subindex: int, value: int, *, enabled: bool) -> int:
        """Return why an object does not take a value, an SDO abort code, or 0."""
        if index == _MODE:
            if value not in self.modes:
                return WRONG_VALUE
            return WRONG_STATE if self.mode_when == ("off" if enabled else "enabled") else 0
        if self.plain_pdo and 0x1800 <= index < 0x1A00:
            if subindex > 2:
                return NO_SUBINDEX
            return WRONG_VALUE if subindex == 2 and value not in _PLAIN_TYPES else 0
        return 0


def habits_of(texts: Sequence[str]) -> WireHabits:
    """Return the habits that NAME=VALUE set, with values as in TOML: `queue=4`, `mode_when="off"`, `lacks=[0x1003]`.

    Raises:
        SettingsError: no such habit, or another kind of value.
    """
    defaults = {field.name: field.default for field in fields(WireHabits)}
    given: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        require_one_of("habit", name, tuple(defaults))
        try:
            told = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            told = value  # a word without quotes
        told = tuple(told) if isinstance(told, list) else told
        told = float(told) if isinstance(defaults[name], float) and type(told) is int else told
        if type(told) is not type(defaults[name]):
            raise SettingsError(f"`{name}` takes a value such as {defaults[name]}; got `{value}`.")
        given[name] = told
    return WireHabits(**given)
