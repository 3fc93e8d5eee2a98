"""Settings files with one value of another type or size: read, or refused in one line that names what is wrong.

`SOFTNECK_FUZZ_INPUTS=20000` is the nightly number of files.
"""

from __future__ import annotations

import json
import math
import os
import random
import tomllib
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from softneck.core import SoftneckError
from softneck.cosim import load_study
from softneck.loop import LoopRun
from softneck.robot import Robot, Scaling

from .targets import TARGETS

INPUTS = int(os.environ.get("SOFTNECK_FUZZ_INPUTS", "300"))
SEED = random.SystemRandom().randrange(2**31) if INPUTS > 1000 else 20261128
KINDS = ("study", "loop", "robot", "drives", "layout", "neck", "requirements", "tune")
GONE = object()
WILD = (
    GONE, "", "x", "none", [], {}, -1, 0, 1, 1.5, 1e300, -1e300, 5e-324, True, 2**64, -(2**64), math.nan, math.inf,
    [[]], ["x"], [1e300, 2**64], {"x": 1}, [{}], "1e999", "../x", "a\nb",
)  # fmt: skip


def text(value: Any) -> str:
    """Return a value as TOML, on one line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{text(key)} = {text(item)}" for key, item in value.items()) + "}"
    return repr(value)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in inner:
        yield (*path, key)
        yield from places(item, (*path, key))


def put(table: Any, path: Sequence[Any], value: Any) -> Any:
    """Return a table with another value at `path`; lists and tables are copied."""
    made = dict(table) if isinstance(table, dict) else list(table)
    if len(path) > 1:
        made[path[0]] = put(made[path[0]], path[1:], value)
    elif value is GONE:
        del made[path[0]]
    else:
        made[path[0]] = value
    return made


def used(kind: str, path: Path) -> None:
    """Read a file, and do what is cheap with what is in it."""
    if kind == "study":
        study = load_study(path)
        study.check()
        study.setup(len(study.points) - 1)
        assert len(study.digest) == 64
        return
    made: Any = TARGETS[kind].read(path)
    assert isinstance(repr(made), str)
    if kind == "loop":
        LoopRun(made.loop)
    if kind == "drives":
        made.master_settings(0.02)
    if kind == "robot":
        Scaling.of(made)
        assert Robot.from_dict(json.loads(json.dumps(made.as_dict()))).hash == made.hash


def outcome(kind: str, path: Path) -> str:
    """Return "" where a file is used, the line where it is refused (as printed), all of an error that is not ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            used(kind, path)
        except SoftneckError as error:
            return " ".join(str(error).split())
        except Exception:
            return traceback.format_exc()
    return ""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, dict[str, Any]]]:
    """Tables of each kind of file."""
    path, found = tmp_path_factory.mktemp("whole") / "a.toml", []
    for kind in KINDS:
        for write in TARGETS[kind].seeds:
            write(path)
            found.append((kind, tomllib.loads(path.read_text(encoding="utf-8"))))
    return found


def test_a_table_is_written_as_it_is(whole: list[tuple[str, dict[str, Any]]]) -> None:
    for _, table in whole:
        written = "\n".join(f"{text(key)} = {text(value)}" for key, value in table.items())
        assert tomllib.loads(written) == table


@pytest.mark.parametrize("part", [pytest.param(0, marks=pytest.mark.nightly if INPUTS > 1000 else ())])
def test_another_value_is_refused_in_one_line_or_everything_works(
    part: int, whole: list[tuple[str, dict[str, Any]]], tmp_path: Path
) -> None:
    chance = random.Random(SEED + part)
    print(f"seed {SEED + part}")
    for name in ("npz", "loop"):
        TARGETS[name].seeds[0](tmp_path / ("pi.npz" if name == "npz" else "loop.toml"))
    path, failed = tmp_path / "damaged.toml", []
    for _ in range(INPUTS):
        kind, table = chance.choice(whole)
        place, value = chance.choice(list(places(table))), chance.choice(WILD)
        changed = put(table, place, value)
        path.write_text("\n".join(f"{text(key)} = {text(item)}" for key, item in changed.items()), encoding="utf-8")
        said = outcome(kind, path)
        if len(said.splitlines()) > 1:
            failed.append(f"{kind}: {place} = {value!r}: {said}")
    assert not failed, "\n\n".join([f"{len(failed)} of {INPUTS}", *failed[:40]])
