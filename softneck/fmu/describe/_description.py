"""`modelDescription.xml` of a block (FMI 2.0.4, section 2.2): what pythonfmu leaves out and importers need.

Value references and indices count inputs, outputs, parameters, as the slave does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib.metadata import version
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softneck import __version__
from softneck.core import SettingsError
from softneck.runtime import Block, Port

from ._documentation import FmuInfo
from ._modelled_drives import with_modelled_drives
from ._units import base_exponents, display_unit

# Paper, section 3: the neck tilts up to 0.7 rad or so; more in a reference is nearly always degrees.
REFERENCE_LIMIT = 0.8
_NONE = ("", "1")


@dataclass(frozen=True, slots=True)
class Identity:
    """Name, GUID and generation date of one FMU, and what runs in it.

    Attributes:
        name, guid, date: as FMI means them.
        tool: what built it; None for pythonfmu.
        sources: files that a compiler takes to rebuild it; none where Python runs in it.
        ahead: how many of the last outputs are the first ones at the next sample, with their derivatives.
    """

    name: str
    guid: str
    date: str
    tool: str | None = None
    sources: tuple[str, ...] = ()
    ahead: int = 0


def described_block(block: Block) -> Block:
    """Return `block` as its FMU holds it: a controller with the drives inside, references with a range."""
    whole = with_modelled_drives(block)
    return replace(whole, inputs=tuple(_with_reference_range(port) for port in whole.inputs))


def generation_tool() -> str:
    """Return the name and version of what builds the FMU."""
    return f"softneck {__version__} (PythonFMU {version('pythonfmu')})"


def model_description(block: Block, info: FmuInfo, identity: Identity) -> bytes:
    """Return the XML text of the model description.

    Raises:
        SettingsError: two ports of one name.
    """
    check_names(block)
    root = Element("fmiModelDescription", _head(block, info, identity))
    _co_simulation(root, identity)
    add_unit_definitions(root, block)
    categories = SubElement(root, "LogCategories")
    for name, text in (("logStatusWarning", "Warnings"), ("logStatusError", "Errors"), ("logAll", "Everything")):
        SubElement(categories, "Category", name=name, description=text)
    times = {"startTime": "0", "stopTime": repr(float(info.stop_time)), "stepSize": repr(float(block.sample_time))}
    SubElement(root, "DefaultExperiment", times)
    _annotation(root, block, info)
    _variables(root, block)
    _structure(root, block, identity.ahead)
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def _with_reference_range(port: Port) -> Port:
    reference = port.name.endswith("_reference") and port.unit == "rad"
    if not reference or port.minimum is not None or port.maximum is not None:
        return port
    return replace(port, minimum=-REFERENCE_LIMIT, maximum=REFERENCE_LIMIT)


def check_names(block: Block, reserved: str = "") -> None:
    """Refuse two variables of one name; `reserved` is one that is taken already."""
    names = [port.name for port in (*block.inputs, *block.outputs, *block.parameters)] + [reserved] * bool(reserved)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SettingsError(f"{block.kind}: an FMU variable needs one name of its own; twice: {', '.join(twice)}.")


def _head(block: Block, info: FmuInfo, identity: Identity) -> dict[str, str]:
    return {
        "fmiVersion": "2.0",
        "modelName": identity.name,
        "guid": identity.guid,
        "generationTool": identity.tool or generation_tool(),
        "generationDateAndTime": identity.date,
        "variableNamingConvention": "structured",
        "numberOfEventIndicators": "0",
    } | head_texts(block, info)


def head_texts(block: Block, info: FmuInfo) -> dict[str, str]:
    """Return the attributes that say what the FMU is, without the empty ones."""
    texts = {
        "description": info.description or f"{block.kind} ({block.role}), sample time {block.sample_time:g} s",
        "author": info.author,
        "version": info.version,
        "copyright": info.copyright,
        "license": info.license,
    }
    return {name: text for name, text in texts.items() if text}


def _co_simulation(root: Element, identity: Identity) -> None:
    yes = (
        "canHandleVariableCommunicationStepSize",
        "canNotUseMemoryManagementFunctions",
        "canGetAndSetFMUstate",
        "canSerializeFMUstate",
    )
    python = {} if identity.sources else {"needsExecutionTool": "true"}  # the Python of the host
    yes += ("providesDirectionalDerivative",) if identity.ahead else ()
    attributes = {"modelIdentifier": identity.name} | python | dict.fromkeys(yes, "true")
    element = SubElement(root, "CoSimulation", attributes)
    if identity.sources:
        files = SubElement(element, "SourceFiles")
        for name in identity.sources:
            SubElement(files, "File", name=name)


def add_unit_definitions(root: Element, block: Block) -> None:
    """Add the units that the variables use; FMI 2 and 3 write them alike."""
    ports = [port for port in (*block.inputs, *block.outputs, *block.parameters) if _has_unit(port)]
    used = sorted({port.unit for port in ports})
    if not used:
        return
    definitions = SubElement(root, "UnitDefinitions")
    for name in used:
        unit = SubElement(definitions, "Unit", name=name)
        base = base_exponents(name)
        if base:
            SubElement(unit, "BaseUnit", base)
        shown = {display_unit(port) for port in ports if port.unit == name}
        for display, factor in sorted(pair for pair in shown if pair[0] != name):
            SubElement(unit, "DisplayUnit", name=display, factor=repr(factor))


def _annotation(root: Element, block: Block, info: FmuInfo) -> None:
    # For our own tools: FMI has no place for the role, nor for "NaN means not measured".
    missing = [port.name for port in (*block.inputs, *block.outputs, *block.parameters) if port.missing]
    facts = {"kind": block.kind, "role": block.role, "sampleTime": repr(float(block.sample_time))}
    if info.robot is not None:
        facts |= {"robot": info.robot[0], "robotHash": info.robot[1]}
    tool = SubElement(SubElement(root, "VendorAnnotations"), "Tool", name="softneck")
    SubElement(tool, "Block", facts | {"missing": " ".join(missing)})


def _variables(root: Element, block: Block) -> None:
    table = SubElement(root, "ModelVariables")
    reference = 0
    for causality, ports in (("input", block.inputs), ("output", block.outputs), ("parameter", block.parameters)):
        for port in ports:
            _variable(table, port, causality, reference)
            reference += 1


def _variable(table: Element, port: Port, causality: str, reference: int) -> None:
    variability = {"input": "discrete" if port.boolean else "continuous", "output": "discrete", "parameter": "fixed"}
    head = {"name": port.name, "valueReference": str(reference), "causality": causality}
    head["variability"] = variability[causality]
    if causality != "input":
        head["initial"] = "calculated" if causality == "output" else "exact"
    if port.description:
        head["description"] = port.description
    variable = SubElement(table, "ScalarVariable", head)
    start = {} if causality == "output" else {"start": start_attribute(port)}
    if port.boolean:
        SubElement(variable, "Boolean", start)
    else:
        SubElement(variable, "Real", unit_attributes(port) | range_attributes(port) | start)


def _structure(root: Element, block: Block, ahead: int) -> None:
    structure = SubElement(root, "ModelStructure")
    n_in, n_out = len(block.inputs), len(block.outputs)
    first = n_in + n_out
    parameters = [str(first + i + 1) for i in range(len(block.parameters))]
    inputs = [str(i + 1) for i in range(n_in)]
    # Outputs change in a communication step alone: an input that is set shows in none before. A master that were told
    # otherwise would find an algebraic loop between observer and controller. At the start they follow the parameters.
    # Those of the next sample follow the inputs at once.
    for tag, known in (("Outputs", []), ("InitialUnknowns", parameters)):
        if n_out:
            group = SubElement(structure, tag)
            for i in range(n_out):
                all_known = [*inputs, *known] if i >= n_out - ahead else known
                SubElement(group, "Unknown", index=str(n_in + i + 1), dependencies=" ".join(all_known))


def _has_unit(port: Port) -> bool:
    return port.unit not in _NONE and not port.boolean


def unit_attributes(port: Port) -> dict[str, str]:
    """Return unit and display unit."""
    if not _has_unit(port):
        return {}
    display, _ = display_unit(port)
    return {"unit": port.unit} | ({"displayUnit": display} if display != port.unit else {})


def range_attributes(port: Port) -> dict[str, str]:
    """Return min, max and nominal."""
    values = {"min": port.minimum, "max": port.maximum, "nominal": port.nominal}
    return {name: repr(float(value)) for name, value in values.items() if value is not None and math.isfinite(value)}


def start_attribute(port: Port) -> str:
    """Return the start value as XML writes it."""
    if port.boolean:
        return "true" if port.start else "false"
    return "NaN" if math.isnan(port.start) else repr(float(port.start))
