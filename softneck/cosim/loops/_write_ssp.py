"""Write a loop as an SSP 1.0 archive: FMUs, connections, parameters and layout, in one file for other masters."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from softneck.core import SI_BASES, DataError, OutputFileError, SettingsError, atomic_write, refuse_existing, to_si
from softneck.fmu import FmuInfo, build_compiled_fmu, build_fmu, exported_block, unpacked
from softneck.loop import USE_MOTOR_POSITIONS, BlockPart, Link, Loop, Part, ReferenceBlock, System, Wiring, wire
from softneck.robot import Robot
from softneck.runtime import Block, Port

from ..parts._fmu_part import FmuPart
from ..parts._isolated import IsolatedPart
from ..parts._variables import python_block, read_description
from ._loop_file import LoopSetup

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
    """One FMU of the system, with the FMU's own names; `values` are parameters and constant inputs."""

    name: str
    source: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    values: tuple[tuple[Port, float], ...]


@dataclass(frozen=True, slots=True)
class Connection:
    """A connection from (component, output) to (component, input): factor * value + offset.

    `explicit` writes the factor also if it is 1: units differ, and other masters must not convert them.
    """

    origin: tuple[str, str]
    target: tuple[str, str]
    factor: float
    offset: float = 0.0
    explicit: bool = False


def system_description(
    name: str, components: Sequence[Component], links: Sequence[Connection], *, step: float, duration: float,
    robot: Robot | None = None,
) -> bytes:  # fmt: skip
    """Return the XML text of a system of `components`, stepped by `step` [s] for `duration` [s].

    SSP prescribes no master; annotations of OMSimulator and of softneck describe one with the results of softneck. That
    of softneck has the `robot` too, if it is not the neck.
    """
    root = Element(
        "ssd:SystemStructureDescription", {**_SPACES, "version": "1.0", "name": name, "generationTool": "softneck"}
    )
    system = SubElement(
        root, "ssd:System", {"name": "loop", "description": "closed loop, all inputs set before all steps"}
    )
    elements = SubElement(system, "ssd:Elements")
    for number, component in enumerate(components):
        _component_element(elements, component, _corner(component.name, number))
    connections = SubElement(system, "ssd:Connections")
    for link in links:
        _connection(connections, link)
    # No SystemGeometry: OMSimulator refuses a file that has one.
    master = {"description": "oms-ma", "stepSize": repr(step)}
    settings = {**master, "absoluteTolerance": "1e-4", "relativeTolerance": "1e-4"}
    notes = SubElement(system, "ssd:Annotations")
    SubElement(SubElement(_omsimulator(notes), "oms:SimulationInformation"), "oms:FixedStepMaster", settings)
    # After that of OMSimulator, which reads only the first annotation.
    note = SubElement(notes, "ssc:Annotation", {"type": "softneck"})
    master_note = SubElement(note, "Master", {"order": "jacobi", "stepSize": repr(step)})
    if robot is not None and robot.in_header():  # below, as the schema has one element in an annotation
        SubElement(master_note, "Robot").text = json.dumps(robot.as_dict())
    _units(root, "ssd", [port for item in components for port in (*item.inputs, *item.outputs)])
    experiment = SubElement(root, "ssd:DefaultExperiment", {"startTime": "0", "stopTime": repr(duration)})
    # Without this OMSimulator reports the file as deprecated.
    results = {"resultFile": f"{name}_res.mat", "bufferSize": "1"}
    SubElement(_omsimulator(SubElement(experiment, "ssd:Annotations")), "oms:SimulationInformation", results)
    indent(root)
    return tostring(root, encoding="utf-8", xml_declaration=True)


def _component_element(elements: Element, component: Component, corner: tuple[float, float]) -> None:
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
        binding = {"type": "application/x-ssp-parameter-set", "source": parameter_file(component)}
        SubElement(SubElement(element, "ssd:ParameterBindings"), "ssd:ParameterBinding", binding)


def _type(parent: Element, port: Port) -> None:
    if port.boolean or port.integer:
        SubElement(parent, "ssc:Boolean" if port.boolean else "ssc:Integer")
    else:
        SubElement(parent, "ssc:Real", {} if port.unit in ("", "1") else {"unit": port.unit})


def parameter_file(component: Component) -> str:
    """Return the name of the component's parameter set in the archive."""
    return f"resources/{component.name}.ssv"


def parameter_set(component: Component) -> bytes:
    """Return the XML text of the component's parameters and constant inputs, with their units."""
    spaces = {key: _SPACES[key] for key in ("xmlns:ssc", "xmlns:ssv")}
    table = Element("ssv:ParameterSet", {**spaces, "version": "1.0", "name": "initialValues"})
    parameters = SubElement(table, "ssv:Parameters")
    for port, value in component.values:
        parameter = SubElement(parameters, "ssv:Parameter", {"name": port.name})
        if port.boolean:
            SubElement(parameter, "ssv:Boolean", {"value": "true" if value else "false"})
        elif port.integer:
            SubElement(parameter, "ssv:Integer", {"value": str(int(value))})
        else:
            unit = {} if port.unit in ("", "1") else {"unit": port.unit}
            SubElement(parameter, "ssv:Real", {"value": repr(value), **unit})
    _units(table, "ssv", [port for port, _ in component.values])
    indent(table)
    return tostring(table, encoding="utf-8", xml_declaration=True)


def _connection(connections: Element, link: Connection) -> None:
    (owner, output), (part, name) = link.origin, link.target
    head = {"startElement": owner, "startConnector": output, "endElement": part, "endConnector": name}
    if (link.factor, link.offset) == (1.0, 0.0) and not link.explicit:
        SubElement(connections, "ssd:Connection", head)
        return
    # Masters that convert units themselves must not convert twice.
    connection = SubElement(connections, "ssd:Connection", {**head, "suppressUnitConversion": "true"})
    offset = {"offset": repr(link.offset)} if link.offset else {}
    SubElement(connection, "ssc:LinearTransformation", {"factor": repr(link.factor), **offset})


def _omsimulator(notes: Element) -> Element:
    return SubElement(SubElement(notes, "ssc:Annotation", {"type": "org.openmodelica"}), "oms:Annotations")


def _units(root: Element, space: str, ports: Sequence[Port]) -> None:
    names = sorted({port.unit for port in ports if not port.boolean and port.unit not in ("", "1")})
    if not names:
        return
    units = SubElement(root, f"{space}:Units")
    for name in names:
        unit = SubElement(units, "ssc:Unit", {"name": name})
        try:
            factor, si = to_si(name)
        except DataError:
            SubElement(unit, "ssc:BaseUnit")  # an unknown unit of another tool's FMU
            continue
        scale = {} if factor == 1.0 else {"factor": repr(factor)}
        base = {name: str(power) for name, power in SI_BASES.get(si, {}).items()}
        SubElement(unit, "ssc:BaseUnit", {**base, **scale})


def _corner(name: str, number: int) -> tuple[float, float]:
    column, row = _PLACES.get(name, (number, 4))
    return _GAP + column * (_WIDTH + _GAP), _GAP + row * (0.5 * _HEIGHT + _GAP)


def block_without_python(path: Path) -> Block | None:
    """Return the block in a Python FMU; None for an FMU that needs neither Python nor another tool."""
    with unpacked(path) as folder:
        description = read_description(path, folder, {})
        block = python_block(path, folder, description)
        if block is not None:
            return block
        experiment = description.model.coSimulation
        if experiment is None:
            raise SettingsError(f"{path}: is for Model Exchange only; masters of SSP files step Co-Simulation FMUs.")
        if experiment.needsExecutionTool:
            raise SettingsError(
                f"{path}: needs another program to run (needsExecutionTool), and so would the SSP file; "
                "use a softneck file instead, or `--backend python`."
            )
        return None


# Fixed, so that the same loop gives the same bytes.
_ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)


def write_ssp(loop: Loop | LoopSetup | System, path: str | Path, *, force: bool = False, compiled: bool = True) -> Path:
    """Write `loop`, or a system of `load_ssp`, as an SSP 1.0 archive and return its path.

    Other parts and the reference become FMUs. A master that sets all inputs first and then steps all FMUs has the
    results of `simulate` with order "jacobi".

    Args:
        loop: a loop, with limits as from `load_loop` or without.
        path: `NAME.ssp`.
        force: replace an existing file.
        compiled: build compiled FMUs, also from Python FMUs of softneck, so that the file needs no Python. False: new
            FMUs run Python.

    Raises:
        SettingsError: faults, a part that cannot become an FMU, or one that needs Python; the message names it.
        OutputFileError: the file exists or cannot be written.
    """
    target = Path(path)
    if target.suffix != ".ssp":
        raise SettingsError(f"{target}: the name of an SSP file must end in `.ssp`.")
    refuse_existing(target, force=force)
    plain = loop.loop if isinstance(loop, LoopSetup) else loop
    if plain.faults:
        raise SettingsError("an SSP file cannot hold the loop's faults; take [[fault]] out of a copy of the loop file.")
    step = min(part.sample_time for part in plain.parts.values())
    closed = isinstance(plain, Loop)
    if closed and not hasattr(plain.reference, "advance"):
        block = ReferenceBlock(
            plain.reference,  # pyright: ignore[reportArgumentType]
            sample_time=step,
            duration=plain.duration,
            robot=plain.robot,
        ).block()
        plain = replace(plain, reference=BlockPart(block))
    wiring = wire(plain.parts, plain.constants, plain.connections, plain.robot, closed=closed)
    with tempfile.TemporaryDirectory(prefix="softneck-ssp-") as folder:
        sources = {name: _fmu_of(name, part, Path(folder), compiled, plain.robot) for name, part in plain.parts.items()}
        parts = [_component(name, part, sources[name], plain, wiring) for name, part in plain.parts.items()]
        links, duration, robot = _links(plain, wiring), plain.duration, plain.robot if closed else None
        text = system_description(target.stem, parts, links, step=step, duration=duration, robot=robot)
        members = {"SystemStructure.ssd": text}
        members |= {parameter_file(item): parameter_set(item) for item in parts if item.values}
        members |= {f"resources/{source.name}": source.read_bytes() for source in sources.values()}
        _write(target, members, force=force)
    return target


def _fmu_of(name: str, part: Part, folder: Path, compiled: bool, robot: Robot) -> Path:
    """Return an FMU of `part`, in `folder` if it must be made or renamed."""
    block = part.block if isinstance(part, BlockPart) else None
    if isinstance(part, FmuPart | IsolatedPart):
        block = block_without_python(part.path) if compiled else None
        if block is None:
            # An FMU from an archive of softneck already has the name of its part.
            bare = part.path.name.removeprefix(f"{name}_")
            copied = folder / (bare if bare == f"{name}.fmu" else f"{name}_{bare}")
            copied.write_bytes(part.path.read_bytes())
            return copied
    if block is None:
        raise SettingsError(f"the {name} is a {type(part).__name__}, which cannot become an FMU; use an FMU or a file.")
    annotation = (robot.name, robot.hash) if robot.in_header() else None
    target, info = folder / f"{name}.fmu", FmuInfo(description=f"{block.kind} of a loop", robot=annotation)
    if compiled:
        build_compiled_fmu(block, target, info=info)
        return target
    return build_fmu(block, target, info=info)


def _fmu_name(part: Part, name: str) -> str:
    """Return the FMU's own name of a variable."""
    return part.native_names.get(name, name) if isinstance(part, FmuPart | IsolatedPart) else name


def _component(name: str, part: Part, source: Path, loop: Loop | System, wiring: Wiring) -> Component:
    def with_fmu_name(port: Port) -> Port:
        return replace(port, name=_fmu_name(part, port.name))

    tap = wiring.taps[name]
    fed = {port.name for port, owner in zip(tap.ports, tap.owners, strict=True) if owner}
    constants = {
        port.name: wiring.start[slot]
        for port, owner, slot in zip(tap.ports, tap.owners, tap.slots.tolist(), strict=True)
        # NaN is the default of an unconnected input in an FMU of softneck.
        if not owner and wiring.start[slot] == wiring.start[slot]
    }
    known = {port.name: port for port in (*part.inputs, *_parameters(part))}
    # A block gets this parameter only as an FMU; see `Loop.parameters`.
    defaults = {USE_MOTOR_POSITIONS: 1.0} if USE_MOTOR_POSITIONS in known and isinstance(loop, Loop) else {}
    tunable = {port.name: port.start for port in known.values() if port.tunable}
    values = {**constants, **tunable, **defaults, **loop.parameters.get(name, {})}
    for key in values:
        if key not in known:
            raise SettingsError(f"`{key}` is not a parameter of the {name}; it has {', '.join(known) or 'none'}.")
    return Component(
        name=name,
        source=f"resources/{source.name}",
        # Only those that something feeds: a master may give the others the value of any connection (fmpy does).
        inputs=tuple(with_fmu_name(port) for port in part.inputs if port.name in fed),
        outputs=tuple(map(with_fmu_name, part.outputs)),
        values=tuple((with_fmu_name(known[key]), float(value)) for key, value in values.items()),
    )


def _parameters(part: Part) -> tuple[Port, ...]:
    if isinstance(part, BlockPart):
        return exported_block(part.block).parameters
    return getattr(part, "parameters", ())


def _links(loop: Loop | System, wiring: Wiring) -> list[Connection]:
    links = []
    parts = loop.parts
    for name, tap in wiring.taps.items():
        scales = np.tile([[1.0], [0.0]], len(tap.ports)) if tap.scales is None else tap.scales
        for port, owner, slot, (factor, offset) in zip(
            tap.ports, tap.owners, tap.slots.tolist(), scales.T.tolist(), strict=True
        ):
            if owner:
                output = next(item.port for item in wiring.named if item.slot == slot)
                origin = (owner, _fmu_name(parts[owner], output.name))
                target = (name, _fmu_name(parts[name], port.name))
                is_link = isinstance(loop.connections.get(f"{name}.{port.name}"), Link)
                links.append(Connection(origin, target, factor, offset, is_link and output.unit != port.unit))
    return links


def _write(target: Path, members: Mapping[str, bytes], *, force: bool) -> None:
    try:
        with atomic_write(target, force=force) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name, data in members.items():
                info = zipfile.ZipInfo(name, _ARCHIVE_DATE)
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, data)
    except OSError as error:
        raise OutputFileError(f"{target}: cannot be written: {error.strerror or error}.") from error
