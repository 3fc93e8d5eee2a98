"""Read the XML of an SSP archive: systems, components, connectors, connections, bindings, units."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from softneck.core import FileFormatError, SoftneckError, error_reason
from softneck.robot import Robot

SSD, SSC, SSV, SSM = (
    f"{{http://ssp-standard.org/SSP1/SystemStructure{name}}}"
    for name in ("Description", "Common", "ParameterValues", "ParameterMapping")
)
_FMU_TYPE = "application/x-fmu-sharedlibrary"
# Types that a loop has; those of FMI 3 are also in SSP 2.0.
_WHOLE_TYPES = ("Integer", *(f"{u}Int{bits}" for u in ("", "U") for bits in (8, 16, 32, 64)))
_NUMBER_TYPES = ("Real", "Float64", "Float32", *_WHOLE_TYPES, "Boolean")
OTHER_TYPES = ("Enumeration", "String", "Binary", "Clock")
_CONNECTOR_KINDS = (
    "input",
    "output",
    "parameter",
    "calculatedParameter",
    "structuralParameter",
    "constant",
    "local",
    "inout",
)
# Nested systems: real archives have a few.
_MAX_DEPTH = 50
_SOURCE_BASES = (None, "", "SSD", "component")


@dataclass(frozen=True, slots=True)
class Connector:
    """A connector with kind, unit and type; "" if not given."""

    kind: str
    unit: str = ""
    type: str = ""


@dataclass(frozen=True, slots=True)
class Affine:
    """factor * value + offset, after conversion of units unless it is suppressed."""

    factor: float = 1.0
    offset: float = 0.0
    convert: bool = True


@dataclass(frozen=True, slots=True)
class Connection:
    """A connection from (element, connector) to (element, connector); the element "" is the system itself."""

    start: tuple[str, str]
    end: tuple[str, str]
    affine: Affine


@dataclass(frozen=True, slots=True)
class Value:
    """A value of a parameter set with its unit and type."""

    value: float | str
    unit: str
    type: str


@dataclass(frozen=True, slots=True)
class Binding:
    """A parameter set with its mapping (target, source, affine), if any, and its own units."""

    values: Mapping[str, Value]
    mapping: tuple[tuple[str, str, Affine], ...] | None
    units: Mapping[str, Unit]


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit: SI value = factor * value + offset, with exponents of base units."""

    base: tuple[tuple[str, int], ...]
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Component:
    """An FMU with its path in the archive, its connectors and bindings."""

    source: str
    connectors: Mapping[str, Connector]
    bindings: tuple[Binding, ...]


@dataclass(frozen=True, slots=True)
class SystemNode:
    """A system with its own connectors and bindings, its elements and connections."""

    connectors: Mapping[str, Connector] = field(default_factory=dict)
    bindings: tuple[Binding, ...] = ()
    elements: Mapping[str, Component | SystemNode] = field(default_factory=dict)
    connections: tuple[Connection, ...] = ()


@dataclass(frozen=True, slots=True)
class Structure:
    """The content of `SystemStructure.ssd`: `stop` [s] of the experiment, `step` [s] and `order` of the master.

    `robot`: of softneck's annotation, None without one.
    """

    name: str
    root: SystemNode
    units: Mapping[str, Unit]
    stop: float | None
    step: float | None
    order: str | None
    robot: Robot | None = None


class StructureReader:
    """Reads the structure of an archive unpacked in `folder`; `where` is its path for messages."""

    def __init__(self, where: Path, folder: Path) -> None:
        self.where, self.folder = where, folder

    def structure(self) -> Structure:
        """Return the structure in the archive's `SystemStructure.ssd`."""
        root = self._xml("SystemStructure.ssd")
        if root.tag != f"{SSD}SystemStructureDescription" or root.get("version", "1.0") not in ("1.0", "2.0"):
            raise self._wrong("SystemStructure.ssd", "is no SSP 1.0 or 2.0 system structure description")
        system = root.find(f"{SSD}System")
        if system is None:
            raise self._wrong("SystemStructure.ssd", "has no system")
        experiment = root.find(f"{SSD}DefaultExperiment")
        start, stop = (None if experiment is None else experiment.get(key) for key in ("startTime", "stopTime"))
        begin = 0.0 if start is None else self._number("startTime", start)
        if begin != 0.0:  # FMUs may depend on time: a run shifted to 0 would be another one
            raise self._wrong("SystemStructure.ssd", f"begins at {begin:g} s; softneck's runs begin at 0 s")
        span = None if stop is None else self._number("stopTime", stop)
        if span is not None and span <= 0.0:
            raise self._wrong("SystemStructure.ssd", f"ends at {stop} s and begins at 0 s")
        step, order = self._master(root)
        return Structure(
            name=root.get("name", ""),
            root=self._system(system),
            units=self._units(root.find(f"{SSD}Units")),
            stop=span,
            step=step,
            order=order,
            robot=self._robot(root),
        )

    def file(self, source: str) -> Path:
        """Return the member of the archive that a URI names."""
        name = unquote(source.removeprefix("./"))
        path = PurePosixPath(name)
        if ":" in name or "\\" in name or path.is_absolute() or ".." in path.parts:
            raise FileFormatError(f"{self.where}: `{source}` is outside the archive; softneck reads members only.")
        try:
            found = (self.folder / path).is_file()
        except (OSError, ValueError):  # not a valid file name
            found = False
        if not found:
            raise FileFormatError(f"{self.where}: has no member `{source[:200]}`, which its structure names.")
        return self.folder / path

    def _xml(self, name: str) -> ET.Element:
        data = self.file(name).read_bytes()
        # SSP has no entities, which could expand a few bytes to gigabytes.
        if b"<!DOCTYPE" in data or "<!DOCTYPE".encode("utf-16-le") in data or "<!DOCTYPE".encode("utf-16-be") in data:
            raise self._wrong(name, "has a DOCTYPE, which SSP does not have")
        try:
            return ET.fromstring(data)
        except (ET.ParseError, ValueError, LookupError) as error:
            raise self._wrong(name, f"is no valid XML ({error})") from error

    def _wrong(self, name: str, what: str) -> FileFormatError:
        return FileFormatError(f"{self.where}: its {name} {what}.")

    def _number(self, name: str, text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self._wrong("SystemStructure.ssd", f"has {name} = `{text[:40]}`, which is no finite number")
        return number

    def _positive(self, name: str, text: str) -> float:
        number = self._number(name, text)
        if number <= 0.0:
            raise self._wrong("SystemStructure.ssd", f"has {name} = `{text[:40]}`, which must be positive")
        return number

    def _master(self, root: ET.Element) -> tuple[float | None, str | None]:
        """Return step [s] and order of softneck's annotation; else the step of OMSimulator's and None."""
        for note in root.iter(f"{SSC}Annotation"):
            master = note.find("Master") if note.get("type") == "softneck" else None
            if master is not None:
                order = master.get("order", "jacobi")
                if order not in ("jacobi", "sequential"):
                    raise self._wrong("SystemStructure.ssd", f"has the order `{order}`; known are jacobi, sequential")
                return self._positive("stepSize", master.get("stepSize", "")), order
        for element in root.iter():
            if element.tag.endswith("}FixedStepMaster") and element.get("stepSize"):
                return self._positive("stepSize", element.get("stepSize", "")), None
        return None, None

    def _robot(self, root: ET.Element) -> Robot | None:
        notes = (note for note in root.iter(f"{SSC}Annotation") if note.get("type") == "softneck")
        text = next((note.findtext("Master/Robot") for note in notes), None)
        if text is None:
            return None
        try:
            return Robot.from_dict(json.loads(text))
        except (SoftneckError, ValueError, TypeError, RecursionError) as error:
            why = f"has no robot in its annotation ({error_reason(error)})"
            raise self._wrong("SystemStructure.ssd", why) from error

    def _system(self, node: ET.Element, depth: int = 0) -> SystemNode:
        if depth > _MAX_DEPTH:
            raise self._wrong("SystemStructure.ssd", f"has more than {_MAX_DEPTH} nested systems")
        if node.find(f"{SSD}SignalDictionaries") is not None:
            raise self._wrong("SystemStructure.ssd", "uses signal dictionaries, which softneck does not read")
        elements: dict[str, Component | SystemNode] = {}
        for element in node.iterfind(f"{SSD}Elements/*"):
            name = element.get("name", "")
            if not name or name in elements:
                raise self._wrong(
                    "SystemStructure.ssd", f"has {f'two elements `{name}`' if name else 'a nameless element'}"
                )
            if element.tag == f"{SSD}System":
                elements[name] = self._system(element, depth + 1)
            elif element.tag == f"{SSD}Component":
                elements[name] = self._component(name, element)
            else:
                kind = element.tag.rpartition("}")[2]
                raise self._wrong("SystemStructure.ssd", f"has the {kind} `{name}`, which softneck does not read")
        return SystemNode(
            connectors=self._connectors(node),
            bindings=self._bindings(node, None),
            elements=elements,
            connections=tuple(self._connection(item) for item in node.iterfind(f"{SSD}Connections/{SSD}Connection")),
        )

    def _component(self, name: str, node: ET.Element) -> Component:
        kind, source = node.get("type", _FMU_TYPE), node.get("source", "")
        if kind != _FMU_TYPE or not source or node.get("implementation", "CoSimulation") not in ("CoSimulation", "any"):
            raise self._wrong(
                "SystemStructure.ssd",
                f"has the component `{name}` of type {kind} ({node.get('implementation', 'no implementation given')}); "
                "softneck runs FMUs for co-simulation in the archive",
            )
        self.file(source)
        return Component(source, self._connectors(node), self._bindings(node, source))

    def _connectors(self, node: ET.Element) -> dict[str, Connector]:
        connectors = {}
        for item in node.iterfind(f"{SSD}Connectors/{SSD}Connector"):
            name, kind = item.get("name", ""), item.get("kind", "")
            if kind not in _CONNECTOR_KINDS:
                raise self._wrong("SystemStructure.ssd", f"has the connector `{name}` of unknown kind `{kind}`")
            typed = next((part for part in item if part.tag.startswith(SSC)), None)
            type_ = "" if typed is None else typed.tag.removeprefix(SSC)
            if item.find(f"{SSD}Dimension") is not None or item.find(f"{SSC}Dimension") is not None:
                raise self._wrong("SystemStructure.ssd", f"has the array `{name}`; softneck connects single numbers")
            connectors[name] = Connector(kind, "" if typed is None else typed.get("unit", ""), type_)
        return connectors

    def _connection(self, node: ET.Element) -> Connection:
        if node.find(f"{SSC}MapTransformation") is not None or any(
            node.find(f"{SSC}{kind}MappingTransformation") is not None for kind in ("Boolean", "Integer", "Enumeration")
        ):
            ends = f"{node.get('startElement', '')}.{node.get('startConnector', '')}"
            raise self._wrong(
                "SystemStructure.ssd", f"maps single values from `{ends}`; softneck reads factor and offset"
            )
        start, end = (
            (node.get(f"{which}Element", ""), node.get(f"{which}Connector", "")) for which in ("start", "end")
        )
        return Connection(start, end, self._affine(node))

    def _affine(self, node: ET.Element) -> Affine:
        line = node.find(f"{SSC}LinearTransformation")
        factor, offset = ("1", "0") if line is None else (line.get("factor", "1"), line.get("offset", "0"))
        convert = node.get("suppressUnitConversion", "false").strip() not in ("true", "1")
        return Affine(self._number("factor", factor), self._number("offset", offset), convert)

    def _bindings(self, node: ET.Element, component: str | None) -> tuple[Binding, ...]:
        return tuple(
            self._binding(item, component) for item in node.iterfind(f"{SSD}ParameterBindings/{SSD}ParameterBinding")
        )

    def _binding(self, node: ET.Element, component: str | None) -> Binding:
        table = node.find(f"{SSD}ParameterValues/{SSV}ParameterSet")
        if node.get("source"):
            table = self._outside(node, component)
        if table is None or table.tag != f"{SSV}ParameterSet":
            raise self._wrong("SystemStructure.ssd", "has a parameter binding without a parameter set")
        prefix, values = node.get("prefix", ""), {}
        for item in table.iterfind(f"{SSV}Parameters/{SSV}Parameter"):
            values[prefix + item.get("name", "")] = self._value(item)
        mapping = node.find(f"{SSD}ParameterMapping")
        entries = None
        if mapping is not None:
            inner = (
                self._outside(mapping, component) if mapping.get("source") else mapping.find(f"{SSM}ParameterMapping")
            )
            if inner is None:
                raise self._wrong("SystemStructure.ssd", "has an empty parameter mapping")
            entries = tuple(
                (item.get("target", ""), item.get("source", ""), self._affine(item))
                for item in inner.iterfind(f"{SSM}MappingEntry")
            )
        return Binding(values, entries, self._units(table.find(f"{SSV}Units")))

    def _outside(self, node: ET.Element, component: str | None) -> ET.Element:
        base, source = node.get("sourceBase"), node.get("source", "")
        if base not in _SOURCE_BASES or (base == "component" and component is None):
            raise self._wrong("SystemStructure.ssd", f"has the source base `{base}`, which SSP does not have there")
        if base == "component":
            raise self._wrong("SystemStructure.ssd", f"reads `{source}` from an FMU, which softneck does not")
        return self._xml(source)

    def _value(self, node: ET.Element) -> Value:
        name = node.get("name", "")
        typed = next((part for part in node if part.tag.startswith(SSV)), None)
        if typed is None:
            raise self._wrong("parameter set", f"has no value for `{name}`")
        kind, text = typed.tag.removeprefix(SSV), typed.get("value", "")
        if kind in OTHER_TYPES:
            return Value(text, "", kind)
        if kind not in _NUMBER_TYPES:
            raise self._wrong("parameter set", f"has `{name}` of unknown type {kind}")
        if kind == "Boolean":
            if text.strip() not in ("true", "false", "1", "0"):
                raise self._wrong("parameter set", f"has {name} = `{text}`, which is no Boolean")
            return Value(float(text.strip() in ("true", "1")), "", kind)
        return Value(self._number(name, text), typed.get("unit", ""), kind)

    def _units(self, node: ET.Element | None) -> dict[str, Unit]:
        units = {}
        for item in () if node is None else node.iterfind(f"{SSC}Unit"):
            base = item.find(f"{SSC}BaseUnit")
            if base is None:
                raise self._wrong("SystemStructure.ssd", f"has the unit `{item.get('name', '')}` without a base unit")
            powers = {key: int(self._number(key, value)) for key, value in base.attrib.items() if key not in _SCALES}
            factor, offset = (self._number(key, base.get(key, default)) for key, default in _SCALES.items())
            if factor == 0.0:
                raise self._wrong("SystemStructure.ssd", f"has the unit `{item.get('name', '')}` of factor 0")
            exponents = tuple(sorted((key, value) for key, value in powers.items() if value))
            units[item.get("name", "")] = Unit(exponents, factor, offset)
        return units


_SCALES = {"factor": "1", "offset": "0"}
