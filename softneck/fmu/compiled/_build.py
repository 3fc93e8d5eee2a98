"""Export of a block as an FMU without Python: FMI 2.0 or 3.0, a library for each platform, the model as a resource."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softneck import __version__
from softneck.core import SettingsError, as_path, atomic_write, refuse_existing
from softneck.runtime import Block

from ..describe._describe import Buildable, FmuInfo, block_and_info, documentation_page
from ..describe._description import (
    NO_LOOK_AHEAD,
    Identity,
    LookAhead,
    exported_block,
    model_description,
    terminals_file,
    with_limit_outputs,
)
from ..python._build import check_block, generation_date, license_text, model_name
from ..python._zip import write_zip
from ._compilers import PLATFORMS
from ._library import Library, find_library
from ._look_ahead import look_ahead
from ._model_file import model_bytes, node_of
from ._sources import FLAGS, GENERATED, MAIN, PROBE, Sources
from .translate._translate import select_kinds

FMI_VERSIONS = (2, 3)
_HOST_NOTE = (
    "No requirements: no Python, no compiler, no library beyond those of the operating system. "
    "Setting a non-finite input is an error with a message, except NaN (`not measured`) where the table allows it."
)
_REBUILD_README = """Rebuild the library of this FMU for any platform with a C99 compiler, for instance

    cc {flags} -fPIC -shared -o {name}.so {main} -lm

and put it into binaries/ under the folder of your platform. `sn_kinds.h` was generated from the runtimes of softneck
{version} and holds what this model needs; all other files are written by hand. No fused multiply-add
(-ffp-contract=off), no fast-math: all platforms give the same bits.
"""


def build_compiled_fmu(
    thing: Buildable | Block | str | Path, path: str | Path, *, info: FmuInfo | None = None, force: bool = False,
    fmi: int = 2, platforms: Sequence[str] = (), sensitivities: bool = False,
) -> str:  # fmt: skip
    """Write `thing` as an FMU that needs no Python; return one line on the origin of its libraries.

    It has Co-Simulation and Model Exchange. Variables, timing and state are those of `build_fmu`. The same block, info
    and libraries give the same bytes.

    Args:
        thing: as for `build_fmu`.
        path: `NAME.fmu`; NAME becomes the model name.
        info: texts of the FMU; those of `fmu_info` if not given.
        force: replace an existing file.
        fmi: 2 or 3.
        platforms: on which the FMU must run, e.g. "x86_64-windows"; none: all with a library on this machine.
        sensitivities: add outputs of the next sample (`pitch_next`, ..), of a plant also those of a later one
            (`pitch_ahead`, ..), and their directional derivatives.

    Raises:
        SettingsError: NAME is not an FMI identifier, the kind cannot be compiled or has no derivative, or a platform
            is not built.
        FileFormatError: a library is damaged.
        OutputFileError: the file exists or cannot be written.
    """
    target = as_path(path)
    name = model_name(target)
    refuse_existing(target, force=force)
    block, said = block_and_info(thing, info)
    check_block(block)
    if fmi not in FMI_VERSIONS:
        raise SettingsError(f"unknown FMI version {fmi}; use 2 or 3.")
    block = exported_block(block)
    ports, looks = look_ahead(block) if sensitivities else ((), NO_LOOK_AHEAD)
    block = with_limit_outputs(block)  # the library's own parameter, which no runtime reads
    modules = node_of(block.runtime, block.arrays).modules
    library = find_library(modules, sensitivities=True) if ports else find_library(modules)
    for module in sorted(modules & library.sources.refused.keys()):
        why = library.sources.refused[module]
        raise SettingsError(f"`{module}` cannot be in a compiled FMU: {why} Use `--backend python`.")
    folders = _folders(library, platforms, fmi)
    block = replace(block, outputs=(*block.outputs, *ports))
    members = _members(block, said, name, fmi, library.sources, looks)
    members |= {f"binaries/{folder}/{name}{suffix}": data for folder, suffix, data in folders}
    with atomic_write(target, force=force) as temporary:
        write_zip(temporary, members, library.streams)
    return library.origin


def _folders(library: Library, wanted: Sequence[str], fmi: int) -> list[tuple[str, str, bytes]]:
    """Return (folder, suffix, bytes) of each library for the FMU."""
    for name in wanted:
        if name not in PLATFORMS:
            raise SettingsError(f"unknown platform `{name}`; use one of {', '.join(PLATFORMS)}.")
        if name not in library.binaries:
            raise SettingsError(
                f"the library for {name} is not built, only that for {', '.join(library.binaries)}; "
                "run `make native` in a source checkout, or install a wheel of softneck."
            )
        if fmi == 2 and not PLATFORMS[name].fmi2:
            raise SettingsError(f"FMI 2.0 has no folder for {name}; take `--fmi 3`.")
    found = []
    for name, data in library.binaries.items():
        platform = PLATFORMS[name]
        folder = platform.name if fmi == 3 else platform.fmi2
        if folder and (not wanted or name in wanted):
            found.append((folder, platform.suffix, data))
    if not found:
        raise SettingsError(f"FMI 2.0 has no folder for {', '.join(library.binaries)}; take `--fmi 3`.")
    return found


def _members(block: Block, info: FmuInfo, name: str, fmi: int, sources: Sources, looks: LookAhead) -> dict[str, bytes]:
    tool = f"softneck {__version__} (compiled)"
    content = hashlib.sha256()
    for part in (
        model_bytes(block, name, "", looks=looks),
        repr((info, tool, fmi, looks.inputs)).encode(),
        *map(str.encode, sources.files.values()),
    ):
        content.update(part)
    guid = str(uuid.uuid5(uuid.NAMESPACE_OID, content.hexdigest()))
    identity = Identity(name, guid, generation_date(), tool, (MAIN,), looks)
    members = {
        "modelDescription.xml": model_description(block, info, identity, fmi=fmi),
        "resources/model.bin": model_bytes(block, name, guid, looks=looks),
        "documentation/index.html": documentation_page(name, block, info, _HOST_NOTE).encode(),
        "documentation/licenses/license.txt": license_text("softneck", info.license).encode(),
        "sources/README.txt": _REBUILD_README.format(
            flags=" ".join(FLAGS), name=name, main=MAIN, version=__version__
        ).encode(),
    }
    if fmi == 3:
        members["sources/buildDescription.xml"] = _build_description(name)
    members |= terminals_file(block)
    files = _needed_sources(sources, node_of(block.runtime, block.arrays).modules, fmi)
    return members | {f"sources/{file}": text.encode() for file, text in files.items()}


def _needed_sources(sources: Sources, modules: set[str], fmi: int) -> dict[str, str]:
    """Return only the sources for this model's kinds and FMI version: 40 kB less than the whole library."""
    other = f"fmi{5 - fmi}.h"
    files = {name: text for name, text in sources.files.items() if name not in (other, PROBE)}
    files[GENERATED] = select_kinds(files[GENERATED], modules)
    files[MAIN] = files[MAIN].replace(f'#include "{other}"\n', "")
    return files


def _build_description(name: str) -> bytes:
    """Return the build description of FMI 3 (section 2.5.2.1)."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    options = " ".join(flag for flag in FLAGS if flag.startswith("-f"))
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=name)
    # `compilerOptions` requires `compiler` (table of SourceFileSet); clang accepts the options of gcc.
    head = {"language": "C99", "compiler": "gcc", "compilerOptions": options}
    files = SubElement(configuration, "SourceFileSet", head)
    SubElement(files, "SourceFile", name=MAIN)
    SubElement(configuration, "Library", name="m", external="true")
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"
