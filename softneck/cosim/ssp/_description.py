"""`SystemStructure.ssd` of SSP 1.0 (Modelica Association, 2019), with places for graphical tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softneck.core import DataError, to_si
from softneck.core._units import SI_BASES
from softneck.runtime import Port

_SPACES = {
    "xmlns:ssd": "http://ssp-standard.org/SSP1/SystemStructureDescription",
    "xmlns:ssc": "http://ssp-standard.org/SSP1/SystemStructureCommon",
    "xmlns:ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues",
    "xmlns:oms": "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd",
}
# Drawing: signals flow from left to right, the observer below on the way back. Units are those of the canvas.
_PLACES = {"reference": (0, 2), "controller": (1, 2), "plant": (2, 2), "observer": (1, 0)}
_WIDTH, _HEIGHT, _GAP = 40.0, 50.0, 30.0


@dataclass(frozen=True, slots=True)
class Component:
    """One FMU of the system, with the FMU's own names.

    Attributes:
        name: in the system.
        source: path in the archive.
        inputs, outputs: connectors.
        values: parameters and constant inputs.
    """

    name: str
    source: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    values: tuple[tuple[Port, float], ...]


@dataclass(frozen=True, slots=True)
class Connection:
    """A connection from (component, output) to (component, input): factor * value + offset.

    `explicit` ones say so even where that is the value itself: their units differ, and nobody is to convert them.
    """

    origin: tuple[str, str]
    target: tuple[str, str]
    factor: float
    offset: float = 0.0
    explicit: bool = False


def system_description(
    name: str, components: Sequence[Component], links: Sequence[Connection], *, step: float, duration: float
) -> bytes:
    """Return the XML text of a system of `components`, stepped by `step` [s] for `duration` [s].

    SSP prescribes no master; two notes say which one computes what we do: OMSimulator's own, and ours.
    """
    root = Element(
        "ssd:SystemStructureDescription", {**_SPACES, "version": "1.0", "name": name, "generationTool": "softneck"}
    )
    system = SubElement(
        root, "ssd:System", {"name": "loop", "description": "closed loop, all inputs set before all steps"}
    )
    elements = SubElement(system, "ssd:Elements")
    for number, component in enumerate(components):
        _component(elements, component, _corner(component.name, number))
    connections = SubElement(system, "ssd:Connections")
    for link in links:
        _connection(connections, link)
    # No SystemGeometry: OMSimulator refuses a file that has one, and the boxes of the components say as much.
    master = {"description": "oms-ma", "stepSize": repr(step)}
    settings = {**master, "absoluteTolerance": "1e-4", "relativeTolerance": "1e-4"}
    notes = SubElement(system, "ssd:Annotations")
    SubElement(SubElement(_omsimulator(notes), "oms:SimulationInformation"), "oms:FixedStepMaster", settings)
    # Behind that of OMSimulator, which looks at the first alone.
    note = SubElement(notes, "ssc:Annotation", {"type": "softneck"})
    SubElement(note, "Master", {"order": "jacobi", "stepSize": repr(step)})
    _units(root, components)
    experiment = SubElement(root, "ssd:DefaultExperiment", {"startTime": "0", "stopTime": repr(duration)})
    # Where this is missing OMSimulator says that the file is deprecated.
    results = {"resultFile": f"{name}_res.mat", "bufferSize": "1"}
    SubElement(_omsimulator(SubElement(experiment, "ssd:Annotations")), "oms:SimulationInformation", results)
    indent(root)
    return tostring(root, encoding="utf-8", xml_declaration=True)


def _component(elements: Element, component: Component, corner: tuple[float, float]) -> None:
    head = {"name": component.name, "type": "application/x-fmu-sharedlibrary", "source": component.source}
    element = SubElement(elements, "ssd:Component", head)
    connectors = SubElement(element, "ssd:Connectors")
    for kind, ports in (("input", component.inputs), ("output", component.outputs)):
        for number, port in enumerate(ports):
            connector = SubElement(connectors, "ssd:Connector", {"name": port.name, "kind": kind})
            _type(connector, port)
            # Inputs on the left edge, outputs on the right one, the first on top.
            y = 1.0 - (number + 0.5) / len(ports)
            place = {"x": "0" if kind == "input" else "1", "y": f"{y:.4f}"}
            SubElement(connector, "ssd:ConnectorGeometry", place)
    x, y = corner
    box = {"x1": f"{x:g}", "y1": f"{y:g}", "x2": f"{x + _WIDTH:g}", "y2": f"{y + _HEIGHT:g}"}
    SubElement(element, "ssd:ElementGeometry", box)
    if component.values:
        _bindings(element, component)


def _type(parent: Element, port: Port) -> None:
    if port.boolean or port.integer:
        SubElement(parent, "ssc:Boolean" if port.boolean else "ssc:Integer")
    else:
        SubElement(parent, "ssc:Real", {} if port.unit in ("", "1") else {"unit": port.unit})


def _bindings(element: Element, component: Component) -> None:
    binding = SubElement(SubElement(element, "ssd:ParameterBindings"), "ssd:ParameterBinding")
    values = SubElement(binding, "ssd:ParameterValues")
    table = SubElement(values, "ssv:ParameterSet", {"version": "1.0", "name": "initialValues"})
    parameters = SubElement(table, "ssv:Parameters")
    for port, value in component.values:
        parameter = SubElement(parameters, "ssv:Parameter", {"name": port.name})
        if port.boolean:
            SubElement(parameter, "ssv:Boolean", {"value": "true" if value else "false"})
        elif port.integer:
            SubElement(parameter, "ssv:Integer", {"value": str(int(value))})
        else:
            SubElement(parameter, "ssv:Real", {"value": repr(value)})


def _connection(connections: Element, link: Connection) -> None:
    (owner, output), (part, name) = link.origin, link.target
    head = {"startElement": owner, "startConnector": output, "endElement": part, "endConnector": name}
    if (link.factor, link.offset) == (1.0, 0.0) and not link.explicit:
        SubElement(connections, "ssd:Connection", head)
        return
    # Masters that convert by units themselves must not do it twice.
    connection = SubElement(connections, "ssd:Connection", {**head, "suppressUnitConversion": "true"})
    offset = {"offset": repr(link.offset)} if link.offset else {}
    SubElement(connection, "ssc:LinearTransformation", {"factor": repr(link.factor), **offset})


def _omsimulator(notes: Element) -> Element:
    return SubElement(SubElement(notes, "ssc:Annotation", {"type": "org.openmodelica"}), "oms:Annotations")


def _units(root: Element, components: Sequence[Component]) -> None:
    ports = [port for item in components for port in (*item.inputs, *item.outputs)]
    names = sorted({port.unit for port in ports if not port.boolean and port.unit not in ("", "1")})
    if not names:
        return
    units = SubElement(root, "ssd:Units")
    for name in names:
        unit = SubElement(units, "ssc:Unit", {"name": name})
        try:
            factor, si = to_si(name)
        except DataError:
            SubElement(unit, "ssc:BaseUnit")  # a foreign FMU's own unit: known by name only
            continue
        scale = {} if factor == 1.0 else {"factor": repr(factor)}
        base = {name: str(power) for name, power in SI_BASES.get(si, {}).items()}
        SubElement(unit, "ssc:BaseUnit", {**base, **scale})


def _corner(name: str, number: int) -> tuple[float, float]:
    column, row = _PLACES.get(name, (number, 4))
    return _GAP + column * (_WIDTH + _GAP), _GAP + row * (0.5 * _HEIGHT + _GAP)
