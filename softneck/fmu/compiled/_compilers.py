"""C compilers: the one of this machine, and zig, which compiles for all platforms."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from softneck.core import SettingsError

from ._platforms import Platform
from ._sources import FLAGS, MAIN, Sources

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
