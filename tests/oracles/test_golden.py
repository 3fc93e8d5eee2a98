"""Files of format 1 that an earlier version wrote still load and give the numbers that it gave (`tests/golden`)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.core import KINDS, load, read_archive

from ..data import ROOT
from .small_blocks import GOLDEN_ROWS, NO_FILE, block_of, compiled_run

GOLDEN = ROOT / "tests" / "golden"
FILES = sorted(GOLDEN.glob("*.npz"))
OUTPUTS: dict[str, list[list[float]]] = json.loads((GOLDEN / "outputs.json").read_text(encoding="utf-8"))


def test_every_kind_has_a_file_and_what_is_stepped_has_outputs() -> None:
    assert {read_archive(path)[0]["kind"] for path in FILES} == set(KINDS)
    stepped = {path.stem for path in FILES if KINDS[read_archive(path)[0]["kind"]].role != "family"}
    assert set(OUTPUTS) == stepped | set(NO_FILE)


# What `nmpc` steps takes half a minute to compile.
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "nmpc")) for name in OUTPUTS])
def test_outputs_are_those_of_the_version_that_wrote_the_file(name: str) -> None:
    expected = np.array(OUTPUTS[name])
    block = block_of(name, GOLDEN)
    seen = compiled_run(block, GOLDEN_ROWS, "missing")
    if block.outputs[-1].name == "validity":
        # These files are from before it: they know none.
        assert (seen[:, -1] == 0.0).all()
        seen = seen[:, :-1]
    # Equal to the bit on the machine that wrote them (`same_as_commit.py`). Another machine's libm and sums of another
    # length of vector are off by a few 1e-16 of each signal's size; 1e-12 is what `test_native_kinds.py` grants too.
    scale = np.maximum(np.nanmax(np.abs(expected), axis=0), 1e-3)
    np.testing.assert_allclose(seen / scale, expected / scale, rtol=1e-12, atol=1e-12)


# Keys of headers that went after 0.2.0, or whose numbers stand elsewhere since.
MOVED = {
    "mpc": ("disturbances",),
    "nmpc": ("settings", "position_limit", "slew_limit", "lead_limit", "least_position", "least_cocontraction"),
}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_is_saved_as_it_was(path: Path, tmp_path: Path) -> None:
    load(path).save(tmp_path / path.name)
    (header, arrays), (new_header, new_arrays) = read_archive(path), read_archive(tmp_path / path.name)
    moved = MOVED.get(path.stem, ())
    assert {k: v for k, v in new_header.items() if k not in moved} == {
        k: v for k, v in header.items() if k not in moved
    }
    # What moved is read back as it was written.
    load(tmp_path / path.name).save(tmp_path / "again.npz")
    assert read_archive(tmp_path / "again.npz")[0] == new_header
    assert list(new_arrays) == list(arrays)
    for name, array in arrays.items():
        assert new_arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(new_arrays[name], array)
