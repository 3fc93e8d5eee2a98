"""What commands make of a file with another value in its header: a result, or one line; never an internal error.

Files that do not open are those of `test_structure`. `SOFTNECK_FUZZ_INPUTS=20000` tries 200.
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from softneck.cli._main import run
from softneck.core import SoftneckError, load

from ..data import ROOT
from .test_structure import FILES, HEADERS, SEED, WILD, parts, places, put, write

GOLDEN = ROOT / "tests" / "golden"
CONTROLLERS = ("adaptive", "custom", "fopi", "hinf", "lqg", "mpc", "nmpc", "pi", "pid")
OBSERVERS = ("kalman", "kalman_gyro", "kalman_jacobi")
INTERNAL = 3
LOOP = """
duration_s = 0.4
sample_time_s = 0.02
[plant]
neck = "paper"
[observer]
file = '{observer}'
[controller]
file = '{controller}'
[reference]
kind = "step"
pitch_deg = 5.0
at_s = 0.1
"""


def commands(kind: str, file: Path, folder: Path) -> list[list[str]]:
    """Return what is done with a file of a kind."""
    given, record, out = str(file), str(folder / "rec.csv"), str(folder / "out")
    asked = [["info", given], ["fmu", given, "-o", out + ".fmu"], ["info", out + ".fmu"]]
    if kind in CONTROLLERS or kind in OBSERVERS:
        loop = folder / "loop.toml"
        controller = file if kind in CONTROLLERS else GOLDEN / "pi.npz"
        observer = file if kind in OBSERVERS else GOLDEN / "kalman.npz"
        loop.write_text(LOOP.format(controller=controller, observer=observer), encoding="utf-8")
        asked.append(["simulate", str(loop), "-o", out])
    elif kind == "family":
        asked += [["design", "pi", given, "-o", out + ".npz"]]
    else:
        asked += [["validate", given, record]]
    if kind in ("pi", "pid"):
        asked.append(["verify", given, str(GOLDEN / "rls.npz"), "-o", out + ".json"])
    if kind in ("rls", "rls_mimo", "oe"):
        asked += [["design", "pi", given, "-o", out + ".npz"], ["observer", given, "-o", out + ".npz"]]
    return [command if command[0] in ("info", "validate") else [*command, "--force"] for command in asked]


@pytest.mark.slow
@pytest.mark.parametrize("part", range(2))
def test_no_command_ends_in_an_internal_error(part: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seed = SEED + 10 + part
    draw = random.Random(seed)
    assert run(["record", "steps", "-o", str(tmp_path / "rec.csv"), "--duration", "12"]) == 0
    whole: list[tuple[str, dict[str, Any], Any]] = [(path.stem, *parts(path)) for path in FILES]
    damaged, tried = tmp_path / "damaged.npz", 0
    while tried < max(4, HEADERS // 200):
        kind, header, arrays = draw.choice(whole)
        place, value = draw.choice(list(places(header))), draw.choice(WILD)
        write(damaged, put(header, place, value), arrays)
        try:
            load(damaged)
        except SoftneckError:
            continue
        tried += 1
        for command in commands(kind, damaged, tmp_path):
            capsys.readouterr()
            code = run(command)
            said = capsys.readouterr().err
            assert code < INTERNAL, f"seed {seed}, {kind}: {place} = {value!r}: {command[0]}: {said}"
