"""What an FMU says of its outputs' dependencies is what they do: an input that is set shows in none before a step."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any, cast

import fmpy
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Slave
from fmpy.model_description import ModelDescription

from softneck.fmu import build_compiled_fmu, build_fmu, unpacked
from softneck.loop import ReferenceBlock
from softneck.runtime import Block

from ..data import slow_but
from ..references import StepReference
from .conftest import Running
from .every_kind import KINDS, NATIVE, TS, block_of, inputs_of

needs_cc = pytest.mark.skipif(shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here")


QUICK = ("rls", "kalman", "pi", "reference")


def _others_at_night(kinds: list[str]) -> list[Any]:
    """One of each sort at once: models take their time to be fitted."""
    return slow_but([*kinds, "reference"], QUICK, set(kinds) - set(QUICK))


class Running3(Running):
    """The same few calls for FMI 3.0."""

    fmu: Any

    def set(self, **values: float) -> None:
        for name, value in values.items():
            if name == "noise_seed":
                self.fmu.setInt32([self.references[name]], [int(value)])
            elif name in self.booleans:
                self.fmu.setBoolean([self.references[name]], [bool(value)])
            else:
                self.fmu.setFloat64([self.references[name]], [value])

    def get(self, *names: str) -> list[float]:
        take = {name: self.fmu.getBoolean if name in self.booleans else self.fmu.getFloat64 for name in names}
        return [float(take[name]([self.references[name]])[0]) for name in names]


def _of(kind: str) -> Block:
    if kind == "reference":
        return ReferenceBlock(StepReference(pitch=0.1, at=0.04), sample_time=TS, duration=1.0).block()
    return block_of(kind)


def _declared(model: ModelDescription) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Return output -> variables it depends on: in a step, and at the start; none stated means all, which none does."""
    tables = []
    for unknowns in (model.outputs, model.initialUnknowns):
        table: dict[str, set[str]] = {}
        for unknown in unknowns:
            assert unknown.variable is not None
            assert unknown.dependencies is not None
            table[unknown.variable.name] = {v.name for v in unknown.dependencies}
        tables.append(table)
    return tables[0], tables[1]


def _other(port: Any) -> float:
    """Return a value that is allowed and far from the start."""
    if port.boolean:
        return 1.0 - port.start
    low = -0.7 if port.minimum is None else port.minimum
    high = low + 1.4 if port.maximum is None else port.maximum
    return high if abs(high - port.start) > abs(low - port.start) else low


def _assert_true(fmu: Running, model: ModelDescription, block: Block) -> None:
    """Perturb every input at the start and behind a few steps: exactly what was declared changes."""
    outputs = [port.name for port in block.outputs]
    in_steps, at_start = _declared(model)
    assert set(in_steps) == set(at_start) == set(outputs)
    u = inputs_of(block, 4, missing=False)
    for k in range(-1, len(u)):
        if k >= 0:
            fmu.set(**dict(zip([port.name for port in block.inputs], u[k], strict=True)))
            fmu.fmu.doStep(k * TS, TS)
        before = np.array(fmu.get(*outputs))
        for port in block.inputs:
            fmu.set(**{port.name: _other(port)})
            changed = {name for name, a, b in zip(outputs, before, fmu.get(*outputs), strict=True) if a != b}
            assert changed == {name for name in outputs if port.name in in_steps[name]}, (port.name, k)


def _assert_starts(fmu: Running, model: ModelDescription, block: Block) -> None:
    """In the initialisation an output changes with what it is declared to depend on, and with nothing else."""
    outputs = [port.name for port in block.outputs]
    at_start = _declared(model)[1]
    before = fmu.get(*outputs)
    for port in (*block.inputs, *block.parameters):
        fmu.set(**{port.name: _other(port)})
        changed = {name for name, a, b in zip(outputs, before, fmu.get(*outputs), strict=True) if a != b}
        assert changed <= {name for name in outputs if port.name in at_start[name]}, port.name
        fmu.set(**{port.name: port.start})


@pytest.mark.parametrize("kind", _others_at_night(list(KINDS)))
def test_dependencies_of_python_fmus(kind: str, tmp_path: Path, running: Any) -> None:
    block = _of(kind)
    path = build_fmu(block, tmp_path / "Model.fmu")
    model = fmpy.read_model_description(str(path))
    with running(path) as fmu:
        fmu.fmu.setupExperiment(startTime=0.0)
        fmu.fmu.enterInitializationMode()
        _assert_starts(fmu, model, block)
        fmu.fmu.exitInitializationMode()
        _assert_true(fmu, model, block)


@needs_cc
@pytest.mark.parametrize("kind", _others_at_night(NATIVE))
def test_dependencies_of_compiled_fmus(kind: str, tmp_path: Path, running: Any) -> None:
    block = _of(kind)
    build_compiled_fmu(block, tmp_path / "Model.fmu")
    model = fmpy.read_model_description(str(tmp_path / "Model.fmu"))
    with running(tmp_path / "Model.fmu") as fmu:
        fmu.fmu.setupExperiment(startTime=0.0)
        fmu.fmu.enterInitializationMode()
        _assert_starts(fmu, model, block)
        fmu.fmu.exitInitializationMode()
        _assert_true(fmu, model, block)


@needs_cc
@pytest.mark.parametrize("kind", _others_at_night(NATIVE))
def test_dependencies_of_fmi3(kind: str, tmp_path: Path) -> None:
    block = _of(kind)
    build_compiled_fmu(block, tmp_path / "Model.fmu", fmi=3)
    with unpacked(tmp_path / "Model.fmu") as folder:
        model = fmpy.read_model_description(str(folder))
        fmu = FMU3Slave(guid=model.guid, unzipDirectory=str(folder), modelIdentifier="Model", instanceName="three")
        fmu.instantiate()
        references = {v.name: v.valueReference for v in model.modelVariables}
        three = Running3(cast(Any, fmu), references, {v.name for v in model.modelVariables if v.type == "Boolean"})
        fmu.enterInitializationMode(startTime=0.0)
        _assert_starts(three, model, block)
        fmu.exitInitializationMode()
        _assert_true(three, model, block)
        fmu.freeInstance()
