"""`make native`: what was compiled is kept, and only processor time is limited."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from softneck.core import SettingsError
from softneck.fmu.compiled import _compilers, _library
from softneck.fmu.compiled._compilers import PLATFORMS, Platform
from softneck.fmu.compiled._sources import GENERATED, Sources
from softneck.fmu.compiled.translate._kinds import LIBRARIES, RUNTIMES

SOURCES = Sources({GENERATED: "/* none */"}, {})


def test_a_second_call_takes_up_what_the_first_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def compile_for(_sources: Sources, platform: Platform) -> bytes:
        asked.append(platform.name)
        if asked.count(platform.name) == 1 and platform.system == "win32":
            raise SettingsError("the power went off.")
        return platform.name.encode()

    monkeypatch.setattr(_library, "compile_for", compile_for)
    monkeypatch.setattr(_library, "c_sources", lambda **_: SOURCES)
    names = list(PLATFORMS)
    parts = names * len(LIBRARIES)  # after the whole ones
    with pytest.raises(SettingsError, match="power"):
        _library.build_all(tmp_path)
    assert _library.packaged_library(tmp_path) is None  # not all: an FMU would lack platforms without a word
    (tmp_path / "aarch64-linux.so.deflate").write_bytes(b"half of it")
    library = _library.build_all(tmp_path)
    assert asked == [*names[:3], *names[1:], *parts]  # the damaged one again
    assert library.binaries == {name: name.encode() for name in names}
    assert _library.packaged_library(tmp_path) == library
    assert len(list(tmp_path.iterdir())) == len(names + parts) + 2  # the generated source and the manifest


@pytest.mark.parametrize("name", list(PLATFORMS))
def test_zig_is_asked_for_the_platform_and_named_where_it_is_missing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def compiled(_sources: Sources, command: list[str], suffix: str) -> bytes:
        commands.append(command)
        return suffix.encode()

    monkeypatch.setattr(_compilers, "_compile", compiled)
    platform = PLATFORMS[name]
    monkeypatch.setattr(_compilers, "have_zig", lambda: False)
    with pytest.raises(SettingsError, match="zig is not installed; install it with `pip install ziglang`"):
        _compilers.compile_for(SOURCES, platform)
    assert not commands
    monkeypatch.setattr(_compilers, "have_zig", lambda: True)
    assert _compilers.compile_for(SOURCES, platform) == platform.suffix.encode()
    (command,) = commands
    assert command[command.index("-target") + 1] == platform.target
    assert ("-fPIC" in command) == (platform.system != "win32")
    # Bits must not depend on the processor: no fused multiply-add anywhere.
    assert "-ffp-contract=off" in command
    assert ("-DSN_OWN_PROBE" in command) == (platform.system == "win32")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows knows no limit on processor time")
@pytest.mark.parametrize(("does", "ends"), [("time.sleep(1.5)", True), ("while True: pass", False)])
def test_a_compiler_may_wait_but_not_work_for_ever(does: str, ends: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_compilers, "_MOST_SECONDS", 1)
    script = f"import sys, time\nif True:\n    {does}\nopen(sys.argv[sys.argv.index('-o') + 1], 'wb').write(b'library')"
    command = [sys.executable, "-S", "-c", script]
    if ends:
        assert _compilers.compile_here(SOURCES, command) == b"library"
    else:
        with pytest.raises(SettingsError, match="each process may take 1 s of processor time"):
            _compilers.compile_here(SOURCES, command)


def test_without_a_built_library_this_machine_compiles_the_part_that_an_fmu_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def c_sources(modules: tuple[str, ...], **_: bool) -> Sources:
        asked.append(modules)
        return SOURCES

    monkeypatch.setattr(_library, "packaged_library", lambda *_: None)
    monkeypatch.setattr(_library, "c_sources", c_sources)
    monkeypatch.setattr(_library, "compile_here", lambda *_: repr(asked[-1]).encode())
    monkeypatch.setattr(_library, "local_compiler", lambda: ["cc"])
    monkeypatch.setattr(_library, "_cache_folder", lambda: tmp_path)
    libraries = [_library.find_library({module}) for part in LIBRARIES.values() for module in sorted(part)]
    # Each part once, and every kind in the part that was compiled for it.
    assert len(asked) == len(LIBRARIES)
    assert {frozenset(modules) for modules in asked} == set(LIBRARIES.values())
    modules = [module for part in LIBRARIES.values() for module in sorted(part)]
    for module, library in zip(modules, libraries, strict=True):
        assert repr(module) in next(iter(library.binaries.values())).decode()
    # No part has kinds of two: the whole.
    _library.find_library({min(LIBRARIES["models"] - LIBRARIES["control"]), min(LIBRARIES["robot_control"])})
    assert set(asked[-1]) == set(RUNTIMES)
