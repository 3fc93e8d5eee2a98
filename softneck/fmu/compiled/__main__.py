"""`python -m softneck.fmu.compiled`: cross-compile the library for all platforms; `make native` calls it."""

from __future__ import annotations

import sys

from softneck.core import SoftneckError

from ._library import BINARIES, SENSITIVE, build_all, packaged_library
from .translate._kinds import LIBRARIES


def main() -> int:
    """Build all libraries and print their sizes; 2 where that fails."""
    for folder in (BINARIES, SENSITIVE):
        try:
            library = build_all(folder, sensitivities=folder == SENSITIVE)
        except SoftneckError as error:
            sys.stderr.write(f"{error}\n")
            return 2
        for name, data in library.binaries.items():
            sys.stdout.write(f"{name}: {len(data) / 1e3:.0f} kB\n")
        for part, held in LIBRARIES.items():
            found = packaged_library(folder, set(held))
            kilobytes = sum(map(len, found.streams.values())) / 1e3 if found else 0.0
            sys.stdout.write(f"{part}: {kilobytes:.0f} kB for all platforms, deflated\n")
        for module, reason in library.sources.refused.items():
            sys.stdout.write(f"left out: {module}: {reason}\n")
        sys.stdout.write(f"{folder}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
