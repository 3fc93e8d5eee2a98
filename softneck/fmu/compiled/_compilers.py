"""Platforms and C compilers: the compiler of this machine, and zig, which compiles for all platforms."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from softneck.core import SettingsError

from ._sources import FLAGS, MAIN, Sources


@dataclass(frozen=True, slots=True)
class Platform:
    """A platform: operating system and processor.

    Attributes:
        name: as users type it; also FMI 3's folder name.
        fmi2: FMI 2's folder name; "" if FMI 2 has none.
        suffix: of the library.
        target: zig's name; glibc 2.17 is of 2012, macOS 11 of 2020, the first for Apple's own processors.
        system, machines: Python's names.
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


def this_platform() -> Platform | None:
    """Return the platform that this Python runs on, or None for one that is not in the table."""
    machine = platform.machine().lower()
    for entry in PLATFORMS.values():
        if sys.platform == entry.system and machine in entry.machines:
            return entry
    return None


# Limit of processor time, which a busy machine does not lengthen. A library takes one minute.
_MOST_SECONDS = 600


def local_compiler() -> list[str] | None:
    """Return the command of this machine's C compiler ($CC, cc, gcc or clang), or None."""
    stated = shlex.split(os.environ.get("CC", ""))
    for command in [stated] if stated else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]) is not None:
            return command
    return None


def have_zig() -> bool:
    """Return whether the package `ziglang` is installed."""
    return find_spec("ziglang") is not None


def compile_here(sources: Sources, compiler: list[str]) -> bytes:
    """Compile the library for this machine with its own compiler."""
    suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    extra = [] if sys.platform == "win32" else ["-fPIC"]
    strip = [] if sys.platform == "darwin" else ["-s", "-Wl,--gc-sections"]
    # -O3 makes the library larger and faster; with one platform the size does not matter.
    return _compile(sources, [*compiler, *FLAGS, "-O3", *extra, *strip], suffix)


def compile_for(sources: Sources, platform: Platform) -> bytes:
    """Cross-compile the library for any platform with zig.

    Raises SettingsError: zig is not installed, or rejects the sources.
    """
    if not have_zig():
        raise SettingsError("zig is not installed; install it with `pip install ziglang`.")
    extra = [] if platform.system == "win32" else ["-fPIC"]
    # Remove local symbols, which zig's linker for macOS would keep.
    gather = ["-Wl,-x"] if platform.system == "darwin" else ["-Wl,--gc-sections"]
    gather += ["-Wl,--hash-style=gnu"] if platform.system == "linux" else []
    # -O2, except for functions marked `SN_SMALL`. Vectorised pairs (SLP) wait for numbers that were stored one by one,
    # and the neck's step takes 5 % longer. Code shortened by aarch64's outliner compresses worse.
    small = ["-fno-slp-vectorize", "-fno-sanitize=undefined", "-w", "-s", "-mllvm", "-enable-machine-outliner=never"]
    # Intel Macs: 5 kB less, but a step of predictive control or the observer takes 1.5 times as long.
    hint = 10 if platform.name == "x86_64-darwin" else 60
    small += ["-mllvm", "-inline-threshold=0", "-mllvm", f"-inlinehint-threshold={hint}"]
    # No exceptions pass through C, so unwind tables are left out; on Windows zig's own code needs them.
    windows = ["-rtlib=none", "-DSN_OWN_PROBE"]
    small += windows if platform.system == "win32" else ["-fno-asynchronous-unwind-tables", "-fno-unwind-tables"]
    command = [sys.executable, "-m", "ziglang", "cc", "-target", platform.target, *FLAGS, *small, *extra, *gather]
    return _compile(sources, command, platform.suffix)


def _compile(sources: Sources, command: list[str], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory(prefix="softneck-native-") as name:
        folder = Path(name)
        for file, text in sources.files.items():
            (folder / file).write_text(text, encoding="utf-8")
        library = folder / f"softneck{suffix}"
        full = [*command, "-shared", "-o", library.name, MAIN]
        # A library that contains the temporary folder's name would have other bytes each time.
        full += [] if suffix == ".dll" else ["-lm"]
        environment = os.environ | {"SOURCE_DATE_EPOCH": "315532800"}
        try:
            done = subprocess.run(
                full, cwd=folder, env=environment, capture_output=True, text=True, check=False,
                preexec_fn=None if sys.platform == "win32" else _limit_time,
            )  # fmt: skip
        except OSError as error:
            raise SettingsError(f"`{command[0]}` could not compile the FMU library: {error}.") from error
        if done.returncode != 0 or not library.is_file():
            first = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip()[:200])
            first = first or f"exit code {done.returncode}; each process may take {_MOST_SECONDS} s of processor time."
            raise SettingsError(f"`{shlex.join(command[:4])} ...` could not compile the FMU library: {first}")
        return library.read_bytes()


def _limit_time() -> None:
    import resource  # not on Windows

    resource.setrlimit(resource.RLIMIT_CPU, (_MOST_SECONDS, _MOST_SECONDS))
