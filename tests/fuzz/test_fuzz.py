"""Whatever bytes a file holds: a reader returns what it says, or one error of ours that names it; that soon.

`make test` tries some inputs of each format, `make nightly` 100,000 in all (`SOFTNECK_FUZZ_INPUTS`). With coverage as a
guide, where atheris is installed: `python -m tests.fuzz npz -max_total_time=600`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softneck.core import SoftneckError

from .targets import TARGETS, Edit, edited, edited_member

INPUTS = int(os.environ.get("SOFTNECK_FUZZ_INPUTS", "0"))
QUICK = 40
# [s] of the processor for a file of some kB: a hundred times what the slowest takes.
SOON = 2.0


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[bytes]]:
    folder, found = tmp_path_factory.mktemp("seeds"), {}
    for name, target in TARGETS.items():
        paths = [folder / f"{name}{place}{target.suffix}" for place in range(len(target.seeds))]
        for path, write in zip(paths, target.seeds, strict=True):
            write(path)
        found[name] = [path.read_bytes() for path in paths]
    return found


def place_for(folder: Path, name: str) -> Path:
    return folder / ("study.json" if name == "study_json" else f"a{TARGETS[name].suffix}")


def inputs() -> int:
    return max(QUICK, round(INPUTS / len(TARGETS)))


@pytest.mark.parametrize("name", TARGETS)
def test_whole_files_are_read(tmp_path: Path, seeds: dict[str, list[bytes]], name: str) -> None:
    """Else all that follows would be tried on the first line of a reader."""
    for content in seeds[name]:
        path = place_for(tmp_path, name)
        path.write_bytes(content)
        (tmp_path / "pi.npz").write_bytes(seeds["npz"][0])
        (tmp_path / "loop.toml").write_bytes(seeds["loop"][0])
        TARGETS[name].read(path)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.nightly) if INPUTS else name for name in TARGETS]
)
def test_any_bytes_are_a_file_or_one_error_of_ours(tmp_path: Path, seeds: dict[str, list[bytes]], name: str) -> None:
    target, path = TARGETS[name], place_for(tmp_path, name)
    (tmp_path / "pi.npz").write_bytes(seeds["npz"][0])
    (tmp_path / "loop.toml").write_bytes(seeds["loop"][0])
    edit: st.SearchStrategy[Edit] = st.tuples(st.floats(0, 0.9999), st.integers(0, 6), st.integers(0, 2**16))

    @settings(max_examples=inputs(), suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
    @given(place=st.integers(0, 99), inside=st.booleans(), edits=st.lists(edit, min_size=1, max_size=5))
    def read(place: int, inside: bool, edits: list[Edit]) -> None:
        seed = seeds[name][place % len(seeds[name])]
        change = edited_member(seed, place, edits) if target.zipped and inside else edited(seed, edits)
        path.write_bytes(change)
        begin = time.process_time()
        said = ""
        try:
            target.read(path)
        except SoftneckError as error:
            said = str(error)
        assert len(said.splitlines()) <= 1, "one line"
        assert time.process_time() - begin < SOON

    read()
