"""What a compiled FMU carries: sources that rebuild it, libraries that load, little weight."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.fmu import build_compiled_fmu
from softneck.fmu.compiled import _sources
from softneck.fmu.compiled._library import packaged_library
from softneck.fmu.compiled._model_file import node_of
from softneck.fmu.compiled._sources import FLAGS, c_sources, sources_key
from softneck.fmu.compiled.translate._kinds import LIBRARIES, RUNTIMES, ranks_of
from softneck.fmu.compiled.translate._translate import select_kinds
from softneck.fmu.describe._description import exported_block
from softneck.fmu.python._zip import deflate, write_zip

from .every_kind import NATIVE, TS, block_of, inputs_of

MOST_BYTES = 400_000  # the figure, of five platforms without model data
needs_cc = pytest.mark.skipif(shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here")
library = packaged_library()
needs_all = pytest.mark.skipif(library is None, reason="the libraries of these sources are not built: make native")


@pytest.mark.usefixtures("plain_steps_of_blocks")
@pytest.mark.parametrize("kind", NATIVE)
def test_a_part_of_the_library_holds_each_kind(kind: str) -> None:
    block = exported_block(block_of(kind))
    modules = node_of(block.runtime, block.arrays).modules
    assert any(modules <= held for held in LIBRARIES.values()), modules


def test_the_parts_hold_all_kinds_between_them() -> None:
    assert frozenset(RUNTIMES).union(*LIBRARIES.values()) == frozenset().union(*LIBRARIES.values())


@needs_all
@pytest.mark.parametrize("kind", NATIVE)
def test_five_platforms_weigh_less_than_400_kilobytes(kind: str, tmp_path: Path) -> None:
    build_compiled_fmu(block_of(kind), tmp_path / "Model.fmu", fmi=3)
    with zipfile.ZipFile(tmp_path / "Model.fmu") as archive:
        data = archive.getinfo("resources/model.bin").compress_size
        assert len([name for name in archive.namelist() if name.startswith("binaries/")]) == 5
        assert archive.testzip() is None
    assert (tmp_path / "Model.fmu").stat().st_size - data < MOST_BYTES


def test_what_is_large_is_stored_at_once(tmp_path: Path) -> None:
    members = {"resources/model.bin": bytes(1 << 24) + b"1", "small": bytes(1 << 20)}
    write_zip(tmp_path / "large.zip", members)
    with zipfile.ZipFile(tmp_path / "large.zip") as archive:
        assert archive.testzip() is None
        assert {name: archive.read(name) for name in archive.namelist()} == members
        stored = {entry.filename: entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist()}
    assert stored == {"resources/model.bin": True, "small": False}


def test_what_is_too_large_for_a_zip_file_of_32_bits_is_refused(tmp_path: Path) -> None:
    class Huge(bytes):
        def __len__(self) -> int:
            return size

    size = (1 << 32) - 1  # says in a header of 32 bits that there is one of 64 bits
    with pytest.raises(SettingsError, match="more than 4 GB"):
        write_zip(tmp_path / "huge.zip", {"resources/model.bin": Huge()})
    assert not (tmp_path / "huge.zip").exists()
    size -= 1
    write_zip(tmp_path / "large.zip", {"resources/model.bin": Huge()})


@pytest.mark.slow
def test_a_wheel_knows_its_libraries_in_its_own_folders(tmp_path: Path) -> None:
    """The key of a checkout is that of its copy elsewhere: no path is part of it."""
    root = Path(__file__).parents[2]
    shutil.copytree(root / "softneck", tmp_path / "softneck", ignore=shutil.ignore_patterns("__pycache__", "binaries"))
    script = "import softneck.fmu.compiled._sources as s; print(s.HERE, s.sources_key())"
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": str(tmp_path)}, cwd=tmp_path,
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    assert done.stdout.split() == [str(tmp_path / "softneck" / "fmu" / "compiled"), sources_key()]


def test_a_stream_deflated_before_gives_the_same_file(tmp_path: Path) -> None:
    members = {"b/é.txt": b"one" * 1000, "a.bin": bytes(5), "empty": b""}
    write_zip(tmp_path / "plain.zip", members)
    write_zip(tmp_path / "given.zip", members, {members["b/é.txt"]: deflate(members["b/é.txt"])})
    assert (tmp_path / "plain.zip").read_bytes() == (tmp_path / "given.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "plain.zip") as archive:
        assert archive.testzip() is None
        assert {name: archive.read(name) for name in archive.namelist()} == members


@needs_cc
@pytest.mark.parametrize(
    ("kind", "fmi"),
    [
        ("kalman", 3),
        *(pytest.param(kind, fmi, marks=pytest.mark.slow) for kind, fmi in (("guarded", 2), ("mpc", 2), ("neck", 3))),
    ],
)
def test_its_sources_rebuild_it_for_this_machine(kind: str, fmi: int, tmp_path: Path, running: Any) -> None:
    """By the build description where FMI 3 has one, else by the readme; another compiler, the same bits."""
    block, u = block_of(kind), inputs_of(block_of(kind), 50)
    build_compiled_fmu(block, tmp_path / "Model.fmu", fmi=fmi)
    with zipfile.ZipFile(tmp_path / "Model.fmu") as archive:
        archive.extractall(tmp_path / "unpacked")
    sources = tmp_path / "unpacked" / "sources"
    assert shlex.join(FLAGS) in (sources / "README.txt").read_text()
    if fmi == 3:
        root = ElementTree.parse(sources / "buildDescription.xml").getroot()
        file_set = root.find("BuildConfiguration/SourceFileSet")
        assert file_set is not None
        names = [file.get("name", "") for file in file_set.iter("SourceFile")]
        command = ["cc", "-std=c99", "-O2", *shlex.split(file_set.get("compilerOptions", "")), *names]
    else:
        command = ["cc", *FLAGS, "softneck.c"]
    seen = [_outputs(tmp_path / "Model.fmu", block, u, running, fmi)]
    target = next((tmp_path / "unpacked" / "binaries").glob("*/*.so"))
    shutil.rmtree(tmp_path / "unpacked" / "binaries")
    target.parent.mkdir(parents=True)
    subprocess.run([*command, "-fPIC", "-shared", "-o", str(target), "-lm"], cwd=sources, check=True, timeout=300)
    files = (path for path in (tmp_path / "unpacked").rglob("*") if path.is_file())
    write_zip(tmp_path / "Rebuilt.fmu", {str(p.relative_to(tmp_path / "unpacked")): p.read_bytes() for p in files})
    seen.append(_outputs(tmp_path / "Rebuilt.fmu", block, u, running, fmi))
    np.testing.assert_array_equal(seen[1], seen[0])


def _outputs(path: Path, block: Any, u: np.ndarray, running: Any, fmi: int) -> np.ndarray:
    names = [port.name for port in block.outputs]
    if fmi == 3:
        rows = np.zeros(len(u), dtype=[("time", float), *((port.name, float) for port in block.inputs)])
        rows["time"] = np.arange(len(u)) * TS
        for j, port in enumerate(block.inputs):
            rows[port.name] = np.nan_to_num(u[:, j])
        result = fmpy.simulate_fmu(
            str(path), input=rows, output=names, step_size=TS, output_interval=TS, stop_time=1.0, validate=False
        )
        return np.array([result[name] for name in names], dtype=float)
    with running(path) as fmu:
        fmu.begin()
        seen = []
        for k, row in enumerate(u):
            fmu.set(**dict(zip([port.name for port in block.inputs], row, strict=True)))
            fmu.fmu.doStep(k * TS, TS)
            seen.append(fmu.get(*names))
    return np.array(seen)


def test_the_sources_of_one_kind_hold_no_other() -> None:
    text = c_sources().files["sn_kinds.h"]
    alone = select_kinds(text, {"softneck.identification.linear._rls_runtime"})
    assert "sn_kind_count = 1;" in alone
    assert "mpc_" not in alone
    assert len(alone) < len(text) / 10
    assert select_kinds(text, set(re.findall(r'\{"(softneck\.[\w.@]+)"', text))) == text


@pytest.mark.slow
def test_fmi3_has_the_variables_of_fmi2(tmp_path: Path) -> None:
    """FMI 2 has those of the Python one: test_native_kinds.py."""
    for kind in NATIVE:
        facts = []
        for fmi in (2, 3):
            build_compiled_fmu(block_of(kind), tmp_path / "Model.fmu", fmi=fmi, force=True)
            variables = fmpy.read_model_description(str(tmp_path / "Model.fmu")).modelVariables
            facts.append([(v.name, v.valueReference, v.causality, v.unit) for v in variables if v.name != "time"])
        assert facts[0] == facts[1], kind


def test_any_source_that_changes_makes_another_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "compiled"
    shutil.copytree(_sources.HERE, copy, ignore=shutil.ignore_patterns("__pycache__", "binaries"))
    monkeypatch.setattr(_sources, "HERE", copy)
    keys = [sources_key.__wrapped__()]
    assert keys[0] == sources_key()
    for name in ("c/sn_vector.h", "translate/_calls.py", "_build.py"):
        path = copy / name
        path.write_text(path.read_text(encoding="utf-8") + "\n", encoding="utf-8")
        keys.append(sources_key.__wrapped__())
    assert len(set(keys)) == len(keys)


def test_arrays_of_other_ranks_than_declared_are_refused() -> None:
    runtime = "softneck.identification.linear._rls_runtime"
    arrays = tuple(np.zeros((1,) * rank) for rank in ranks_of(runtime))
    assert node_of(runtime, arrays).module == runtime
    for wrong in (arrays[:-1], (*arrays[:-1], np.zeros((1, 1)))):
        with pytest.raises(SettingsError, match=r"arrays of ranks .* and the compiled library expects"):
            node_of(runtime, wrong)
