"""The two kinds of simulated drives: their objects (`objects.csv`, types as in `struct`), and further differences.

`ipos2015` follows Technosoft's manual P091.063 (2015); `ds402` is a drive after CiA 301/402 with heartbeat consumer.
Neither has been compared with a real drive.
"""

from __future__ import annotations

import csv
import functools
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

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
        rated_current: [A], for 6073h and 6078h; 0 if currents are in internal units.
        types: peak current [A] -> type of the drive, as in 1008h.
        products: type -> product code (1018h), if public.
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
        """Return the type of a drive with that peak current [A]; the text of 1008h if there is only one type."""
        return self.types.get(peak_current, self.items[(0x1008, 0)].text)


@functools.cache
def _objects(profile: str) -> dict[Key, Item]:
    """Return the objects of a profile; COB-IDs are those of node 0, to which a drive adds its number."""
    items: dict[Key, Item] = {}
    with Path(__file__).with_name("objects.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            value, kind, key = row[profile], row["type"], (int(row["index"], 16), int(row["subindex"]))
            if kind == "text":
                items[key] = Item(size=0, writable=False, text=value)
            elif value:  # else drives of this profile lack it
                items[key] = Item(int(value, 0), struct.calcsize(kind), kind.islower(), row["access"] == "rw")
    return items


def ipos2015() -> Profile:
    """Return the iPOS of the 2015 manual: life guarding only, currents in internal units."""
    types = {10.0: "iPOS3604 MX-CAN (simulated)", 20.0: "iPOS4808 MX-CAN (simulated)"}
    return Profile("ipos2015", _objects("ipos2015"), types=types, products={types[20.0]: 27014101})


def ds402() -> Profile:
    """Return a drive after CiA 301 and 402: heartbeat both ways, speeds in counts per second."""
    return Profile(
        "ds402", _objects("ds402"), heartbeat_consumer=True, late_mode_display=False, rated_current=0.060,
        units_per_count=1.0,
    )  # fmt: skip


PROFILES = {"ipos2015": ipos2015, "ds402": ds402}
