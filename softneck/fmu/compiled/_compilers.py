"""Platforms and C compilers: the one of this machine, and zig, which compiles for all platforms."""

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


# Of processor time: a busy machine may take its time. A library takes one minute.
_MOST_SECONDS = 600


def local_compiler() -> list[str] | None:
    """Return the command of this machine's C compiler ($CC, cc, gcc or clang), or None."""
    stated = shlex.split(os.environ.get("CC", ""))
    for command in [stated] if stated else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]) is not None:
            return command
    return None


def have_zig() -> bool:
    """Return whether the package `ziglang` is here."""
    return find_spec("ziglang") is not None


def compile_here(sources: Sources, compiler: list[str]) -> bytes:
    """Return the library of this machine, made by its own compiler."""
    suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    extra = [] if sys.platform == "win32" else ["-fPIC"]
    strip = [] if sys.platform == "darwin" else ["-s", "-Wl,--gc-sections"]
    # Larger and faster: one library weighs little where five are too many.
    return _compiled(sources, [*compiler, *FLAGS, "-O3", *extra, *strip], suffix)


def compile_for(sources: Sources, platform: Platform) -> bytes:
    """Return the library of any platform, made by zig.

    Raises:
        SettingsError: zig is not here, or refused the sources.
    """
    if not have_zig():
        raise SettingsError("zig is not installed; install it with `pip install ziglang`.")
    extra = [] if platform.system == "win32" else ["-fPIC"]
    # Names of what nobody calls from outside: zig's linker for macOS would keep them.
    gather = ["-Wl,-x"] if platform.system == "darwin" else ["-Wl,--gc-sections"]
    gather += ["-Wl,--hash-style=gnu"] if platform.system == "linux" else []
    # -O2, where `SN_SMALL` does not ask for short code. Two numbers side by side wait for what was stored one by one,
    # and the neck's step takes 5 % longer. Code that aarch64's outliner has shortened deflates worse.
    small = ["-fno-slp-vectorize", "-fno-sanitize=undefined", "-w", "-s", "-mllvm", "-enable-machine-outliner=never"]
    # Macs with Intel processors: 5 kB less; a step of predictive control or the observer takes half as long again.
    hint = 10 if platform.name == "x86_64-darwin" else 60
    small += ["-mllvm", "-inline-threshold=0", "-mllvm", f"-inlinehint-threshold={hint}"]
    # Nothing is thrown through C. Windows asks for the tables, and zig's own parts there need them.
    windows = ["-rtlib=none", "-DSN_OWN_PROBE"]
    small += windows if platform.system == "win32" else ["-fno-asynchronous-unwind-tables", "-fno-unwind-tables"]
    command = [sys.executable, "-m", "ziglang", "cc", "-target", platform.target, *FLAGS, *small, *extra, *gather]
    return _compiled(sources, command, platform.suffix)


def _compiled(sources: Sources, command: list[str], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory(prefix="softneck-native-") as name:
        folder = Path(name)
        for file, text in sources.files.items():
            (folder / file).write_text(text, encoding="utf-8")
        library = folder / f"softneck{suffix}"
        full = [*command, "-shared", "-o", library.name, MAIN]
        # A library that names the temporary folder would have other bytes each time.
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
