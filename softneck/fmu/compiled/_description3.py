"""`modelDescription.xml` of FMI 3.0 (section 2.4): the same variables as in FMI 2.0, with `time` behind them."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softneck.runtime import Block, Port

from ..describe._description import (
    Identity,
    add_unit_definitions,
    check_names,
    head_texts,
    range_attributes,
    start_attribute,
    unit_attributes,
)
from ..describe._documentation import FmuInfo

_TIME = "time"


def model_description3(block: Block, info: FmuInfo, identity: Identity) -> bytes:
    """Return the XML text of the model description of FMI 3.0.

    Raises:
        SettingsError: two ports of one name, or one that is called `time`.
    """
    check_names(block, reserved=_TIME)
    head = {
        "fmiVersion": "3.0",
        "modelName": identity.name,
        "instantiationToken": identity.guid,
        "generationTool": identity.tool or "softneck",
        "generationDateAndTime": identity.date,
        "variableNamingConvention": "structured",
    }
    root = Element("fmiModelDescription", head | head_texts(block, info))
    yes = ("canHandleVariableCommunicationStepSize", "canGetAndSetFMUState", "canSerializeFMUState")
    yes += ("providesDirectionalDerivatives",) if identity.ahead else ()
    fixed = {"modelIdentifier": identity.name, "fixedInternalStepSize": repr(float(block.sample_time))}
    SubElement(root, "CoSimulation", fixed | dict.fromkeys(yes, "true"))
    add_unit_definitions(root, block)
    categories = SubElement(root, "LogCategories")
    for name, text in (("logStatusWarning", "Warnings"), ("logStatusError", "Errors")):
        SubElement(categories, "Category", name=name, description=text)
    times = {"startTime": "0", "stopTime": repr(float(info.stop_time)), "stepSize": repr(float(block.sample_time))}
    SubElement(root, "DefaultExperiment", times)
    _variables(root, block)
    _structure(root, block, identity.ahead)
    _annotation(root, block, info)
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def _variables(root: Element, block: Block) -> None:
    table = SubElement(root, "ModelVariables")
    reference = 0
    for causality, ports in (("input", block.inputs), ("output", block.outputs), ("parameter", block.parameters)):
        for port in ports:
            _variable(table, port, causality, reference)
            reference += 1
    head = {"name": _TIME, "valueReference": str(reference), "causality": "independent", "variability": "continuous"}
    SubElement(table, "Float64", head | {"description": "Simulation time"})


def _variable(table: Element, port: Port, causality: str, reference: int) -> None:
    variability = {"input": "discrete" if port.boolean else "continuous", "output": "discrete", "parameter": "fixed"}
    head = {"name": port.name, "valueReference": str(reference), "causality": causality}
    head["variability"] = variability[causality]
    if causality != "input":
        head["initial"] = "calculated" if causality == "output" else "exact"
    if port.description:
        head["description"] = port.description
    start = {} if causality == "output" else {"start": start_attribute(port)}
    if port.boolean:
        SubElement(table, "Boolean", head | start)
    elif port.integer:
        numbers = {name: str(int(float(text))) for name, text in (range_attributes(port) | start).items()}
        SubElement(table, "Int64", head | numbers)
    else:
        SubElement(table, "Float64", head | unit_attributes(port) | range_attributes(port) | start)


def _structure(root: Element, block: Block, ahead: int) -> None:
    structure = SubElement(root, "ModelStructure")
    n_in, n_out = len(block.inputs), len(block.outputs)
    first = n_in + n_out
    parameters, inputs = [str(first + i) for i in range(len(block.parameters))], [str(i) for i in range(n_in)]
    # As in FMI 2.0: an input shows in no output before the next communication step, but in those of the next sample.
    for tag, known in (("Output", []), ("InitialUnknown", parameters)):
        for i in range(n_out):
            all_known = [*inputs, *known] if i >= n_out - ahead else known
            SubElement(structure, tag, valueReference=str(n_in + i), dependencies=" ".join(all_known))


def _annotation(root: Element, block: Block, info: FmuInfo) -> None:
    missing = [port.name for port in (*block.inputs, *block.outputs, *block.parameters) if port.missing]
    facts = {"kind": block.kind, "role": block.role, "sampleTime": repr(float(block.sample_time))}
    if info.robot is not None:
        facts |= {"robot": info.robot[0], "robotHash": info.robot[1]}
    note = SubElement(SubElement(root, "Annotations"), "Annotation", type="softneck")
    SubElement(note, "Block", facts | {"missing": " ".join(missing)})
