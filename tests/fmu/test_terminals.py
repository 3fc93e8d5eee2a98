"""Terminals: valid by the standard's schema, of variables that there are, and fitting from FMU to FMU."""

from __future__ import annotations

import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import pytest
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - it has no stubs

from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.fmu.describe._description import TERMINALS, terminals
from softneck.loop import ReferenceBlock
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block

from ..references import StepReference
from .every_kind import TS, block_of

SCHEMAS = Path(fmpy.__file__).parent / "schema" / "fmi3"
needs_cc = pytest.mark.skipif(shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here")


def _reference() -> Block:
    return ReferenceBlock(StepReference(pitch=0.1), sample_time=TS, duration=1.0).block()


def valid(path: Path, member: str, schema: str) -> Any:
    """Return the root of a member of an FMU, which holds to a schema of FMI 3.0."""
    with zipfile.ZipFile(path) as archive:
        root = etree.fromstring(archive.read(member))
    checker = etree.XMLSchema(etree.parse(str(SCHEMAS / schema)))
    assert checker.validate(root), checker.error_log
    return root


@pytest.mark.parametrize(
    "how", ["python", pytest.param("compiled 2", marks=needs_cc), pytest.param("3", marks=needs_cc)]
)
def test_terminals_hold_to_the_schema_and_name_variables(how: str, tmp_path: Path) -> None:
    path = tmp_path / "Kalman.fmu"
    if how == "python":
        build_fmu(block_of("kalman"), path)
    else:
        build_compiled_fmu(block_of("kalman"), path, fmi=int(how[-1]))
    root = valid(path, TERMINALS, "fmi3TerminalsAndIcons.xsd")
    known = {v.name: v.causality for v in fmpy.read_model_description(str(path)).modelVariables}
    members = [member.attrib for member in root.iter("TerminalMemberVariable")]
    assert {known[member["variableName"]] for member in members} == {"input", "output"}
    assert all(member["memberName"] and member["variableKind"] == "signal" for member in members)  # as `bus` wants it
    names = [terminal.get("name") for terminal in root.iter("Terminal")]
    assert names == ["motors", "angles", "measurement"]


def test_what_belongs_together_has_the_same_names_everywhere() -> None:
    plant = terminals(VirtualNeck(NeckParameters.paper()).block())
    observer, controller, reference = (
        terminals(block) for block in (block_of("kalman"), block_of("pi"), _reference())
    )  # fmt: skip
    motors = [f"motor_{what}_{j}" for what in ("setpoint", "position") for j in (1, 2, 3)]
    assert sorted(plant["motors"]) == sorted(controller["motors"]) == sorted(motors)
    assert set(observer["motors"]) < set(motors)
    assert set(observer["measurement"]) <= set(plant["measurement"])
    assert {"pitch", "roll"} == set(plant["angles"])
    assert set(controller["angles"]) == {"pitch", "roll", "healthy"} <= set(observer["angles"])
    assert set(controller["reference"]) == set(reference["reference"])
    assert set(terminals(block_of("rls"))) == {"motors", "angles", "measurement"}


@needs_cc
def test_fmi3_says_how_it_is_compiled_and_how_it_steps(tmp_path: Path) -> None:
    path = tmp_path / "Pi.fmu"
    build_compiled_fmu(block_of("pi"), path, fmi=3)
    (files,) = valid(path, "sources/buildDescription.xml", "fmi3BuildDescription.xsd").iter("SourceFileSet")
    assert (files.get("compiler"), bool(files.get("compilerOptions"))) == ("gcc", True)  # VDMCheck3, rule 1053
    experiment = fmpy.read_model_description(str(path)).coSimulation
    assert experiment is not None
    assert float(experiment.fixedInternalStepSize or 0.0) == TS
