"""Restrictions by which simulated drives can differ from the most permissive ones; all off by default.

Which of them a real drive has is only known on hardware; the master must work with any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from softneck.core import SettingsError, make_settings, require_between, require_one_of, require_whole, toml_value

from ._sdo import WRONG_STATE, WRONG_VALUE

# The object of the mode, and those that may be write-only: control word, mode, homing method, interpolation period,
# target speed.
_MODE_OBJECT = 0x6060
NOT_TOLD = frozenset({0x6040, _MODE_OBJECT, 0x6098, 0x60C2, 0x60FF})
# Objects that a run needs, so that no drive may lack them.
_NEEDED = frozenset({0x1000, 0x1018, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6040, 0x6041, _MODE_OBJECT, 0x6064, 0x607A})
_KNOWN_MODES = (1, 3, 6, 8)


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveQuirks:
    """Restrictions of simulated drives; 0 and False are off.

    Attributes:
        sdo_latency: from an SDO request to its answer [s]; real drives take 1 to 50 ms.
        write_only: 6040h, 6060h, 6098h, 60C2h and 60FFh can be written and not read.
        mode_when: the mode (6060h) may be written "always", "off" (not in Operation Enabled) or "enabled" (only there).
        lacks: indices of objects that the drive does not have.
        twin: node number that a second device also has, 0 for none.
    """

    sdo_latency: float = 0.0
    write_only: bool = False
    mode_when: str = "always"
    lacks: tuple[int, ...] = ()
    twin: int = 0

    def __post_init__(self) -> None:
        require_between("sdo_latency", self.sdo_latency, 0.0, 1.0, "s")
        require_one_of("mode_when", self.mode_when, ("always", "off", "enabled"))
        require_whole("twin", self.twin, 0, 126)
        if needed := sorted(_NEEDED.intersection(self.lacks)):
            raise SettingsError(f"`lacks` may not hold {needed[0]:04X}h: every drive has it.")

    def unwritable(self, index: int, value: int, *, enabled: bool) -> int:
        """Return the SDO abort code for writing a value to an object, or 0 if it is accepted."""
        if index != _MODE_OBJECT:
            return 0
        if value not in _KNOWN_MODES:
            return WRONG_VALUE
        return WRONG_STATE if self.mode_when == ("off" if enabled else "enabled") else 0


def quirks_of(texts: Sequence[str]) -> DriveQuirks:
    """Return the quirks of texts NAME=VALUE, with values as in TOML: `sdo_latency=0.05`, `lacks=[0x1003]`.

    Raises SettingsError: an unknown quirk, or a value of another type.
    """
    named = ((name, toml_value(value)) for name, _, value in (text.partition("=") for text in texts))
    return make_settings(DriveQuirks, {name: tuple(v) if isinstance(v, list) else v for name, v in named})
