"""Damage that a parser does not see: arrays of another shape, values of another type in a header.

Each file of ours is changed in one place and everything around it is right. It is refused where it is opened, in one
line, or everything that a command makes of it works: steps run as plain Python, which checks each index.
`SOFTNECK_FUZZ_INPUTS=20000` is the nightly number of headers.
"""

from __future__ import annotations

import json
import os
import random
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import FileFormatError, SoftneckError, load
from softneck.fmu.describe._describe import block_and_info

from ..data import ROOT

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")
FILES = sorted((ROOT / "tests" / "golden").glob("*.npz"))
HEADERS = int(os.environ.get("SOFTNECK_FUZZ_INPUTS", "80"))
SEED = random.SystemRandom().randrange(2**31) if HEADERS > 1000 else 20261128
GONE = object()
WILD = (
    GONE, None, "x", [], {}, -1, 0, 1, 1.5, 1e300, True, 2**64, [None], {"a": None}, "1e999", [1, 2, 3, 4, 5, 6, 7],
    float("nan"), float("inf"), -1e300, "../x",
)  # fmt: skip


def parts(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return json.loads(arrays.pop("header").tobytes().decode()), arrays


def write(path: Path, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    with path.open("wb") as file:
        np.savez(file, header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8), **arrays)  # type: ignore[arg-type]


def resized(array: np.ndarray, axis: int, length: int) -> np.ndarray:
    if length <= array.shape[axis]:
        return np.take(array, range(length), axis=axis)
    last = (
        np.take(array, [-1], axis=axis) if array.shape[axis] else np.zeros_like(np.expand_dims(array.sum(axis), axis))
    )
    return np.concatenate([array, last.astype(array.dtype)], axis=axis)


def changes(arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    for name, array in arrays.items():
        for axis, n in enumerate(array.shape):
            for length in {0, n - 1, n + 1} - {n, -1}:
                yield name, resized(array, axis, length)


def saved_again(path: Path, folder: Path) -> Path:
    """A file as this version writes it."""
    again = folder / path.name
    load(path).save(again)
    return again


QUICK = ("pi", "rls", "kalman", "play", "mpc")


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.slow) for path in FILES]
)
def test_an_array_of_another_shape_is_refused_in_one_line(path: Path, tmp_path: Path) -> None:
    header, arrays = parts(saved_again(path, tmp_path))
    damaged, tried = tmp_path / "damaged.npz", 0
    for name, array in changes(arrays):
        write(damaged, header, {**arrays, name: array})
        with pytest.raises(FileFormatError, match=r"damaged\.npz: ") as refused:
            load(damaged)
        assert f"`{name}`" in str(refused.value)
        assert len(str(refused.value).splitlines()) == 1
        tried += 1
    assert tried > 5


# Lengths that a symbol alone gives: of another order, other operators or other points the file is a whole one.
FREE = {
    "a", "b", "widths", "echo", "seen", "training_rows", "weight", "drive", "redefinition",
}  # fmt: skip


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_of_before_that_tells_no_shapes_is_refused_where_an_equation_reads_its_length(
    path: Path, tmp_path: Path
) -> None:
    header, arrays = parts(path)
    assert "shapes" not in header
    damaged, accepted = tmp_path / "damaged.npz", set[str]()
    for name, array in changes(arrays):
        write(damaged, header, {**arrays, name: array})
        try:
            used(damaged)
        except FileFormatError:
            continue
        accepted.add(name.rpartition(".")[2].removeprefix("model_").removeprefix("pitch_").removeprefix("roll_"))
    assert accepted <= FREE


def used(path: Path) -> None:
    """Do what commands do of a file: read it, describe it, start it and step it once."""
    made = load(path)
    assert isinstance(made.summary(), str)
    assert repr(made)
    if not hasattr(made, "block"):
        return
    block, _ = block_and_info(made, None)
    state = block.initial_state()
    block.step(state, np.zeros(len(block.inputs)))


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, item in inner:
        yield (*path, key)
        yield from places(item, (*path, key))


def put(header: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    changed = json.loads(json.dumps(header))
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return changed


@pytest.mark.parametrize(
    "part", [pytest.param(part, marks=pytest.mark.nightly if HEADERS > 1000 else ()) for part in range(2)]
)
def test_a_header_with_another_value_is_refused_or_everything_works(part: int, tmp_path: Path) -> None:
    random_place = random.Random(SEED + part)
    print(f"seed {SEED + part}")
    whole = [parts(path) for path in FILES]
    for _ in range(HEADERS // 2):
        header, arrays = random_place.choice(whole)
        place, value = random_place.choice(list(places(header))), random_place.choice(WILD)
        damaged = tmp_path / "damaged.npz"
        write(damaged, put(header, place, value), arrays)
        said = outcome(damaged)
        assert len(said.splitlines()) <= 1, f"{header['kind']}: {place} = {value!r}: {said}"


def test_a_predictive_controller_of_a_plant_without_gain_is_refused(tmp_path: Path) -> None:
    """Found among 40,000 headers."""
    header, arrays = parts(ROOT / "tests" / "golden" / "nmpc.npz")
    write(tmp_path / "a.npz", put(header, ("found", "pitch", "static_gain"), 0), arrays)
    with pytest.raises(FileFormatError, match="static gain of 0"):
        load(tmp_path / "a.npz")


def outcome(path: Path) -> str:
    """Return "" where a file is used, the line where it is refused, all of an error that is not ours."""
    try:
        used(path)
    except SoftneckError as error:
        return str(error)
    except Exception:
        return traceback.format_exc()
    return ""
