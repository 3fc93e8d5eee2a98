"""libFuzzer over the compiled library for a bounded time, by `make nightly-fmu`: model files, states, calls, texts."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from softneck.fmu.compiled._model_file import model_bytes
from softneck.fmu.compiled._sources import c_sources
from softneck.fmu.describe._description import with_modelled_drives

from .every_kind import NATIVE, block_of

SECONDS = int(os.environ.get("SOFTNECK_FUZZ_SECONDS", "0"))
CLANG = next((name for name in ("clang", "clang-19", "clang-16", "clang-14") if shutil.which(name)), None)
pytestmark = pytest.mark.skipif(not SECONDS, reason="takes SOFTNECK_FUZZ_SECONDS and needs clang: make nightly-fmu")


def _seeds(corpus: Path, models: Path) -> None:
    """One seed of each sort for every kind; found again in a moment, so nothing of it is kept in git."""
    for number, kind in enumerate(NATIVE):
        data = model_bytes(with_modelled_drives(block_of(kind)), kind, "00000000-0000-0000-0000-000000000000")
        (models / f"{number}.bin").write_bytes(data)
        (corpus / f"model_{kind}").write_bytes(b"\0" + data)
        (corpus / f"state_{kind}").write_bytes(bytes([1, number]) + bytes(64))
        (corpus / f"calls_{kind}").write_bytes(bytes([2, number]) + (b"\7" + bytes(8) + b"\5" + bytes(8)) * 4)
    (corpus / "texts").write_bytes(b"\3file:///tmp/a%20b/resources\0{guid}\0name")


def test_libfuzzer_finds_nothing_in_a_bounded_time(tmp_path: Path) -> None:
    assert CLANG is not None, "Debian: apt-get install clang libclang-rt-14-dev (the runtime of your clang's version)"
    for name, text in c_sources().files.items():
        (tmp_path / name).write_text(text)
    shutil.copy(Path(__file__).with_name("native_libfuzzer.c"), tmp_path)
    command = [
        CLANG, "-std=c99", "-g", "-O1", "-w", "-ffp-contract=off", "-fsanitize=fuzzer,address,undefined",
        "-fno-sanitize-recover=undefined", "-o", "fuzzer", "native_libfuzzer.c", "-lm",
    ]  # fmt: skip
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[-2000:]
    for name in ("corpus", "models"):
        (tmp_path / name).mkdir()
    _seeds(tmp_path / "corpus", tmp_path / "models")
    run = ["./fuzzer", f"-max_total_time={SECONDS}", "-max_len=400000", "-timeout=60", "-rss_limit_mb=3000", "-seed=1"]
    environment = os.environ | {"SOFTNECK_MODELS": str(tmp_path / "models")}
    done = subprocess.run(
        [*run, "corpus"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        timeout=SECONDS + 600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-5000:]
    print(done.stderr.splitlines()[-1])
