"""The platforms: how FMI names them, what their libraries are called, what zig calls them."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Platform:
    """One kind of machine.

    Attributes:
        name: what users type, and FMI 3's name of the folder.
        fmi2: FMI 2's name of the folder; "" where that version has none.
        suffix: of the library.
        target: zig's name; glibc 2.17 is of 2012, macOS 11 of 2020, the first for Apple's own processors.
        system, machines: what Python calls it.
    """

    name: str
    fmi2: str
    suffix: str
    target: str
    system: str
    machines: tuple[str, ...]


PLATFORMS = {
    entry.name: entry
    for entry in (
        Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17", "linux", ("x86_64", "amd64")),
        Platform("aarch64-linux", "", ".so", "aarch64-linux-gnu.2.17", "linux", ("aarch64", "arm64")),
        Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu", "win32", ("x86_64", "amd64")),
        Platform("x86_64-darwin", "darwin64", ".dylib", "x86_64-macos.11.0", "darwin", ("x86_64", "amd64")),
        Platform("aarch64-darwin", "", ".dylib", "aarch64-macos.11.0", "darwin", ("aarch64", "arm64")),
    )
}


def here() -> Platform | None:
    """Return the platform that this Python runs on, or None for one that is not in the table."""
    machine = platform.machine().lower()
    for entry in PLATFORMS.values():
        if sys.platform == entry.system and machine in entry.machines:
            return entry
    return None
