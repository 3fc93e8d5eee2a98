"""Where the host has numba, an FMU steps by compiled code: the same numbers, the same states, and no surprises."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.fmu import build_fmu, unpacked
from softneck.fmu.python import _build, _slave_compiled
from softneck.runtime import _compile
from softneck.runtime._compile import have_numba

from ..data import slow_but
from .every_kind import KINDS, SHORT, TS, block_of, inputs_of

pytestmark = pytest.mark.skipif(not have_numba(), reason="numba is not installed")


def _run(fmu: Any, kind: str, first: int, last: int) -> np.ndarray:
    block, u = block_of(kind), inputs_of(block_of(kind), 60)
    names, outputs = [p.name for p in block.inputs], [p.name for p in block.outputs]
    seen = []
    for k in range(first, last):
        fmu.set(**dict(zip(names, u[k], strict=True)))
        fmu.fmu.doStep(k * TS, TS)
        seen.append(fmu.get(*outputs))
    return np.array(seen)


def _state(fmu: Any) -> bytes:
    return bytes(fmu.fmu.serializeFMUstate(fmu.fmu.getFMUstate()))


# Compiling these takes minutes in all; the runtimes of controllers and observers are compared without drives, too.
LONG = [
    *SHORT[1:], "nonlinear", "nonlinear_payload", "guarded", "mpc", "nmpc", "adaptive", "hinf", "pid", "fopi", "lqg",
    "custom",
]  # fmt: skip


@pytest.mark.parametrize("kind", slow_but(KINDS, ["rls", "nn"], nightly=LONG))
def test_compiled_and_plain_steps_agree(
    kind: str, tmp_path: Path, running: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = build_fmu(block_of(kind), tmp_path / f"{kind}.fmu")
    with running(path) as plain, running(path) as compiled:
        plain.begin()
        monkeypatch.setenv("SOFTNECK_FMU_NUMBA", "1")
        compiled.begin()
        modes = [json.loads(_state(fmu))["compiled"] for fmu in (plain, compiled)]
        assert modes == [False, True]
        # tanh, exp and matrix products differ in the last digit; 60 stable steps do not add to 1e-12. A Kalman
        # filter's innovation, 1e4 on these random measurements, is a small difference over a smaller variance.
        rtol = 1e-10 if kind == "kalman" else 1e-12
        np.testing.assert_allclose(_run(compiled, kind, 0, 60), _run(plain, kind, 0, 60), rtol=rtol, atol=1e-12)


@pytest.mark.parametrize("saved", ["0", "1"])
def test_a_state_goes_on_as_it_was_saved_to_the_bit(
    saved: str, tmp_path: Path, running: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = build_fmu(block_of("nn"), tmp_path / "Nn.fmu")
    with running(path) as one, running(path) as two:
        monkeypatch.setenv("SOFTNECK_FMU_NUMBA", saved)
        one.begin()
        _run(one, "nn", 0, 20)
        text = _state(one)
        expected = _run(one, "nn", 20, 60)
        # The other instance would run the other way by itself: by the switch, or because nothing says "always".
        monkeypatch.setenv("SOFTNECK_FMU_NUMBA", "1" if saved == "0" else "")
        two.begin()
        two.fmu.setFMUstate(two.fmu.deSerializeFMUstate(text))
        np.testing.assert_array_equal(_run(two, "nn", 20, 60), expected)


def test_a_compiled_state_where_numba_is_switched_off_goes_on_with_a_warning(
    tmp_path: Path, running: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = build_fmu(block_of("rls"), tmp_path / "Rls.fmu")
    with running(path) as one, running(path) as two:
        monkeypatch.setenv("SOFTNECK_FMU_NUMBA", "1")
        one.begin()
        text = _state(one)
        monkeypatch.setenv("SOFTNECK_FMU_NUMBA", "0")
        two.begin()
        two.fmu.setFMUstate(two.fmu.deSerializeFMUstate(text))
        _run(two, "rls", 0, 1)
        assert "goes on by plain ones" in two.log[-1][1]


def test_fmus_keep_compiled_code_beside_softnecks_and_under_other_names(tmp_path: Path) -> None:
    """Functions of one name that two compilers have made call each other's, with other arguments: a process crashed."""
    ours, theirs = _compile.cache_folder(), _slave_compiled._fmu_cache_folder()
    assert ours.parent == theirs.parent
    assert (ours.name.partition("-")[0], theirs.name.partition("-")[0]) == ("softneck", "fmu")
    text = "def step(a, q, x, u, y):\n    x[0] += u[0]\n"
    own = _compile._import_text(text, compiled=True)
    path = tmp_path / "text.py"
    path.write_text(text)
    made = _slave_compiled._fmu_compile(f"{_compile.compiled_name(text)}_fmu", path, {})
    assert made.__module__ != own.__name__


@pytest.mark.parametrize(
    ("kind", "cost"),
    [
        ("lag", "light"),
        ("rls", "middling"),
        ("kalman", "middling"),
        ("nn", "middling"),
        ("nlsm", "heavy"),
        ("neck", "heavy"),
    ],
)
def test_the_cost_decides_what_is_compiled(kind: str, cost: str, toys: Any) -> None:
    from softneck.fmu.python._build import step_cost

    # The paper's 7,000 points; the network's lines do not depend on its size.
    special = {"nlsm": _many_points, "lag": toys.lag}
    block = special[kind]() if kind in special else block_of(kind)
    assert step_cost(block) == cost


def _many_points() -> Any:
    from dataclasses import replace

    block = block_of("nlsm")
    arrays = list(block.arrays)
    arrays[4] = np.tile(arrays[4], (1, 1, 20))
    return replace(block, arrays=tuple(arrays))


_HOST = """
import sys, fmpy
from fmpy.fmi2 import FMU2Slave
model = fmpy.read_model_description(sys.argv[1])
fmu = FMU2Slave(guid=model.guid, unzipDirectory=sys.argv[1], modelIdentifier="Lag", instanceName="child")
fmu.instantiate()
fmu.setupExperiment(startTime=0.0)
fmu.enterInitializationMode()
fmu.exitInitializationMode()
fmu.doStep(0.0, 0.02)
state = fmu.getFMUstate()
print(b'"compiled": true' in bytes(fmu.serializeFMUstate(state)), "softneck.core" in sys.modules)
fmu.freeFMUstate(state)
fmu.terminate()
fmu.freeInstance()
"""


def _host(path: Path, cache: Path, before: str = "") -> tuple[str, str]:
    environment = {k: v for k, v in os.environ.items() if k != "SOFTNECK_FMU_NUMBA"}
    with unpacked(path) as folder:
        child = subprocess.run(
            [sys.executable, "-c", before + _HOST, str(folder)], capture_output=True, text=True, check=False,
            timeout=120, env=environment | {"XDG_CACHE_HOME": str(cache)},
        )  # fmt: skip
    assert child.returncode == 0, f"exit {child.returncode}: {child.stdout}{child.stderr}"
    return child.stdout.strip(), child.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is moved by XDG_CACHE_HOME")
def test_a_heavy_fmu_compiles_once_and_says_so_and_a_middling_one_waits_for_it(
    toys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = {}
    for cost in ("light", "middling", "heavy"):
        monkeypatch.setattr(_build, "step_cost", lambda _block, cost=cost: cost)
        (tmp_path / cost).mkdir()
        paths[cost] = build_fmu(toys.lag(), tmp_path / cost / "Lag.fmu")
    cache = tmp_path / "cache"
    assert _host(paths["middling"], cache) == ("False False", "")
    assert not cache.exists()
    assert _host(paths["heavy"], cache, "sys = __import__('sys'); sys.modules['numba'] = None") == ("False False", "")
    out, told = _host(paths["heavy"], cache)
    assert out == "True False"
    assert "Lag: compiling its runtime, once on this machine; SOFTNECK_FMU_NUMBA=0 disables this." in told
    assert _host(paths["heavy"], cache) == ("True False", "")
    assert _host(paths["middling"], cache) == ("True False", "")
    assert _host(paths["light"], cache) == ("False False", "")
    # Code of softneck's own way of compiling is not to meet this one: neither takes up what the other has compiled.
    assert [folder.name.partition("-")[0] for folder in (cache / "softneck" / "runtime").iterdir()] == ["fmu"]
