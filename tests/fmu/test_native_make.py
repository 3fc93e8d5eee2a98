"""`make native`: what was compiled is kept, and only processor time is limited."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from softneck.core import SettingsError
from softneck.fmu.compiled import _compilers, _library
from softneck.fmu.compiled._compilers import PLATFORMS, Platform
from softneck.fmu.compiled._sources import GENERATED, Sources
from softneck.fmu.compiled.translate._kinds import LIBRARIES

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
