"""What the two kinds of simulated drive have: object lists with start values, and where they differ.

`ipos2015` follows Technosoft's manual P091.063 (2015) as far as the facts of this project quote it; `ds402` is a
drive after CiA 301/402 with heartbeat consumer. No real drive was at hand to compare.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Key = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Item:
    """One entry of the object list.

    Attributes:
        start: value after a reset.
        size: bytes; 0 for a text.
        signed: two's complement.
        writable: by SDO.
        text: of a text entry.
    """

    start: int = 0
    size: int = 4
    signed: bool = False
    writable: bool = True
    text: str = ""


@dataclass(frozen=True, slots=True)
class Profile:
    """One kind of drive.

    Attributes:
        name: "ipos2015" or "ds402".
        items: object list with start values.
        heartbeat_consumer: has 1016h.
        late_mode_display: 6061h shows 8 only in Operation Enabled.
        rated_current: [A], for 6073h and 6078h; 0 where currents are in internal units.
        types: peak current [A] -> type of such a drive, as 1008h tells it.
        products: type -> product code (1018h), of those that are public.
        units_per_count: internal speed units for one count per second; None: 65536 per slow-loop sample.
    """

    name: str
    items: Mapping[Key, Item] = field(default_factory=dict)
    heartbeat_consumer: bool = False
    late_mode_display: bool = True
    rated_current: float = 0.0
    units_per_count: float | None = None
    types: Mapping[float, str] = field(default_factory=dict)
    products: Mapping[str, int] = field(default_factory=dict)

    def name_of(self, peak_current: float) -> str:
        """Return the type of a drive with that peak current [A]; the text of 1008h where there is only one."""
        return self.types.get(peak_current, self.items[(0x1008, 0)].text)


def _ro(start: int, size: int = 4, *, signed: bool = False) -> Item:
    return Item(start, size, signed, writable=False)


def _common() -> dict[Key, Item]:
    items: dict[Key, Item] = {
        (0x1000, 0): _ro(0x00020192),
        (0x1001, 0): _ro(0, 1),
        # Of the errors so far the newest first; their count may be written, and 0 alone: it clears them.
        (0x1003, 0): Item(0, 1),
        (0x1003, 1): _ro(0),
        (0x1003, 2): _ro(0),
        (0x1005, 0): Item(0x80),
        (0x100C, 0): Item(0, 2),
        (0x100D, 0): Item(0, 1),
        (0x1014, 0): Item(0x80),
        (0x1017, 0): Item(0, 2),
        (0x1018, 0): _ro(4, 1),
        (0x1018, 1): _ro(0x000001A3),
        (0x1018, 2): _ro(0),
        (0x1018, 3): _ro(0x00010001),
        (0x1018, 4): _ro(0),
        (0x1200, 0): _ro(2, 1),
        (0x1200, 1): _ro(0x600),
        (0x1200, 2): _ro(0x580),
        (0x6007, 0): Item(0, 2, signed=True),
        (0x603F, 0): _ro(0, 2),
        (0x6040, 0): Item(0, 2),
        (0x6041, 0): _ro(0, 2),
        (0x605A, 0): Item(2, 2, signed=True),
        (0x605E, 0): Item(2, 2, signed=True),
        (0x6060, 0): Item(0, 1, signed=True),
        (0x6061, 0): _ro(0, 1, signed=True),
        (0x6064, 0): _ro(0, 4, signed=True),
        (0x6065, 0): Item(0, 4),
        (0x6066, 0): Item(0, 2),
        (0x606C, 0): _ro(0, 4, signed=True),
        (0x607A, 0): Item(0, 4, signed=True),
        (0x607C, 0): Item(0, 4, signed=True),
        (0x607D, 0): _ro(2, 1),
        (0x607D, 1): Item(-(2**31), 4, signed=True),
        (0x607D, 2): Item(2**31 - 1, 4, signed=True),
        (0x6081, 0): Item(0, 4),
        (0x6083, 0): Item(0, 4),
        (0x6085, 0): Item(0, 4),
        (0x6093, 0): _ro(2, 1),
        (0x6093, 1): Item(1),
        (0x6093, 2): Item(1),
        (0x6094, 0): _ro(2, 1),
        (0x6094, 1): Item(1),
        (0x6094, 2): Item(1),
        (0x6097, 0): _ro(2, 1),
        (0x6097, 1): Item(1),
        (0x6097, 2): Item(1),
        (0x6098, 0): Item(0, 1, signed=True),
        (0x60B8, 0): Item(0, 2),
        (0x60B9, 0): _ro(0, 2),
        (0x60BA, 0): _ro(0, 4, signed=True),
        (0x60C2, 0): _ro(2, 1),
        (0x60C2, 1): Item(1, 1),
        (0x60C2, 2): Item(-3, 1, signed=True),
        (0x60FF, 0): Item(0, 4, signed=True),
    }
    for n in range(4):
        items |= _pdo(0x1400 + n, 0x1600 + n, ((0x200, 0x300, 0x400, 0x500)[n]) | 0x80000000)
        items |= _pdo(0x1800 + n, 0x1A00 + n, ((0x180, 0x280, 0x380, 0x480)[n]) | 0x80000000)
    return items


def _pdo(communication: int, mapping: int, identifier: int) -> dict[Key, Item]:
    """Return one PDO's entries; the node's number is added to the identifier when the drive starts."""
    items = {
        (communication, 0): _ro(2, 1),
        (communication, 1): Item(identifier),
        (communication, 2): Item(255, 1),
        (mapping, 0): Item(0, 1),
    }
    return items | {(mapping, i): Item(0) for i in range(1, 5)}


def ipos2015() -> Profile:
    """Return the iPOS of the 2015 manual: life guarding only, currents in internal units."""
    items = _common() | {
        (0x1008, 0): Item(text="CiA 402 drive (simulated)", size=0, writable=False),
        (0x100A, 0): Item(text="F514I", size=0, writable=False),
        # Motion and detailed error register.
        (0x2000, 0): _ro(0, 2),
        (0x2002, 0): _ro(0, 2),
        (0x207E, 0): _ro(0, 2, signed=True),
        (0x207F, 0): Item(0, 2),
        # The default of the manual: no bit for the cyclic mode (bit 7), though the drive has it.
        (0x6502, 0): _ro(0x001F0065),
    }
    types = {10.0: "iPOS3604 MX-CAN (simulated)", 20.0: "iPOS4808 MX-CAN (simulated)"}
    return Profile("ipos2015", items, types=types, products={types[20.0]: 27014101})


def ds402() -> Profile:
    """Return a drive after CiA 301 and 402: heartbeat both ways, speeds in counts per second."""
    items = _common() | {
        (0x1008, 0): Item(text="DS402 drive (simulated)", size=0, writable=False),
        (0x100A, 0): Item(text="1.0", size=0, writable=False),
        (0x1016, 0): _ro(1, 1),
        (0x1016, 1): Item(0),
        (0x1029, 0): _ro(1, 1),
        (0x1029, 1): Item(0, 1),
        (0x6073, 0): Item(1000, 2),
        (0x6075, 0): Item(60),
        (0x6078, 0): _ro(0, 2, signed=True),
        (0x6502, 0): _ro(0x000000A5),
    }
    return Profile(
        "ds402", items, heartbeat_consumer=True, late_mode_display=False, rated_current=0.060, units_per_count=1.0
    )


PROFILES = {"ipos2015": ipos2015, "ds402": ds402}
