"""Toy blocks, their FMUs, and a way to run one call by call."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

from softneck.fmu import build_fmu, unpacked

_TOYS = str(Path(__file__).with_name("toys"))
if _TOYS not in sys.path:
    sys.path.append(_TOYS)  # where the bundler finds the toy runtimes


@dataclass
class Running:
    """An instantiated FMU: fmpy's object, its variables by name, its log."""

    fmu: FMU2Slave
    references: dict[str, int]
    booleans: set[str]
    integers: set[str] = field(default_factory=set)
    log: list[tuple[int, str]] = field(default_factory=list)

    def set(self, **values: float) -> None:
        for name, value in values.items():
            if name in self.booleans:
                self.fmu.setBoolean([self.references[name]], [int(value)])
            elif name in self.integers:
                self.fmu.setInteger([self.references[name]], [int(value)])
            else:
                self.fmu.setReal([self.references[name]], [value])

    def get(self, *names: str) -> list[float]:
        kinds = {"booleans": self.fmu.getBoolean, "integers": self.fmu.getInteger}
        take = {
            name: next((f for kind, f in kinds.items() if name in getattr(self, kind)), self.fmu.getReal)
            for name in names
        }
        return [float(take[name]([self.references[name]])[0]) for name in names]

    def begin(self, start: float = 0.0, **parameters: float) -> None:
        self.fmu.setupExperiment(startTime=start)
        self.set(**parameters)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()


@contextmanager
def _running(path: Path) -> Iterator[Running]:
    with unpacked(path) as folder:
        model = fmpy.read_model_description(str(folder))
        assert model.coSimulation is not None
        fmu = FMU2Slave(
            guid=model.guid,
            unzipDirectory=str(folder),
            modelIdentifier=model.coSimulation.modelIdentifier,
            instanceName="test",
        )
        references = {v.name: v.valueReference for v in model.modelVariables}
        booleans, integers = (
            {v.name for v in model.modelVariables if v.type == kind} for kind in ("Boolean", "Integer")
        )
        running = Running(fmu, references, booleans, integers)
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(
            lambda _e, _i, status, _c, text: running.log.append((status, text.decode()))
        )
        fmu.instantiate(callbacks=callbacks, loggingOn=True)
        try:
            yield running
        finally:
            fmu.freeInstance()


@pytest.fixture
def running() -> Callable[[Path], AbstractContextManager[Running]]:
    return _running


@pytest.fixture(scope="session")
def toys() -> Any:
    return import_module("toy_blocks")


@pytest.fixture(scope="session")
def lag_fmu(toys: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(toys.lag(), tmp_path_factory.mktemp("lag") / "Lag.fmu")


@pytest.fixture(scope="session")
def controller_fmu(toys: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(toys.controller(), tmp_path_factory.mktemp("gain") / "Gain.fmu")


@pytest.fixture
def lag_inputs() -> np.ndarray:
    """(200, 3) inputs of the toy lag, some of its third ones missing."""
    generator = np.random.default_rng(7)
    u = generator.standard_normal((200, 3))
    u[:, 1] = generator.random(200) > 0.1
    u[generator.random(200) > 0.5, 2] = np.nan
    return u


@pytest.fixture(autouse=True)
def own_temporary_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpack FMUs where no test of another process does, so that leftovers can be counted."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("unpacked")))


@pytest.fixture(autouse=True)
def plain_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave numba out, so that an FMU equals the plain text to the bit; `test_compiled.py` lets it in."""
    monkeypatch.setenv("SOFTNECK_FMU_NUMBA", "0")
