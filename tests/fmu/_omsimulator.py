"""One FMU in OMSimulator: an SSP archive around it, whose parameter set holds its inputs; the table that it leaves."""

from __future__ import annotations

import csv
import os
import subprocess
import zipfile
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from softneck.runtime import Block, Port

_SSP = "http://ssp-standard.org/SSP1/SystemStructure"
_SPACES = {
    "xmlns:ssd": f"{_SSP}Description",
    "xmlns:ssc": f"{_SSP}Common",
    "xmlns:ssv": f"{_SSP}ParameterValues",
    "xmlns:oms": "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd",
}


def outputs_in_omsimulator(
    block: Block, fmu: Path, held: np.ndarray, rows: int, folder: Path, more: dict[str, str]
) -> np.ndarray:
    """Return the outputs (rows, outputs) after each step with the inputs `held`; OSError with what it said else.

    Its command line takes no signals for an FMU, and its exit code is 0 whatever it logs.
    """
    archive, out = folder / "one.ssp", folder / "out.csv"
    with zipfile.ZipFile(archive, "w") as members:
        members.writestr("SystemStructure.ssd", _structure(block, held, rows))
        members.write(fmu, "resources/part.fmu")
    places = [f"--workingDir={folder}", f"--tempDir={folder}", f"--resultFile={out}"]
    command = ["OMSimulator", *places, f"--stopTime={rows * block.sample_time!r}", str(archive)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=os.environ | more)
    said = [line for line in (done.stdout + done.stderr).splitlines() if line.startswith("error:")]
    if done.returncode != 0 or said or not out.is_file():
        raise OSError(f"exit code {done.returncode}: {' '.join(said)[:200]}")
    with out.open(newline="") as file:
        head, *lines = csv.reader(file)
    table = np.array([[float(cell) for cell in line if cell] for line in lines])
    # Each moment stands there before and after the step to it; the second counts.
    moments = np.arange(1, rows + 1) * block.sample_time
    last = np.searchsorted(table[:, 0], moments + 1e-9) - 1
    found = [next(i for i, name in enumerate(head) if name.endswith(f".{port.name}")) for port in block.outputs]
    return table[last][:, found]


def _structure(block: Block, held: np.ndarray, rows: int) -> bytes:
    root = Element("ssd:SystemStructureDescription", {**_SPACES, "name": "one", "version": "1.0"})
    system = SubElement(root, "ssd:System", {"name": "root"})
    head = {"name": "part", "type": "application/x-fmu-sharedlibrary", "source": "resources/part.fmu"}
    component = SubElement(SubElement(system, "ssd:Elements"), "ssd:Component", head)
    connectors = SubElement(component, "ssd:Connectors")
    for kind, ports in (("input", block.inputs), ("output", block.outputs)):
        for port in ports:
            connector = SubElement(connectors, "ssd:Connector", {"name": port.name, "kind": kind})
            SubElement(connector, f"ssc:{_type(port)}")
    binding = SubElement(SubElement(component, "ssd:ParameterBindings"), "ssd:ParameterBinding")
    table = SubElement(
        SubElement(binding, "ssd:ParameterValues"), "ssv:ParameterSet", {"version": "1.0", "name": "held"}
    )
    parameters = SubElement(table, "ssv:Parameters")
    for port, value in zip(block.inputs, held, strict=True):
        if np.isfinite(value):  # NaN, "not measured", is what the FMU starts with
            text = ("true" if value else "false") if port.boolean else repr(float(value))
            parameter = SubElement(parameters, "ssv:Parameter", {"name": port.name})
            SubElement(parameter, f"ssv:{_type(port)}", {"value": text})
    note = SubElement(SubElement(system, "ssd:Annotations"), "ssc:Annotation", {"type": "org.openmodelica"})
    information = SubElement(SubElement(note, "oms:Annotations"), "oms:SimulationInformation")
    master = {"description": "oms-ma", "stepSize": repr(block.sample_time)}
    SubElement(information, "oms:FixedStepMaster", {**master, "absoluteTolerance": "1e-4", "relativeTolerance": "1e-4"})
    stop = {"startTime": "0", "stopTime": repr(rows * block.sample_time)}
    SubElement(root, "ssd:DefaultExperiment", stop)
    return tostring(root, encoding="utf-8", xml_declaration=True)


def _type(port: Port) -> str:
    return "Boolean" if port.boolean else "Real"
