"""What a compiled FMU, and the making of one, refuse: hostile files, non-finite inputs, kinds and platforms."""

from __future__ import annotations

import ctypes
import dataclasses
import json
import os
import shutil
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from softneck.cli import main
from softneck.core import FileFormatError, SettingsError
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.fmu.compiled import _library
from softneck.fmu.compiled._look_ahead import look_ahead, next_outputs
from softneck.fmu.compiled._model_file import model_bytes
from softneck.fmu.compiled._sources import Sources, c_sources
from softneck.fmu.describe._description import NO_LOOK_AHEAD, with_modelled_drives

from .every_kind import NATIVE, block_of

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)
ROUNDS = int(os.environ.get("SOFTNECK_FUZZ_ROUNDS", "30"))


@pytest.fixture(scope="module")
def pi(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pi") / "Pi.fmu"
    build_compiled_fmu(block_of("pi"), path)
    return path


def _with_model(path: Path, change: Callable[[bytes], bytes], target: Path) -> Path:
    """Copy an FMU with another model file."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, change(data) if name == "resources/model.bin" else data)
    return target


def _mended(data: bytes) -> bytes:
    return data[:16] + struct.pack("<QI", len(data), zlib.crc32(data[32:])) + data[28:]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: b"", "ends too early"),
        (lambda d: b"PK" + d[2:], "is no model file"),
        (lambda d: d[:8] + b"\x09" + d[9:], "has format 9; this library reads 3"),
        (lambda d: d[:-8], "and should have"),
        (lambda d: d[:-1] + bytes([d[-1] ^ 1]), "its checksum is another one"),
        (lambda d: _mended(d[:-8]), "it ends too early"),
        (lambda d: _mended(d + bytes(8)), "has bytes behind its end"),
        (lambda d: _mended(d.replace(b"_tunable_gains_runtime", b"_tunable_gains_runtimf")), "does not hold"),
    ],
)
def test_a_damaged_model_file_is_refused(
    change: Callable[[bytes], bytes], message: str, pi: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = _with_model(pi, change, tmp_path / "Pi.fmu")
    assert message in _instantiation_error(path)
    assert capfd.readouterr().err == ""


def _instantiation_error(path: Path) -> str:
    from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

    from softneck.fmu import unpacked

    log: list[str] = []
    with unpacked(path) as folder:
        fmu = FMU2Slave(
            guid=fmpy.read_model_description(str(folder)).guid, unzipDirectory=str(folder), modelIdentifier="Pi",
            instanceName="test",
        )  # fmt: skip
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(lambda _e, _i, _s, _c, text: log.append(text.decode()))
        with pytest.raises(Exception, match="instantiate"):
            fmu.instantiate(callbacks=callbacks)
        fmu.freeLibrary()
    return " ".join(log)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_input_that_is_not_finite_is_refused_with_a_message(value: float, pi: Path, running: Any) -> None:
    with running(pi) as fmu:
        fmu.begin()
        with pytest.raises(Exception, match="fmi2SetReal"):
            fmu.set(pitch=value)
        assert "pitch was set to" in fmu.log[-1][1]
        assert "it must be finite" in fmu.log[-1][1]


def test_outputs_fixed_parameters_ranges_and_strange_steps_are_refused(pi: Path, running: Any) -> None:
    with running(pi) as fmu:
        with pytest.raises(Exception, match="fmi2DoStep"):
            fmu.fmu.doStep(0.0, 0.02)
        assert "before the initialisation has ended" in fmu.log[-1][1]
        fmu.begin()
        parameter = next(name for name in fmu.references if name.endswith("limit"))
        for name, value, said in (("motor_setpoint_1", 1.0, "is an output"), (parameter, 1.0, "is fixed")):
            with pytest.raises(Exception, match="fmi2SetReal"):
                fmu.set(**{name: value})
            assert said in fmu.log[-1][1]
        with pytest.raises(Exception, match="fmi2GetReal"):
            fmu.fmu.getReal([10_000])
        assert "no variable 10000" in fmu.log[-1][1]
        for step in (np.nan, -1.0, 1e300):
            with pytest.raises(Exception, match="fmi2DoStep"):
                fmu.fmu.doStep(0.0, step)
            assert "cannot be taken" in fmu.log[-1][1]
        with pytest.raises(Exception, match="fmi2DeSerializeFMUstate"):
            fmu.fmu.deSerializeFMUstate(b"nothing of ours")
        assert "another FMU or is damaged" in fmu.log[-1][1]
        fmu.set(pitch_reference=15.0)
        fmu.set(pitch_reference=16.0)
        warnings = [text for status, text in fmu.log if status == 1]
        assert len(warnings) == 1
        assert "Is it in degrees?" in warnings[0]


def test_all_symbols_of_fmi_are_there(pi: Path, tmp_path: Path) -> None:
    from softneck.fmu import unpacked

    headers = Path(fmpy.__file__).parent / "c-code"
    text = "".join((headers / f"fmi{n}Functions.h").read_text() for n in (2, 3))
    import re

    names = set(re.findall(r"(fmi[23]\w+)TYPE\s+\1\s*;", text)) | set(re.findall(r"fmi2FullName\((fmi2\w+)\)", text))
    assert len(names) > 80
    with unpacked(pi) as folder:
        library = ctypes.CDLL(str(next(folder.glob("binaries/*/Pi.*"))))
        assert [name for name in sorted(names) if not hasattr(library, name)] == []
        assert library.fmi2EnterEventMode(None) == 3  # refused, not crashed


def _write_sources(folder: Path, sources: Sources) -> None:
    for name, text in sources.files.items():
        (folder / name).write_text(text)


@pytest.mark.slow
@pytest.mark.parametrize("own", [True, False], ids=["own", "standard"])
def test_the_sources_compile_without_a_warning_and_fit_the_standards_headers(own: bool, tmp_path: Path) -> None:
    _write_sources(tmp_path, c_sources())
    headers = [] if own else ["-DSN_FMI_HEADERS", f"-I{Path(fmpy.__file__).parent / 'c-code'}"]
    unused = ["function", "variable", "but-set-variable", "const-variable"]
    command = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", *(f"-Wno-unused-{name}" for name in unused)]
    done = subprocess.run(
        [*command, *headers, "-fsyntax-only", "softneck.c"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]


def _sensitive(kind: str) -> bool:
    try:
        return bool(next_outputs(block_of(kind)))
    except SettingsError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("sensitivities", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_hostile_files_and_states_break_nothing_under_the_sanitizers(sensitivities: bool, tmp_path: Path) -> None:
    """Every kind, unchanged first: no memory asked for in a step; then with wrong bytes (SOFTNECK_FUZZ_ROUNDS each)."""
    _write_sources(tmp_path, c_sources(sensitivities=sensitivities))
    shutil.copy(Path(__file__).with_name("native_fuzz.c"), tmp_path)
    command = [
        "cc", "-std=c99", "-O1", "-g", "-ffp-contract=off", "-fsanitize=address,undefined",
        "-fno-sanitize-recover=undefined", "-w", "-o", "fuzz", "native_fuzz.c", "-lm",
    ]  # fmt: skip
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[-2000:]
    files = []
    for kind in filter(_sensitive, NATIVE) if sensitivities else NATIVE:
        block = with_modelled_drives(block_of(kind))
        ports, looks = look_ahead(block) if sensitivities else ((), NO_LOOK_AHEAD)
        block = dataclasses.replace(block, outputs=(*block.outputs, *ports))
        files.append(tmp_path / f"{kind}.bin")
        files[-1].write_bytes(model_bytes(block, kind, "00000000-0000-0000-0000-000000000000", looks=looks))
    done = subprocess.run(
        ["./fuzz", str(ROUNDS), "1", *map(str, files)], cwd=tmp_path, capture_output=True, text=True, check=False,
        timeout=3000,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert f"{len(files)} files" in done.stdout
    assert len(files) > 5


# Making one


def test_a_kind_that_is_not_in_the_library_is_named(tmp_path: Path) -> None:
    block = dataclasses.replace(block_of("rls"), runtime="softneck.runtime._random_runtime")
    with pytest.raises(SettingsError, match=r"`random` cannot be in a compiled FMU"):
        build_compiled_fmu(block, tmp_path / "X.fmu")
    flat = dataclasses.replace(block_of("rls"), arrays=tuple(array.ravel() for array in block_of("rls").arrays))
    with pytest.raises(SettingsError, match="has arrays of ranks"):
        build_compiled_fmu(flat, tmp_path / "X.fmu")


def test_a_kind_that_the_translator_refused_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from softneck.fmu.compiled import _build

    library = _library.find_library({"softneck.fmu.describe._tunable_plant_runtime"})
    refused = {"softneck.fmu.describe._tunable_plant_runtime": "`step`: `np.linalg.solve(A, b)`: no translation to C."}
    changed = dataclasses.replace(library, sources=dataclasses.replace(library.sources, refused=refused))
    monkeypatch.setattr(_build, "find_library", lambda _: changed)
    with pytest.raises(SettingsError, match=r"_tunable_plant_runtime` cannot be in a compiled FMU: `step`: `np.linalg"):
        build_compiled_fmu(block_of("rls"), tmp_path / "X.fmu")


def test_platforms_that_are_unknown_or_not_built_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from softneck.fmu.compiled import _build

    library = _library.find_library({"softneck.fmu.describe._tunable_plant_runtime"})
    only = dataclasses.replace(library, binaries={"aarch64-linux": b"not run here"})
    monkeypatch.setattr(_build, "find_library", lambda _: only)
    with pytest.raises(SettingsError, match="unknown platform `amiga`"):
        build_compiled_fmu(block_of("rls"), tmp_path / "X.fmu", platforms=("amiga",))
    with pytest.raises(SettingsError, match="x86_64-windows is not built, only that for aarch64-linux; run `make nat"):
        build_compiled_fmu(block_of("rls"), tmp_path / "X.fmu", platforms=("x86_64-windows",))
    with pytest.raises(SettingsError, match=r"FMI 2.0 has no folder for aarch64-linux; take `--fmi 3`"):
        build_compiled_fmu(block_of("rls"), tmp_path / "X.fmu")
    build_compiled_fmu(block_of("rls"), tmp_path / "X.fmu", fmi=3)
    with zipfile.ZipFile(tmp_path / "X.fmu") as archive:
        assert "binaries/aarch64-linux/X.so" in archive.namelist()


def test_a_damaged_library_is_refused(tmp_path: Path) -> None:
    from softneck.fmu.compiled._sources import sources_key

    manifest = {
        "key": sources_key(),
        "platforms": ["x86_64-linux"],
        "files": {"x86_64-linux.so.deflate": "0" * 64},
        "refused": {},
    }
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "x86_64-linux.so.deflate").write_bytes(b"half a library")
    with pytest.raises(FileFormatError, match=r"x86_64-linux.so.deflate: is damaged or missing; run `make native`"):
        _library.packaged_library(tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(FileFormatError, match=r"manifest.json: is damaged"):
        _library.packaged_library(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps(manifest | {"key": "that of another version"}))
    assert _library.packaged_library(tmp_path) is None  # stale: not used


def test_without_library_and_compiler_the_error_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_library, "BINARIES", tmp_path)
    monkeypatch.setattr(_library, "packaged_library", lambda *_: None)
    monkeypatch.setattr(_library, "local_compiler", lambda: None)
    with pytest.raises(SettingsError, match="no compiled library here and no C compiler"):
        build_compiled_fmu(block_of("rls"), tmp_path / "X.fmu")
    assert _library.platforms_built()[0] == []


def test_the_command_line_builds_one_and_refuses_what_python_cannot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "Neck.fmu"
    monkeypatch.setattr(
        sys, "argv", ["softneck", "fmu", "paper", "--backend", "compiled", "--fmi", "3", "-o", str(out)]
    )
    with pytest.raises(SystemExit) as code:
        main()
    assert code.value.code in (0, None)
    assert "libraries: " in capsys.readouterr().out
    assert fmpy.read_model_description(str(out)).fmiVersion == "3.0"
    monkeypatch.setattr(sys, "argv", ["softneck", "fmu", "paper", "--fmi", "3", "-o", str(tmp_path / "N.fmu")])
    with pytest.raises(SystemExit) as code:
        main()
    assert code.value.code == 2
    assert "add `--backend compiled`" in capsys.readouterr().err
    assert build_fmu(block_of("pi"), tmp_path / "Pi.fmu").is_file()
