"""The compiled rows are the Python rows: the same bits, whatever the loop."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control
import numba
import numpy as np
import pytest
from numba.core.types import Function
from numba.core.types.functions import BaseFunction

from softneck.core import DataError, Vector
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.loop import BlockPart, Loop, ReferenceBlock, SensorFault, run_loop
from softneck.loop._faults import FAULT_KINDS, make_fault
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block, State, _compile, _numba_inner
from softneck.runtime._own import OwnStep, own_runtime

from ..data import with_starts
from ..references import RotationReference, StepReference

_KEYS: dict[str, dict[str, Any]] = {
    "sensor_bias": {"size_deg": 2.0}, "sensor_outlier": {"size_deg": 5.0, "share": 0.2, "seed": 3},
    "sensor_delay": {"delay_s": 0.06}, "measurement_noise": {"std_deg": 0.5, "seed": 1}, "motor_stuck": {"motor": 2},
    "motor_slow": {"motor": 0, "rate_rad_s": 0.7}, "motor_offset": {"size_rad": 0.3},
    "payload_step": {"payload_kg": 0.3},
    "push": {"x_n": 1.0, "y_n": -0.5}, "base_tilt": {"pitch_deg": 3.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def parts() -> dict[str, Block]:
    """The virtual neck, a Kalman filter and a PI controller, all at 20 ms."""
    pole = math.exp(-5.293 * 0.02)  # Eq. 31
    tf = control.TransferFunction([0.09 * (1.0 - pole)], [1.0, -pole, 0.0, 0.0], 0.02)
    model = LinearNeck(pitch=tf, roll=tf)
    return {
        "plant": VirtualNeck(NeckParameters.lab().replace(dropout_rate=1.0)).block(noise_seed=3),
        "observer": KalmanSettings(sensor="paper").design(model).block(),
        "controller": PiSettings().design(model).block(),
    }


@pytest.fixture
def loop(parts: dict[str, Block]) -> Callable[..., Loop]:
    """Make the loop of these parts, with what a test changes."""

    def made(**changes: Any) -> Loop:
        settings: dict[str, Any] = {name: BlockPart(block) for name, block in parts.items()}
        settings |= {"reference": StepReference(pitch=0.2, roll=-0.1, at=0.3), "duration": 2.0} | changes
        return Loop(**settings)

    return made


def _same(first: Any, second: Any) -> None:
    assert list(first.signals) == list(second.signals)
    for name, values in first.signals.items():
        # Not one bit: the same compiled steps, linked.
        assert values.tobytes() == second.signals[name].tobytes(), name


@pytest.mark.parametrize("order", ["sequential", "jacobi"])
@pytest.mark.parametrize("kind", ["none", *FAULT_KINDS])
def test_every_fault_and_order(kind: str, order: str, loop: Callable[..., Loop]) -> None:
    window = {"start_s": 0.5, "duration_s": 0.6}
    faults = () if kind == "none" else (make_fault(kind, {**window, **_KEYS.get(kind, {})}),)
    case = loop(order=order, faults=faults)
    _same(run_loop(case), run_loop(case, compiled=True))


def test_all_faults_at_once(loop: Callable[..., Loop]) -> None:
    faults = tuple(make_fault(kind, {"start_s": 0.1 * i, **_KEYS.get(kind, {})}) for i, kind in enumerate(FAULT_KINDS))
    case = loop(faults=faults, plant_inputs={"payload": 0.2}, plant_parameters={"bending_stiffness": 0.9})
    _same(run_loop(case), run_loop(case, compiled=True))


@pytest.mark.slow
def test_parts_of_other_rates_and_a_reference_that_is_a_part(loop: Callable[..., Loop]) -> None:
    neck = BlockPart(VirtualNeck(NeckParameters.paper()).block(sample_time=0.005))
    wanted = BlockPart(ReferenceBlock(RotationReference(inclination=0.2), sample_time=0.01).block())
    for case in (
        loop(plant=neck),
        loop(plant=neck, reference=wanted),
        loop(plant=neck, reference=wanted, order="jacobi"),
    ):
        _same(run_loop(case), run_loop(case, compiled=True))


def test_a_block_settles_once_for_all_parts_with_the_same_parameters(
    parts: dict[str, Block], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Block, dict[str, float]]] = []
    usual = Block.initial_state

    def counted(block: Block, **parameters: float) -> State:
        asked.append((block, parameters))
        return usual(block, **parameters)

    monkeypatch.setattr(Block, "initial_state", counted)
    block, stiffness = replace(parts["plant"]), {"bending_stiffness": 0.9}

    def started(parameters: dict[str, float]) -> list[bytes]:
        part = BlockPart(block)
        part.start(0.0, parameters)
        found = [values.tobytes() for values in part.memory]
        for values in part.memory:  # nobody else sees what becomes of them
            values[:] = 7.0
        return found

    first = started(stiffness)
    assert started(stiffness) == first != started({})
    assert asked == [(block, stiffness), (block, {})]
    # An object in Python may start otherwise each time.
    own = OwnStep(SimpleNamespace(initial_state=lambda: [float(len(asked))], step=lambda state, _: (state, [])), ())
    plain = Block(
        kind="own", role="filter", runtime=own_runtime(own), sample_time=1.0, arrays=(), inputs=(), outputs=()
    )
    part = BlockPart(plain)
    assert [part.start(0.0, {}).size + part.memory[1][0] for _ in range(2)] == [3.0, 4.0]


def test_progress_is_reported(loop: Callable[..., Loop]) -> None:
    plain: list[float] = []
    compiled: list[float] = []
    run_loop(loop(), plain.append)
    run_loop(loop(), compiled.append, compiled=True)
    assert compiled == plain


@pytest.mark.slow
def test_what_is_missing_is_named_as_ever(loop: Callable[..., Loop]) -> None:
    """A dropout without an observer: the line is the master's."""
    case = loop(observer=None, faults=(SensorFault(kind="dropout", start=0.4),))
    with pytest.raises(DataError, match=r"input `pitch` of the controller is nan at t = 0.4 s") as plain:
        run_loop(case)
    with pytest.raises(DataError, match="put an observer between") as compiled:
        run_loop(case, compiled=True)
    assert str(plain.value) == str(compiled.value)


def test_what_is_no_number_is_named_as_ever(loop: Callable[..., Loop], toy_blocks: Callable) -> None:
    """A gain beyond all bounds blows up within the run."""
    neck, pi = toy_blocks()
    wild = with_starts(pi, gain=1e300)
    case = loop(plant=BlockPart(neck), controller=BlockPart(wild), observer=None)
    errors = []
    for compiled in (False, True):
        with pytest.raises(DataError, match=r"became (nan|inf|-inf) in the step") as caught:
            run_loop(case, compiled=compiled)
        errors.append(str(caught.value))
    assert errors[0] == errors[1]


def test_watched_loops_run_in_python(loop: Callable[..., Loop]) -> None:
    seen: list[int] = []
    result = run_loop(loop(), compiled=True, on_step=lambda row: seen.append(row.index) or row.index == 9)
    assert seen == list(range(10))
    assert result.time.size == 10


class Counted(BlockPart):
    """A part that does more than its block."""

    calls = 0

    def advance(self, time: float, inputs: Vector) -> Vector:
        self.calls += 1
        return super().advance(time, inputs)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_part_with_an_advance_of_its_own_is_called(
    compiled: bool, loop: Callable[..., Loop], parts: dict[str, Block]
) -> None:
    observer = Counted(parts["observer"])
    _same(run_loop(loop()), run_loop(loop(observer=observer), compiled=compiled))
    assert observer.calls >= 100  # 2 s at 20 ms


def test_a_step_that_the_rows_compile_first_may_allocate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Rows count no references to arrays; numba hands its options down to what it compiles meanwhile.
    monkeypatch.setattr(_compile, "cache_folder", lambda: tmp_path)
    steps = _compile._import_text("import numpy as np\n\ndef step(n):\n    return np.zeros(n).size\n", compiled=True)
    rows = _compile._import_text("def rows(n):\n    return step(n)\n", compiled=True)
    _compile._compile(steps, ("step",))
    rows.step = steps.step  # pyright: ignore[reportAttributeAccessIssue]
    _compile._compile(rows, ("rows",), {"_nrt": False})
    assert rows.rows(7) == 7


def test_numba_resolves_each_call_once_for_our_functions_and_as_ever_for_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, resolved = BaseFunction.get_call_type, list[tuple]()

    def counted(function: Any, context: Any, args: Any, kws: Any) -> Any:
        resolved.append((function, args))
        return usual(function, context, args, kws)

    monkeypatch.setattr(_compile, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(_numba_inner, "_CALLS", {})
    monkeypatch.setattr(BaseFunction, "get_call_type", counted)
    text = "def inner(x, y):\n    return x * y * x\n\ndef power(x, y):\n    return inner(x, y) * x * y * x * y\n"
    made = _compile._import_text(text, compiled=True)
    _compile._compile(made, ("power",))
    # A whole number stays one, beside the float of the same name.
    assert [made.power(2.0, 3), made.power(2, 3)] == [432.0, 432]
    assert isinstance(made.power(2, 3), int)
    # Once for inner functions and once for those that Python calls, which have other flags.
    assert {resolved.count(call) for call in resolved} <= {1, 2}
    assert resolved
    made = _compile._import_text("def lost(x):\n    return x * None\n", compiled=True)
    _compile._compile(made, ("lost",))
    with pytest.raises(numba.TypingError):
        made.lost(2.0)
    assert "get_call_type" not in vars(Function)
    count = len(resolved)
    assert numba.njit(lambda x, y: x * y * x * y)(2.0, 3.0) == 36.0
    assert len(resolved) >= count + 3


_BORROWING = """
import numpy as np

def rest(p, k):
    return p[1][k:]

def scaled(p, x):
    x = x * p[0][0, 1]
    return x

def light(p, x, k):
    y = x[k:]
    return p[0][k] @ y[:2] if k > 9 else p[0][k, 1] * y[0] + p[1][1:][k]

def work(p, x, n):
    total = 0.0
    y = x
    for k in range(n):
        z = rest(p, k % 2)
        y = x[1:] if k % 3 == 0 else scaled(p, z)
        picked = p[0][np.array([1, 0])]
        total += light(p, y, 0) + z[0] + picked[0, 0] + y[-1]
        y[0] = total * 1e-3
    return total

def quick(p, x, k):
    return light(p, x, k)
"""


def test_compiled_functions_free_what_they_make_and_hold_what_they_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """References to arguments are not counted: those to all else are, and a view that is returned has its own."""
    from numba.core.runtime import _nrt_python  # pyright: ignore[reportAttributeAccessIssue]
    from numba.core.runtime.nrt import rtsys

    monkeypatch.setattr(_compile, "cache_folder", lambda: tmp_path)
    made, plain = (_compile._import_text(_BORROWING, compiled=True) for _ in range(2))
    _compile._compile(made, ("work", "rest", "quick"))

    def given() -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        return (np.arange(4.0).reshape(2, 2), np.arange(5.0, 9.0)), np.arange(1.0, 5.0)

    (p, x), (q, u) = given(), given()
    expected = plain.work(q, u, 50)
    counts = [sys.getrefcount(item) for item in (*p, x)]
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    # Products with BLAS are of two numbers: their sum has one order.
    assert made.work(p, x, 50) == expected
    assert x.tobytes() == u.tobytes()
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.mi_alloc - before.mi_alloc == after.mi_free - before.mi_free > 50
    assert [sys.getrefcount(item) for item in (*p, x)] == counts
    alone = sys.getrefcount(p[1])
    view = made.rest(p, 1)
    assert sys.getrefcount(p[1]) > alone
    del p
    assert view.tolist() == [6.0, 7.0, 8.0]
    (p, x) = given()
    assert made.quick(p, x, 0) == plain.quick(p, x, 0)
    if _numba_inner.pipelines() is not None:  # with the numba that was tested nothing is counted at all
        text = made.quick.inspect_llvm(made.quick.signatures[0])
        assert "call void @NRT_incref" not in text.split("define ")[1]
        # And LLVM knows that nobody else calls what is linked in: a function that is called once is put in its caller.
        assert "define linkonce_odr" not in made.work.inspect_llvm(made.work.signatures[0])
