"""Model Exchange of compiled FMUs: equal to Co-Simulation to the bit, with any solver and step."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Model, FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

from softneck.core import FileFormatError, SettingsError
from softneck.cosim import FmuPart, interfaces_of
from softneck.cosim.loops._write_ssp import block_without_python
from softneck.fmu import build_compiled_fmu, build_fmu, unpacked
from softneck.runtime import Block

from ..data import slow_but
from .every_kind import NATIVE, TS, as_block, block_of, inputs_of

ROWS = 25
pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)


def _stepped(fmu: Any, block: Block, u: np.ndarray) -> np.ndarray:
    """Return what Co-Simulation shows at each sample: a plant's outputs at it, those of others that it causes."""
    names = [port.name for port in block.outputs]
    seen = [fmu.get(*names)]
    for k, row in enumerate(u):
        fmu.set(**dict(zip([port.name for port in block.inputs], row, strict=True)))
        fmu.fmu.doStep(k * TS, TS)
        seen.append(fmu.get(*names))
    return np.array(seen[:-1] if block.role == "plant" else seen[1:])


def _signals(block: Block, u: np.ndarray) -> np.ndarray:
    """Return `u` as fmpy's inputs, constant around each sample: a solver's rounded time changes no value."""
    types = [("time", float), *((port.name, bool if port.boolean else float) for port in block.inputs)]
    table = np.zeros(2 * len(u), dtype=types)
    table["time"] = np.repeat(np.arange(len(u)) * TS, 2) + np.tile([-0.25 * TS, 0.25 * TS], len(u))
    for i, port in enumerate(block.inputs):
        table[port.name] = np.repeat(u[:, i], 2)
    return table


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("kind", slow_but(NATIVE, ("rls", "kalman", "pi")))
def test_model_exchange_equals_co_simulation_to_the_bit(kind: str, fmi: int, tmp_path: Path, running: Any) -> None:
    block = block_of(kind)
    u = inputs_of(block, ROWS, missing=fmi == 2)
    for version in {2, fmi}:
        build_compiled_fmu(block, tmp_path / f"M{version}.fmu", fmi=version)
    with running(tmp_path / "M2.fmu") as fmu:
        fmu.begin(**as_block(block))
        expected = _stepped(fmu, block, u)
    solvers = [("Euler", TS), ("Euler", 0.3 * TS), ("Euler", 2.5 * TS), ("CVode", TS)]
    for solver, step in solvers:
        result: Any = fmpy.simulate_fmu(
            str(tmp_path / f"M{fmi}.fmu"), fmi_type="ModelExchange", solver=solver, step_size=step,
            output_interval=step, stop_time=(ROWS - 0.5) * TS, input=_signals(block, u), record_events=True,
            start_values={name: bool(value) for name, value in as_block(block).items()},
            output=[port.name for port in block.outputs],
        )  # fmt: skip
        # The last row of a time is that after its event.
        samples = result["time"] / TS
        after = {round(n): i for i, n in enumerate(samples) if abs(n - round(n)) < 1e-6}  # times are rounded sums
        assert sorted(after) == list(range(ROWS)), (solver, step)
        seen = [[float(result[port.name][after[n]]) for port in block.outputs] for n in range(ROWS)]
        np.testing.assert_array_equal(np.array(seen), expected, err_msg=f"{solver}, step {step}")


@contextmanager
def _model(path: Path, log: list[str], kind: type = FMU2Model) -> Iterator[Any]:
    with unpacked(path) as folder:
        model = fmpy.read_model_description(str(folder))
        fmu = kind(guid=model.guid, unzipDirectory=str(folder), modelIdentifier=path.stem, instanceName="me")
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(lambda _e, _i, _s, _c, text: log.append(text.decode()))
        fmu.instantiate(callbacks=callbacks, loggingOn=True)
        try:
            yield fmu
        finally:
            fmu.freeInstance()


def _begin(fmu: Any, start: float = 0.0) -> None:
    fmu.setupExperiment(startTime=start)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()


@pytest.mark.parametrize("kind", ["rls", "pi"])
def test_an_event_iteration_takes_the_sample_from_its_saved_state(kind: str, tmp_path: Path) -> None:
    block = block_of(kind)
    path = tmp_path / "M.fmu"
    build_compiled_fmu(block, path)
    reals = [i for i, port in enumerate(block.inputs) if not port.boolean]
    outputs = [len(block.inputs) + i for i, port in enumerate(block.outputs) if not port.boolean]
    u = inputs_of(block, 20, missing=False)[:, reals]

    def event(fmu: Any, n: int, rows: list[np.ndarray]) -> list[float]:
        if n:
            fmu.enterContinuousTimeMode()
            fmu.setTime(0.1 + n * TS)
            fmu.enterEventMode()
        for row in rows:
            fmu.setReal(reals, row)
            needed = [fmu.newDiscreteStates()[0] for _ in range(2)]
            assert needed == [block.role != "plant", False]  # the same inputs again change nothing
        return list(fmu.getReal(outputs))

    with _model(path, []) as plain, _model(path, []) as iterated, _model(path, []) as resumed:
        for fmu in (plain, iterated, resumed):
            _begin(fmu, 0.1)
        expected = [event(plain, n, [row]) for n, row in enumerate(u)]
        for n, row in enumerate(u[:10]):
            assert event(iterated, n, [-row, 0.5 * row, row]) == expected[n]
        # In the middle of an event: the saved state is part of the FMU's state.
        event(iterated, 10, [-u[10]])
        resumed.setFMUstate(resumed.deSerializeFMUstate(iterated.serializeFMUstate(iterated.getFMUstate())))
        for fmu in (iterated, resumed):
            fmu.setReal(reals, u[10])
            fmu.newDiscreteStates()
            assert list(fmu.getReal(outputs)) == expected[10]
            assert [event(fmu, n, [u[n]]) for n in range(11, 20)] == expected[11:]


def test_the_next_event_is_counted_and_not_summed(tmp_path: Path) -> None:
    build_compiled_fmu(block_of("pi"), tmp_path / "M.fmu")
    with _model(tmp_path / "M.fmu", []) as fmu:
        _begin(fmu, 0.1)
        times = []
        for _ in range(300):
            info = fmu.newDiscreteStates()
            info = fmu.newDiscreteStates() if info[0] else info
            times.append(info[5])
            fmu.enterContinuousTimeMode()
            fmu.setTime(info[5])
            fmu.enterEventMode()
    assert times == [0.1 + n * TS for n in range(1, 301)]
    assert times[-1] != sum([TS] * 300, start=0.1)


def test_inputs_between_events_and_inputs_that_never_settle(tmp_path: Path) -> None:
    build_compiled_fmu(block_of("pi"), tmp_path / "M.fmu")
    first = len(block_of("pi").inputs)
    log: list[str] = []
    with _model(tmp_path / "M.fmu", log) as fmu:
        _begin(fmu)
        while fmu.newDiscreteStates()[0]:
            pass
        fmu.enterContinuousTimeMode()
        held = fmu.getReal([first])
        fmu.setTime(0.5 * TS)
        fmu.setReal([0], [0.3])
        assert fmu.getReal([first]) == held
        with pytest.raises(FMICallException):
            fmu.newDiscreteStates()
        assert "in event mode only" in log[-1]
        fmu.setTime(TS)
        fmu.enterEventMode()
        for n in range(1000):
            fmu.setReal([0], [1e-4 * n])
            fmu.newDiscreteStates()
        fmu.setReal([0], [0.2])
        with pytest.raises(FMICallException):
            fmu.newDiscreteStates()
        assert "do not settle" in log[-1]


def test_calls_of_the_other_interface_are_refused(tmp_path: Path) -> None:
    build_compiled_fmu(block_of("pi"), tmp_path / "M.fmu")
    log: list[str] = []
    with _model(tmp_path / "M.fmu", log, FMU2Slave) as fmu:
        _begin(fmu)
        enter = fmu.dll["fmi2EnterEventMode"]
        enter.argtypes = [ctypes.c_void_p]
        assert enter(fmu.component) == 3
        assert "fmi2EnterEventMode is of Model Exchange" in log[-1]
    with _model(tmp_path / "M.fmu", log) as fmu:
        _begin(fmu)
        step = fmu.dll["fmi2DoStep"]
        step.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int]
        assert step(fmu.component, 0.0, TS, 1) == 3
        assert "for Model Exchange, which has no communication steps" in log[-1]
        with pytest.raises(FMICallException):
            fmu.getContinuousStates((ctypes.c_double * 1)(), 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rls", "pi"])
def test_sensitivities_are_those_of_co_simulation(kind: str, tmp_path: Path) -> None:
    """A plant's later outputs are those of the event's own sample, a controller's those of the sample behind it."""
    block = block_of(kind)
    build_compiled_fmu(block, tmp_path / "M.fmu", sensitivities=True)
    reals = [i for i, port in enumerate(block.inputs) if not port.boolean]
    model = fmpy.read_model_description(str(tmp_path / "M.fmu"))
    ahead = [v.valueReference for v in model.modelVariables if v.name.endswith(("_next", "_ahead"))]
    u, expected = inputs_of(block, 12, missing=False)[:, reals], []

    def look(fmu: Any, row: np.ndarray) -> list[float]:
        fmu.setReal(reals, row)
        moved = [fmu.getDirectionalDerivative(ahead, [i], [1.0]) for i in reals]
        return [*fmu.getReal(ahead), *np.ravel(moved)]

    with _model(tmp_path / "M.fmu", [], FMU2Slave) as stepped, _model(tmp_path / "M.fmu", []) as events:
        _begin(stepped)
        _begin(events)
        for n, row in enumerate(u):
            expected = look(stepped, row)
            if kind == "rls":  # before and after the sample is taken, here with other inputs first
                assert look(events, row) == expected
                look(events, -row)
                events.newDiscreteStates()
                assert look(events, row) == expected
            elif n:
                assert look(events, row) == expected
            stepped.doStep(n * TS, TS)
            events.setReal(reals, row)
            if kind == "pi" and n:
                events.enterContinuousTimeMode()
                events.setTime(n * TS)
                events.enterEventMode()
            events.newDiscreteStates()
            if kind == "rls":
                events.enterContinuousTimeMode()
                events.setTime((n + 1) * TS)
                events.enterEventMode()
    assert kind == "rls" or any(expected[len(ahead) :])


def _only_exchange(path: Path, target: Path, more: tuple[bytes, bytes] = (b"", b"")) -> Path:
    """Copy an FMU without its Co-Simulation: as another tool's that has none."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                data = re.sub(rb"<CoSimulation [^>]*(?:/>|>.*?</CoSimulation>)", b"", data, flags=re.DOTALL).replace(
                    *more
                )
            new.writestr(name, data)
    return target


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("kind", ["rls", "pi"])
def test_a_part_steps_a_model_exchange_fmu_as_its_co_simulation(kind: str, fmi: int, tmp_path: Path) -> None:
    block = block_of(kind)
    build_compiled_fmu(block, tmp_path / "M.fmu", fmi=fmi)
    (tmp_path / "me").mkdir()
    other = _only_exchange(tmp_path / "M.fmu", tmp_path / "me" / "M.fmu")
    model = fmpy.read_model_description(str(tmp_path / "M.fmu"))
    assert interfaces_of(model) == ["Model Exchange", "Co-Simulation"]
    u = inputs_of(block, ROWS)
    with FmuPart(tmp_path / "M.fmu") as stepped, FmuPart(other) as events:
        np.testing.assert_array_equal(events.start(0.1, {}), stepped.start(0.1, {}))
        saved, expected, last = b"", np.zeros(0), np.ones(0)
        for k, row in enumerate(u):
            if k == 10:
                saved = events.get_state()
            expected = stepped.advance(0.1 + k * TS, row)
            np.testing.assert_array_equal(events.advance(0.1 + k * TS, row), expected)
        events.set_state(saved)
        for k, row in enumerate(u[10:], start=10):
            last = events.advance(0.1 + k * TS, row)
        np.testing.assert_array_equal(last, expected)
    with pytest.raises(SettingsError, match="Model Exchange only"):
        block_without_python(other)


def test_fmus_that_need_a_solver_are_refused_in_one_line(tmp_path: Path) -> None:
    build_compiled_fmu(block_of("pi"), tmp_path / "M.fmu")
    (tmp_path / "me").mkdir()
    more = (b'numberOfEventIndicators="0"', b'numberOfEventIndicators="2"')
    path = _only_exchange(tmp_path / "M.fmu", tmp_path / "me" / "M.fmu", more)
    with pytest.raises(FileFormatError, match="Model Exchange only and has 2 event indicators, which need a solver"):
        FmuPart(path)


def test_python_fmus_are_for_co_simulation(tmp_path: Path) -> None:
    path = build_fmu(block_of("pi"), tmp_path / "M.fmu")
    assert interfaces_of(fmpy.read_model_description(str(path))) == ["Co-Simulation"]
