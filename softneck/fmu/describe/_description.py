"""`modelDescription.xml` (FMI 2.0.4, section 2.2; FMI 3.0, section 2.4) and terminals of a block.

Value references count inputs, outputs, parameters, as in the slave; FMI 3.0 adds `time` at the end. The members of
terminals have the same names in plants, observers, controllers and references, so that tools connect them by name.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from softneck import __version__
from softneck.core import SI_BASES, SettingsError, to_si
from softneck.loop import USE_MOTOR_POSITIONS
from softneck.plant import NeckParameters
from softneck.robot import is_set_point, motor_positions_among
from softneck.runtime import Block, Port

from ._describe import FmuInfo
from ._tunable import with_tunable_parameters

_DRIVES_RUNTIME = "softneck.fmu.describe._modelled_drives_runtime"
# Index of the first motor position in a neck's controller, and number of motors: the defaults of the runtime.
_DEFAULT_PORTS = (5, 3)


def with_modelled_drives(block: Block) -> Block:
    """Add a model of the drives to a controller, with a parameter that selects measured or modelled positions.

    Other blocks are returned unchanged. A controller's file has no drives, so those of the paper's neck are used.
    """
    inputs, positions = [port.name for port in block.inputs], list(motor_positions(block))
    motors = len(positions)
    first = inputs.index(positions[0]) if positions and positions[0] in inputs else len(inputs)
    if block.role != "controller" or inputs[first : first + motors] != positions or motors != len(block.outputs):
        return block
    # Only drives in rad are the paper's; and a block read from an FMU already has them.
    if block.inputs[first].unit != "rad" or USE_MOTOR_POSITIONS in {port.name for port in block.parameters}:
        return block
    neck, Ts = NeckParameters.paper(), block.sample_time
    # A set-point delayed by `drive_latency` acts from the next sample instant on, and is visible one sample later.
    delay = 1 + math.ceil(neck.drive_latency / Ts - 1e-9)
    drive = [math.exp(-neck.position_gain * Ts), delay, first, motors]
    return replace(
        block,
        runtime=f"{_DRIVES_RUNTIME}({block.runtime}:{len(block.arrays)})",
        arrays=(np.array(drive[:2] if (first, motors) == _DEFAULT_PORTS else drive), *block.arrays),
        parameters=(*block.parameters, _parameter(positions)),
    )


def motor_positions(block: Block) -> tuple[str, ...]:
    """Return the names of the motor positions among the ports of a block."""
    return motor_positions_among([port.name for port in (*block.inputs, *block.outputs)])


def _parameter(positions: Sequence[str]) -> Port:
    numbered = positions[0] == "motor_position_1"
    inputs = f"motor_position_1..{len(positions)}" if numbered else ", ".join(positions)
    return Port(
        name=USE_MOTOR_POSITIONS,
        description=f"true: use the inputs {inputs}; false: use the model of the drives inside",
        boolean=True,
        minimum=0.0,
        maximum=1.0,
    )


# Paper, section 3: the neck tilts up to about 0.7 rad; a larger reference is probably in degrees.
REFERENCE_LIMIT = 0.8
_NO_UNIT = ("", "1")
_TIME_NAME = "time"
# SI unit -> usual display unit, factor to it.
_SHOWN = {"rad": ("deg", 180.0 / math.pi), "rad/s": ("deg/s", 180.0 / math.pi), "m": ("mm", 1e3)}
LIMIT_OUTPUTS = "limit_outputs"
TERMINALS = "terminalsAndIcons/terminalsAndIcons.xml"
_TERMINALS = {
    "motors": "Set-points and positions of the motors",
    "angles": "Angles of the platform and their estimates",
    "outputs": "Outputs of the robot and their estimates",
    "measurement": "Measurements of the sensors",
    "reference": "Reference of the platform",
}
# Endings of ports by which outputs are recognised.
_OUTPUT_ENDINGS = ("_measured", "_reference")


@dataclass(frozen=True, slots=True)
class LookAhead:
    """Outputs at later samples, with derivatives; they are the last outputs of an FMU.

    Attributes:
        next: number of outputs at the next sample.
        ahead: number of outputs `horizon` samples ahead, behind those.
        horizon: [samples].
        inputs: for each of these outputs, the indices of the inputs that it depends on.
    """

    next: int = 0
    ahead: int = 0
    horizon: int = 0
    inputs: tuple[tuple[int, ...], ...] = ()


NO_LOOK_AHEAD = LookAhead()


@dataclass(frozen=True, slots=True)
class Identity:
    """Name, GUID, generation date and build of one FMU.

    `name`, `guid`, `date`: as in FMI. `tool`: that built it; None for pythonfmu. `sources`: files to compile it from;
    empty for FMUs with Python. `looks`: outputs at later samples.
    """

    name: str
    guid: str
    date: str
    tool: str | None = None
    sources: tuple[str, ...] = ()
    looks: LookAhead = NO_LOOK_AHEAD


def exported_block(block: Block) -> Block:
    """Return `block` as in its FMU: with tunable gains, a model of the drives, a range of references."""
    whole = with_modelled_drives(with_tunable_parameters(block))
    return replace(whole, inputs=tuple(_with_reference_range(port) for port in whole.inputs))


def with_limit_outputs(block: Block) -> Block:
    """Add the parameter `limit_outputs` to a plant whose outputs have ranges; the FMU itself reads it, no runtime."""
    ranged = any(
        not p.boolean and p.name != "validity" and (p.minimum, p.maximum) != (None, None) for p in block.outputs
    )
    if block.role != "plant" or not ranged or LIMIT_OUTPUTS in [port.name for port in block.parameters]:
        return block
    text = "true: outputs are clipped to their declared min and max; validity is 0 there in any case"
    port = Port(name=LIMIT_OUTPUTS, description=text, boolean=True, minimum=0.0, maximum=1.0)
    return replace(block, parameters=(*block.parameters, port))


def generation_tool() -> str:
    """Return the names and versions of the tools that build the FMU."""
    return f"softneck {__version__} (PythonFMU {version('pythonfmu')})"


def model_description(block: Block, info: FmuInfo, identity: Identity, *, fmi: int = 2) -> bytes:
    """Return the XML text of the model description of FMI 2.0 or 3.0.

    Raises SettingsError: two ports with one name, or in FMI 3.0 a port called `time`.
    """
    _check_names(block, _TIME_NAME if fmi == 3 else "")
    root = Element("fmiModelDescription", _head(block, info, identity, fmi))
    _interfaces(root, block, identity, fmi)
    _unit_definitions(root, block)
    categories = SubElement(root, "LogCategories")
    told = (("logStatusWarning", "Warnings"), ("logStatusError", "Errors"), ("logAll", "Everything"))
    for name, text in told if fmi == 2 else told[:2]:
        SubElement(categories, "Category", name=name, description=text)
    times = {"startTime": "0", "stopTime": repr(float(info.stop_time)), "stepSize": repr(float(block.sample_time))}
    SubElement(root, "DefaultExperiment", times)
    if fmi == 2:
        _annotation(SubElement(SubElement(root, "VendorAnnotations"), "Tool", name="softneck"), block, info)
    _variables(root, block, fmi)
    _structure(root, block, identity.looks, fmi)
    if fmi == 3:
        _annotation(SubElement(SubElement(root, "Annotations"), "Annotation", type="softneck"), block, info)
    return _text(root)


def _text(root: Element) -> bytes:
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def _with_reference_range(port: Port) -> Port:
    reference = port.name.endswith("_reference") and port.unit == "rad"
    if not reference or port.minimum is not None or port.maximum is not None:
        return port
    return replace(port, minimum=-REFERENCE_LIMIT, maximum=REFERENCE_LIMIT)


def _check_names(block: Block, reserved: str) -> None:
    names = [port.name for port in (*block.inputs, *block.outputs, *block.parameters)] + [reserved] * bool(reserved)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SettingsError(f"{block.kind}: an FMU variable needs one name of its own; twice: {', '.join(twice)}.")


def _head(block: Block, info: FmuInfo, identity: Identity, fmi: int) -> dict[str, str]:
    head = {
        "fmiVersion": f"{fmi}.0",
        "modelName": identity.name,
        "guid" if fmi == 2 else "instantiationToken": identity.guid,
        "generationTool": identity.tool or generation_tool(),
        "generationDateAndTime": identity.date,
        "variableNamingConvention": "structured",
    } | ({"numberOfEventIndicators": "0"} if fmi == 2 else {})
    texts = {
        "description": info.description or f"{block.kind} ({block.role}), sample time {block.sample_time:g} s",
        "author": info.author,
        "version": info.version,
        "copyright": info.copyright,
        "license": info.license,
    }
    return head | {name: text for name, text in texts.items() if text}


def _interfaces(root: Element, block: Block, identity: Identity, fmi: int) -> None:
    """Declare Co-Simulation, and Model Exchange of compiled FMUs: one binary has both."""
    state = "FMUstate" if fmi == 2 else "FMUState"
    yes = [f"canGetAndSet{state}", f"canSerialize{state}"] + ["canNotUseMemoryManagementFunctions"] * (fmi == 2)
    yes += ["providesDirectionalDerivative" + "s" * (fmi == 3)] * bool(identity.looks.next)
    common = {"modelIdentifier": identity.name} | dict.fromkeys(yes, "true")
    no_call = {"completedIntegratorStepNotNeeded": "true"} if fmi == 2 else {"needsCompletedIntegratorStep": "false"}
    own = {"canHandleVariableCommunicationStepSize": "true"}
    if fmi == 3:
        own["fixedInternalStepSize"] = repr(float(block.sample_time))
    elif not identity.sources:
        own["needsExecutionTool"] = "true"  # the Python of the host
    interfaces = {"ModelExchange": no_call} if identity.sources else {}
    for name, attributes in (interfaces | {"CoSimulation": own}).items():
        element = SubElement(root, name, common | attributes)
        if identity.sources and fmi == 2:
            files = SubElement(element, "SourceFiles")
            for file in identity.sources:
                SubElement(files, "File", name=file)


def _unit_definitions(root: Element, block: Block) -> None:
    ports = [port for port in (*block.inputs, *block.outputs, *block.parameters) if _has_unit(port)]
    used = sorted({port.unit for port in ports})
    if not used:
        return
    definitions = SubElement(root, "UnitDefinitions")
    for name in used:
        unit = SubElement(definitions, "Unit", name=name)
        base = {
            key: str(power) for key, power in SI_BASES.get(name, {}).items()
        }  # empty for a unit without SI base units
        if base:
            SubElement(unit, "BaseUnit", base)
        shown = {_display_unit(port) for port in ports if port.unit == name}
        for display, factor in sorted(pair for pair in shown if pair[0] != name):
            SubElement(unit, "DisplayUnit", name=display, factor=repr(factor))


def _annotation(parent: Element, block: Block, info: FmuInfo) -> None:
    # For softneck itself: FMI has no attribute for the role, nor for "NaN means not measured".
    missing = [port.name for port in (*block.inputs, *block.outputs, *block.parameters) if port.missing]
    facts = {"kind": block.kind, "role": block.role, "sampleTime": repr(float(block.sample_time))}
    if info.robot is not None:
        facts |= {"robot": info.robot[0], "robotHash": info.robot[1]}
    SubElement(parent, "Block", facts | {"missing": " ".join(missing)})


def _variables(root: Element, block: Block, fmi: int) -> None:
    table = SubElement(root, "ModelVariables")
    reference = 0
    for causality, ports in (("input", block.inputs), ("output", block.outputs), ("parameter", block.parameters)):
        for port in ports:
            _variable(table, port, causality, reference, fmi)
            reference += 1
    if fmi == 3:
        head = {"name": _TIME_NAME, "valueReference": str(reference), "causality": "independent"}
        SubElement(table, "Float64", head | {"variability": "continuous", "description": "Simulation time"})


def _variable(table: Element, port: Port, causality: str, reference: int, fmi: int) -> None:
    variability = {"input": "discrete" if port.boolean else "continuous", "output": "discrete", "parameter": "fixed"}
    head = {"name": port.name, "valueReference": str(reference), "causality": causality}
    head["variability"] = "tunable" if port.tunable else variability[causality]
    if causality != "input":
        head["initial"] = "calculated" if causality == "output" else "exact"
    if port.description:
        head["description"] = port.description
    numbers = _range_attributes(port) | ({} if causality == "output" else {"start": _start_attribute(port)})
    if port.boolean:
        kind, own = "Boolean", {name: text for name, text in numbers.items() if name == "start"}
    elif port.integer:
        kind, own = (
            "Int32" if fmi == 3 else "Integer",
            {name: str(int(float(text))) for name, text in numbers.items() if name != "nominal"},
        )
    else:
        kind, own = "Float64" if fmi == 3 else "Real", _unit_attributes(port) | numbers
    if fmi == 3:
        SubElement(table, kind, head | own)
    else:
        SubElement(SubElement(table, "ScalarVariable", head), kind, own)


def _structure(root: Element, block: Block, looks: LookAhead, fmi: int) -> None:
    structure = SubElement(root, "ModelStructure")
    n_in, n_out = len(block.inputs), len(block.outputs)
    first = 1 if fmi == 2 else 0  # FMI 2.0 counts variables from one, FMI 3.0 has their references
    parameters = [str(n_in + n_out + i + first) for i in range(len(block.parameters))]
    # Outputs only change in a communication step, so they do not depend on inputs directly. Otherwise a master would
    # find an algebraic loop between observer and controller. Initial outputs depend on the parameters. Only the outputs
    # of later samples depend on inputs directly.
    direct: list[tuple[int, ...]] = [()] * (n_out - len(looks.inputs)) + list(looks.inputs)
    for tag, known in (("Output", []), ("InitialUnknown", parameters)):
        group = SubElement(structure, f"{tag}s") if fmi == 2 and n_out else structure
        for i in range(n_out):
            all_known = " ".join([*(str(j + first) for j in direct[i]), *known])
            place = str(n_in + i + first)
            if fmi == 2:
                SubElement(group, "Unknown", index=place, dependencies=all_known)
            else:
                SubElement(group, tag, valueReference=place, dependencies=all_known)


def _has_unit(port: Port) -> bool:
    return port.unit not in _NO_UNIT and not port.boolean


def _unit_attributes(port: Port) -> dict[str, str]:
    if not _has_unit(port):
        return {}
    display, _ = _display_unit(port)
    return {"unit": port.unit} | ({"displayUnit": display} if display != port.unit else {})


def _range_attributes(port: Port) -> dict[str, str]:
    values = {"min": port.minimum, "max": port.maximum, "nominal": port.nominal}
    return {name: repr(float(value)) for name, value in values.items() if value is not None and math.isfinite(value)}


def _start_attribute(port: Port) -> str:
    if port.boolean:
        return "true" if port.start else "false"
    return "NaN" if math.isnan(port.start) else repr(float(port.start))


def _display_unit(port: Port) -> tuple[str, float]:
    """Return the display unit of a port and the factor from SI."""
    if port.display_unit:
        return port.display_unit, 1.0 / to_si(port.display_unit)[0]
    return _SHOWN.get(port.unit, (port.unit, 1.0))


def terminals(block: Block) -> dict[str, list[str]]:
    """Return terminal -> names of its inputs and outputs, without empty terminals."""
    ports = (*block.inputs, *block.outputs)
    outputs = {port.name.removesuffix(end) for port in ports for end in _OUTPUT_ENDINGS if port.name.endswith(end)}
    motors = motor_positions(block)
    found = {title: [p.name for p in ports if _terminal_of(p, outputs, motors) == title] for title in _TERMINALS}
    return {title: members for title, members in found.items() if members}


def _terminal_of(port: Port, outputs: set[str], positions: Collection[str]) -> str:
    name = port.name
    if "_measured" in name or name == "measurement_valid":
        return "measurement"
    if is_set_point(name) or name in positions:
        return "motors"
    if name.endswith("_reference") or name == "enabled":
        return "reference"
    if name != "healthy" and name.removesuffix("_rate") not in outputs - {"cocontraction"}:
        return ""
    return "angles" if port.boolean or port.unit in ("rad", "rad/s") else "outputs"


def terminals_file(block: Block) -> dict[str, bytes]:
    """Return the terminals' file name in the FMU and its XML; empty for a block without terminals."""
    found = terminals(block)
    if not found:
        return {}
    root = Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    group = SubElement(root, "Terminals")
    for title, members in found.items():
        # A bus: an observer may connect the set-points and not the positions.
        head = {"name": title, "matchingRule": "bus", "description": _TERMINALS[title]}
        terminal = SubElement(group, "Terminal", head)
        for name in members:
            SubElement(
                terminal, "TerminalMemberVariable", {"variableName": name, "memberName": name, "variableKind": "signal"}
            )
    return {TERMINALS: _text(root)}
