"""Compiled libraries of the platforms: built by `make native`, else compiled on this machine.

`make native` writes `binaries/`: for each platform a library of all kinds and one of each part of them, the generated
source, and a manifest with the digest of all inputs. A wheel contains that folder, so that exporting needs no compiler.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import platformdirs

from softneck.core import FileFormatError, SettingsError, atomic_write

from ..python._zip import deflate
from ._compilers import PLATFORMS, compile_for, compile_here, have_zig, local_compiler, this_platform
from ._sources import GENERATED, HERE, Sources, c_sources, sources_key
from .translate._kinds import LIBRARIES, RUNTIMES
from .translate._translate import select_kinds

BINARIES = HERE / "binaries"
# With the derivatives of the kinds' steps: 1.5 times as large, so only for FMUs with sensitivities.
SENSITIVE = BINARIES / "sensitivities"
_MANIFEST_FILE = "manifest.json"
_PROGRESS_FILE = "begun.json"  # state of an interrupted `make native`


@dataclass(frozen=True, slots=True)
class Library:
    """Libraries with their sources.

    `binaries`: platform -> bytes. `sources`: all C sources. `origin`: one line on how they were compiled. `streams`:
    bytes -> the deflated bytes, if already known.
    """

    binaries: dict[str, bytes]
    sources: Sources
    origin: str
    streams: dict[bytes, bytes] = field(default_factory=dict)


def find_library(modules: set[str] | None = None, *, sensitivities: bool = False) -> Library:
    """Return the available libraries; if there are none, compile the part with these modules for this machine.

    `modules`: that it must contain; modules for robots of other sizes than the neck are compiled for this machine.
    `sensitivities`: with the derivatives of the kinds' steps. Raises FileFormatError: a library is damaged;
    SettingsError: there is no library, no C compiler and no zig.
    """
    if modules and not modules <= set(RUNTIMES):
        return _local_library(tuple(sorted(modules)), sensitivities=sensitivities)
    if sensitivities:
        local = tuple(sorted(modules or RUNTIMES))
        return packaged_library(SENSITIVE, modules) or _local_library(local, sensitivities=True)
    part = _part(modules)
    return packaged_library(BINARIES, modules) or _local_library(tuple(sorted(LIBRARIES[part])) if part else RUNTIMES)


def packaged_library(folder: Path = BINARIES, modules: set[str] | None = None) -> Library | None:
    """Return the libraries that `make native` built, or None if there are none for the present sources.

    `folder`: of the libraries. `modules`: that it must contain: the first part with all of them is returned; the whole
    if None or no part has. Raises FileFormatError: a file is damaged.
    """
    manifest = _manifest(folder)
    if manifest is None or manifest["key"] != sources_key(sensitivities=folder == SENSITIVE):
        return None
    return _read(folder, manifest, _part(modules))


def _part(modules: set[str] | None) -> str:
    """Return the name of the part with these modules; "" for the whole."""
    return next((part for part, held in LIBRARIES.items() if modules and modules <= held), "")


def _read(folder: Path, manifest: dict, part: str = "") -> Library:
    content: dict[str, bytes] = {}
    packed_names = {name: _file_name(name, part) for name in manifest["platforms"]}
    for name in (*packed_names.values(), GENERATED):
        digest = manifest["files"].get(name, "")
        path = folder / name
        data = path.read_bytes() if path.is_file() else b""
        if hashlib.sha256(data).hexdigest() != digest:
            raise FileFormatError(f"{path}: is damaged or missing; run `make native`, or install softneck again.")
        content[name] = data
    files = {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / "c").glob("*.[ch]"))}
    files[GENERATED] = content[GENERATED].decode()
    packed = {name: content[file] for name, file in packed_names.items()}
    binaries = {name: zlib.decompress(data, -zlib.MAX_WBITS) for name, data in packed.items()}
    streams = {binaries[name]: data for name, data in packed.items()}
    return Library(binaries, Sources(files, manifest["refused"]), "built with this softneck", streams)


def _file_name(platform: str, part: str = "") -> str:
    return f"{platform}{part and '-'}{part}{PLATFORMS[platform].suffix}.deflate"


def platforms_built() -> tuple[list[str], str]:
    """Return the platforms for which an FMU can be exported now, and their origin, without compiling."""
    manifest = _manifest(BINARIES)
    if manifest is not None and manifest["key"] == sources_key():
        return list(manifest["platforms"]), "built with this softneck"
    stale = "; those in binaries/ are of other sources, run `make native`" if manifest is not None else ""
    machine, compiler = this_platform(), local_compiler()
    if machine is None or (compiler is None and not have_zig()):
        return [], f"none is built and there is no C compiler{stale}"
    return [machine.name], f"by {compiler[0] if compiler else 'zig'} at the first export{stale}"


def build_all(folder: Path = BINARIES, *, sensitivities: bool = False) -> Library:
    """Cross-compile for all platforms with zig and write them to `folder`: `make native`.

    Each library is saved when it is done: after an interruption the next call continues with the missing ones.
    """
    sources, key = c_sources(sensitivities=sensitivities), sources_key(sensitivities=sensitivities)
    folder.mkdir(parents=True, exist_ok=True)
    digests = _finished_files(folder, key)
    for part, name in product(("", *LIBRARIES), PLATFORMS):
        if (file := _file_name(name, part)) not in digests:
            _write(folder, file, _deflate(compile_for(_select_part(sources, part), PLATFORMS[name])), digests)
            (folder / _PROGRESS_FILE).write_text(json.dumps({"key": key, "files": digests}), encoding="utf-8")
    _write(folder, GENERATED, sources.files[GENERATED].encode(), digests)
    manifest = {"key": key, "platforms": list(PLATFORMS), "files": digests, "refused": sources.refused}
    for path in folder.iterdir():  # of another version
        if path.name not in digests and path.is_file():
            path.unlink()
    (folder / _MANIFEST_FILE).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return _read(folder, manifest)


def _select_part(sources: Sources, part: str) -> Sources:
    if not part:
        return sources
    return replace(sources, files=sources.files | {GENERATED: select_kinds(sources.files[GENERATED], LIBRARIES[part])})


def _write(folder: Path, name: str, data: bytes, digests: dict[str, str]) -> None:
    with atomic_write(folder / name, force=True) as temporary:
        temporary.write_bytes(data)
    digests[name] = hashlib.sha256(data).hexdigest()


def _finished_files(folder: Path, key: str) -> dict[str, str]:
    """Return the files with their digests that an interrupted call completed for the same sources."""
    try:
        begun = json.loads((folder / _PROGRESS_FILE).read_text(encoding="utf-8"))
        files = begun["files"] if begun["key"] == key else {}
        return {n: d for n, d in files.items() if hashlib.sha256((folder / n).read_bytes()).hexdigest() == d}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _deflate(data: bytes) -> bytes:
    """Return a deflate stream; zopfli takes a second for a library and makes every FMU 4 % smaller."""
    if find_spec("zopfli") is None:
        return deflate(data)
    from zopfli import zlib as zopfli  # pyright: ignore[reportMissingImports]  (of the group native alone)

    return zopfli.compress(data)[2:-4]  # without zlib's head and checksum


def _local_library(modules: tuple[str, ...] = RUNTIMES, *, sensitivities: bool = False) -> Library:
    """Return the library of this machine: from the user's cache, or compiled now."""
    machine, compiler = this_platform(), local_compiler()
    if machine is None or (compiler is None and not have_zig()):
        raise SettingsError(
            "there is no compiled library here and no C compiler to make one; run `make native` (it needs "
            "`pip install ziglang`), install a C compiler, or use `--backend python`."
        )
    folder = _cache_folder() / sources_key(modules, sensitivities=sensitivities)
    library, generated, refused = folder / f"library{machine.suffix}", folder / GENERATED, folder / "refused.json"
    if not refused.is_file():
        sources = c_sources(modules, sensitivities=sensitivities)
        folder.mkdir(parents=True, exist_ok=True)
        # The last file marks that all are complete.
        for path, data in (
            (library, compile_here(sources, compiler) if compiler else compile_for(sources, machine)),
            (generated, sources.files[GENERATED].encode()),
            (refused, json.dumps(sources.refused).encode()),
        ):
            with atomic_write(path, force=True) as temporary:
                temporary.write_bytes(data)
    files = {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / "c").glob("*.[ch]"))}
    files[GENERATED] = generated.read_text(encoding="utf-8")
    sources = Sources(files, json.loads(refused.read_text(encoding="utf-8")))
    origin = f"compiled by {compiler[0] if compiler else 'zig'} for this machine alone ({machine.name})"
    ours = set(modules) <= set(RUNTIMES)
    origin += "; `make native` builds all platforms" if ours else ", as the robot's sizes are its own"
    return Library({machine.name: library.read_bytes()}, sources, origin)


def _cache_folder() -> Path:
    return Path(platformdirs.user_cache_dir("softneck", appauthor=False)) / "native"


def _manifest(folder: Path) -> dict | None:
    path = folder / _MANIFEST_FILE
    if not path.is_file():
        return None
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if {"key", "platforms", "files", "refused"} <= manifest.keys() and set(manifest["platforms"]) <= set(PLATFORMS):
            return manifest
    except (ValueError, AttributeError, TypeError):
        pass
    raise FileFormatError(f"{path}: is damaged; run `make native`, or install softneck again.")
