"""The five libraries, looked at without running them: they load where they should and ask for nothing unusual."""

from __future__ import annotations

import hashlib
import re
import struct
from pathlib import Path
from typing import Any

import fmpy
import lief
import pytest

from softneck.fmu.compiled._library import packaged_library

library = packaged_library()
pytestmark = pytest.mark.skipif(library is None, reason="the libraries of these sources are not built: make native")
# C's library and no more: memory, files, text; floor, ceil and fmod, which are exact everywhere.
_USUAL = set(
    re.findall(
        r"\w+",
        "malloc calloc realloc free memcpy memmove memset memchr memcmp bcmp bzero fopen fclose fread snprintf "
        "vsnprintf strlen strcmp strncmp strspn strtol floor ceil fmod setjmp longjmp memcpy_chk dyld_stub_binder",
    )
)


def _binary(name: str) -> Any:
    assert library is not None
    found = lief.parse(list(library.binaries[name]))
    assert found is not None
    return found


def _functions_of_the_standards() -> set[str]:
    text = "".join((Path(fmpy.__file__).parent / "c-code" / f"fmi{n}Functions.h").read_text() for n in (2, 3))
    names = re.findall(r"(fmi3\w+)TYPE\s+fmi3\w+\s*;", text) + re.findall(r"fmi2FullName\((fmi2\w+)\)", text)
    assert len(names) > 80
    return set(names)


@pytest.mark.parametrize("name", ["x86_64-linux", "aarch64-linux"])
def test_a_library_for_linux_runs_with_glibc_of_2012(name: str) -> None:
    binary = _binary(name)
    assert set(binary.libraries) <= {"libc.so.6", "libm.so.6"}
    assert {symbol.name for symbol in binary.exported_symbols} == _functions_of_the_standards()
    wanted = [symbol for symbol in binary.imported_symbols if symbol.name]
    assert {symbol.name.strip("_") for symbol in wanted} <= _USUAL
    versions = {version.name for need in binary.symbols_version_requirement for version in need.get_auxiliary_symbols()}
    assert versions
    assert max(tuple(map(int, version.removeprefix("GLIBC_").split("."))) for version in versions) <= (2, 17)
    stack = next(s for s in binary.segments if s.type == lief.ELF.Segment.TYPE.GNU_STACK)
    assert not stack.has(lief.ELF.Segment.FLAGS.X)


def test_the_library_for_windows_asks_for_dlls_of_windows_alone() -> None:
    binary = _binary("x86_64-windows")
    names = {entry.name.lower() for entry in binary.imports}
    assert all(name == "kernel32.dll" or name.startswith("api-ms-win-crt-") for name in names), names
    assert {entry.name for entry in binary.get_export().entries} >= _functions_of_the_standards()


@pytest.mark.parametrize("name", ["x86_64-darwin", "aarch64-darwin"])
def test_a_library_for_macos_asks_for_libsystem_alone(name: str) -> None:
    binary = _binary(name)
    loaded = [entry.name for entry in binary.libraries if entry.name != "softneck.dylib"]
    assert loaded == ["/usr/lib/libSystem.B.dylib"]
    exported = {symbol.name.lstrip("_") for symbol in binary.exported_symbols}
    assert exported - {"dso_handle", "mh_dylib_header"} == _functions_of_the_standards()  # the linker's own two
    assert {symbol.name.strip("_") for symbol in binary.imported_symbols} <= _USUAL
    # The first macOS for Apple's own processors; what zig takes by itself is newer than many machines.
    assert list(binary.build_version.minos) == [11, 0, 0]


# CS_SuperBlob, CS_CodeDirectory of Apple's cs_blobs.h, big-endian.
_SUPER, _DIRECTORY, _ADHOC, _SHA256 = 0xFADE0CC0, 0xFADE0C02, 0x2, 2


def test_the_library_for_apples_processors_is_signed_and_the_signature_holds() -> None:
    """macOS on arm64 loads nothing unsigned: each page's SHA-256 must be the one in the ad-hoc code directory."""
    assert library is not None
    data, signature = library.binaries["aarch64-darwin"], _binary("aarch64-darwin").code_signature
    blob = data[signature.data_offset : signature.data_offset + signature.data_size]
    magic, _, count = struct.unpack_from(">3I", blob)
    assert magic == _SUPER
    offsets = [struct.unpack_from(">2I", blob, 12 + 8 * i)[1] for i in range(count)]
    at = next(offset for offset in offsets if struct.unpack_from(">I", blob, offset)[0] == _DIRECTORY)
    _, _, _, flags, hashes, _, _, pages, limit, size, kind, _, shift = struct.unpack_from(">9I4B", blob, at)
    assert flags & _ADHOC
    assert (kind, size) == (_SHA256, 32)
    assert limit == signature.data_offset  # all of the file up to the signature itself
    page = 1 << shift
    assert pages == -(-limit // page)
    for i in range(pages):
        stated = blob[at + hashes + size * i : at + hashes + size * (i + 1)]
        assert hashlib.sha256(data[i * page : min((i + 1) * page, limit)]).digest() == stated, f"page {i}"
