"""Read an SSP archive as the table of a loop file, with flat systems, and factors and offsets on connections."""

from __future__ import annotations

import atexit
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from softneck.core import SI_BASES, DataError, FileFormatError, SettingsError, require_positive, to_si
from softneck.fmu import unpack, unpacked
from softneck.loop import PART_NAMES, USE_MOTOR_POSITIONS
from softneck.robot import is_set_point
from softneck.runtime import Port

from ..parts._variables import Description, number_of, read_description
from ._parse import (
    OTHER_TYPES,
    Affine,
    Binding,
    Component,
    Connector,
    Structure,
    StructureReader,
    SystemNode,
    Unit,
    Value,
)

# Path of names to an element, and one of its connectors.
Place = tuple[tuple[str, ...], str]
# Kinds of connectors where connections can only start, and only end, from outside of their element.
_START_KINDS = ("output", "calculatedParameter")
_END_KINDS = ("input", "parameter", "structuralParameter")


@dataclass(frozen=True, slots=True)
class Line:
    """The line factor * value + offset."""

    factor: float = 1.0
    offset: float = 0.0

    def of(self, value: float) -> float:
        """Return factor * value + offset."""
        return self.factor * value + self.offset

    def then(self, other: Line) -> Line:
        """Return the line that applies this one and then the other."""
        return Line(other.factor * self.factor, other.factor * self.offset + other.offset)


@dataclass(frozen=True, slots=True)
class Ports:
    """The variables in an FMU's description; `others` are no ports, `enumerations` are ports that are enumerations."""

    inputs: Mapping[str, Port]
    outputs: Mapping[str, Port]
    parameters: Mapping[str, Port]
    others: frozenset[str]
    enumerations: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Flat:
    """The FMUs of a structure without its systems.

    `components`: path -> component. `links`: input of an FMU -> (output of an FMU, line). `values`: path -> values of
    inputs and parameters, in the FMU's units.
    """

    components: Mapping[tuple[str, ...], Component]
    links: Mapping[Place, tuple[Place, Line]]
    values: Mapping[tuple[str, ...], Mapping[str, float]]


def flatten(structure: Structure, ports: Mapping[str, Ports], where: Path) -> Flat:
    """Return the FMUs of a structure with their connections; `ports` are the variables by source."""
    flattening = _Flattening(structure, ports, where)
    flattening.visit((), structure.root)
    return flattening.result()


@dataclass(slots=True)
class _Flattening:
    structure: Structure
    ports: Mapping[str, Ports]
    where: Path
    components: dict[tuple[str, ...], Component] = field(default_factory=dict)
    systems: dict[tuple[str, ...], SystemNode] = field(default_factory=dict)
    # End of a connection -> its start and transformation.
    ending: dict[Place, tuple[Place, Affine]] = field(default_factory=dict)
    # Place -> value with the units of its own list; values of outer systems come later and replace inner ones.
    values: dict[Place, tuple[Value, Affine, Mapping[str, Unit]]] = field(default_factory=dict)

    def visit(self, path: tuple[str, ...], system: SystemNode) -> None:
        """Collect a system and all its elements."""
        self.systems[path] = system
        for name, element in system.elements.items():
            below = (*path, name)
            if isinstance(element, SystemNode):
                self.visit(below, element)
            else:
                self.components[below] = element
                self._bind(below, element.bindings)
        for connection in system.connections:
            start, end = (
                ((*path, element) if element else path, connector)
                for element, connector in (connection.start, connection.end)
            )
            for place, ends in ((start, False), (end, True)):
                kind = self._connector(place).kind
                # Inside a system its own inputs are starts of connections.
                if kind in (_START_KINDS if ends != (place[0] == path) else _END_KINDS):
                    raise self._wrong(
                        f"connects `{_join(start)}` to `{_join(end)}` against direction: `{_join(place)}` is of "
                        f"kind {kind}"
                    )
            if end in self.ending:
                raise self._wrong(f"`{_join(end)}` has two writers")
            self.ending[end] = (start, connection.affine)
        self._bind(path, system.bindings)

    def result(self) -> Flat:
        """Return the FMUs with their connections and values."""
        links, values = {}, {path: dict[str, float]() for path in self.components}
        for path, component in self.components.items():
            ports = self.ports[component.source]
            for place, found in self.values.items():
                name = place[1]
                if place[0] != path:
                    continue
                if name in ports.inputs or name in ports.parameters:
                    values[path][name] = self._number(place, found, Line())
                elif name in ports.others or name in ports.outputs:
                    raise self._wrong(f"sets `{_join(place)}`, which is neither a number's parameter nor an input")
            for name in (*ports.inputs, *ports.parameters):
                place = (path, name)
                if place not in self.ending:
                    continue
                origin, line = self._origin(place)
                if origin[0] in self.components:
                    if (
                        name not in ports.inputs
                        or origin[1] not in self.ports[self.components[origin[0]].source].outputs
                    ):
                        ends = f"`{_join(origin)}` to `{_join(place)}`"
                        raise self._wrong(f"connects {ends}; softneck connects outputs to inputs")
                    self._check_types(origin, place, line)
                    links[place] = (origin, line)
                elif origin in self.values:
                    values[path][name] = self._number(origin, self.values[origin], line, place)
        return Flat(self.components, links, values)

    def _check_types(self, origin: Place, place: Place, line: Line) -> None:
        """Raise SettingsError if the connection would round: numbers must not feed whole numbers or Booleans."""
        start = self.ports[self.components[origin[0]].source].outputs[origin[1]]
        end = self.ports[self.components[place[0]].source].inputs[place[1]]
        whole = (start.integer or start.boolean) and line.factor.is_integer() and line.offset.is_integer()
        if (end.integer and not whole) or (end.boolean and not (start.boolean and line == Line())):
            kind = "Boolean" if end.boolean else "whole number"
            raise self._wrong(
                f"connects `{_join(origin)}` to `{_join(place)}`, which is a {kind}; softneck does not round values"
            )

    def _origin(self, place: Place) -> tuple[Place, Line]:
        """Return the source of a place, through systems, and the line from there."""
        line, visited = Line(), {place}
        while place in self.ending:
            start, affine = self.ending[place]
            line = self._step(start, place, affine).then(line)
            place = start
            if place in visited:
                raise self._wrong(f"connects `{_join(place)}` to itself")
            visited.add(place)
        return place, line

    def _step(self, start: Place, end: Place, affine: Affine) -> Line:
        after = Line(affine.factor, affine.offset)
        if not affine.convert:
            return after
        unit_a, unit_b = self._connector(start).unit, self._connector(end).unit
        a, b = self._find_unit(unit_a, {}), self._find_unit(unit_b, {})
        return self._unit_line(unit_a, a, unit_b, b, f"`{_join(start)}` to `{_join(end)}`").then(after)

    def _unit_line(self, unit_a: str, a: Unit | None, unit_b: str, b: Unit | None, what: str) -> Line:
        """Return the line from unit a to unit b; the identity if one is not given."""
        if unit_a == unit_b or not unit_a or not unit_b:
            return Line()
        if a is None or b is None:
            unknown = unit_a if a is None else unit_b
            raise self._wrong(f"has the unknown unit `{unknown}` in the connection {what}; define it in ssd:Units")
        if a.base != b.base:
            raise self._wrong(f"connects [{unit_a}] to [{unit_b}]: {what}; these units do not fit")
        return Line(a.factor / b.factor, (a.offset - b.offset) / b.factor)

    def _connector(self, place: Place) -> Connector:
        """Return a connector of the structure, with kind and unit of the FMU where the structure has none."""
        path, name = place
        if path in self.components:
            component = self.components[path]
            ports = self.ports[component.source]
            declared = component.connectors.get(name, Connector(""))
            kind = "Enumeration" if name in ports.enumerations else declared.type
            if kind in OTHER_TYPES:
                raise self._wrong(f"connects `{_join(place)}`, which is of type {kind}; softneck connects numbers")
            for kind, table in (("input", ports.inputs), ("output", ports.outputs), ("parameter", ports.parameters)):
                if name in table:
                    unit = "" if table[name].unit == "1" else table[name].unit
                    return Connector(kind, declared.unit or unit)
            if name in ports.others:
                raise self._wrong(f"connects `{_join(place)}`, which is no input, output or parameter with a number")
        elif path in self.systems and name in self.systems[path].connectors:
            return self.systems[path].connectors[name]
        raise self._wrong(f"connects `{_join(place)}`, which is not there")

    def _find_unit(self, name: str, own: Mapping[str, Unit]) -> Unit | None:
        for units in (own, self.structure.units):
            if name in units:
                return units[name]
        try:
            factor, si = to_si(name or "1")
        except DataError:
            return None
        return Unit(tuple(sorted(SI_BASES[si].items())), factor) if si in SI_BASES else None

    def _bind(self, path: tuple[str, ...], bindings: tuple[Binding, ...]) -> None:
        for binding in bindings:
            for name, (value, affine) in _binding_values(binding).items():
                place = self._place(path, name)
                if place is not None:
                    self.values[place] = (value, affine, binding.units)

    def _place(self, path: tuple[str, ...], name: str) -> Place | None:
        """Return the place of a hierarchical name below `path`; None if there is none, which SSP ignores."""
        if path in self.components or name in self.systems[path].connectors:
            return path, name
        # Names of elements may have dots: the longest matching one.
        for element in sorted(self.systems[path].elements, key=len, reverse=True):
            if name.startswith(f"{element}."):
                return self._place((*path, element), name[len(element) + 1 :])
        return None

    def _number(
        self, place: Place, found: tuple[Value, Affine, Mapping[str, Unit]], line: Line, target: Place | None = None
    ) -> float:
        """Return the value of a place after the line from there to `target`, by default the place itself."""
        value, affine, own = found
        if isinstance(value.value, str):
            raise self._wrong(f"sets `{_join(place)}` to the {value.type} `{value.value}`; softneck sets numbers")
        after = Line(affine.factor, affine.offset)
        if affine.convert and value.unit:
            unit = self._connector(place).unit
            what = f"the value of `{_join(place)}`"
            units = self._find_unit(value.unit, own), self._find_unit(unit, {})
            after = self._unit_line(value.unit, units[0], unit, units[1], what).then(after)
        number, (path, name) = after.then(line).of(value.value), target or place
        ports = self.ports[self.components[path].source]
        port = ports.inputs.get(name) or ports.parameters[name]
        if (port.integer and not number.is_integer()) or (port.boolean and number not in (0.0, 1.0)):
            kind = "Boolean" if port.boolean else "whole number"
            raise self._wrong(f"sets `{_join((path, name))}`, which is a {kind}, to {number:g}")
        return number

    def _wrong(self, what: str) -> SettingsError:
        return SettingsError(f"{self.where}: its structure {what}.")


def _binding_values(binding: Binding) -> dict[str, tuple[Value, Affine]]:
    if binding.mapping is None:
        return {name: (value, Affine()) for name, value in binding.values.items()}
    return {
        target: (binding.values[source], affine)
        for target, source, affine in binding.mapping
        if source in binding.values
    }


def _join(place: Place) -> str:
    return ".".join((*place[0], place[1]))


@dataclass(frozen=True, slots=True)
class StructureTable:
    """An archive as a table with the keys of a loop file; if it is no closed loop, all FMUs are under "part"."""

    table: dict[str, Any]
    closed: bool


def read_ssp(path: str | Path, *, step: float | None = None) -> StructureTable:
    """Read an SSP 1.0 or 2.0 archive of FMUs for co-simulation (FMI 2.0 or 3.0), of any tool.

    Nested systems become flat; transformations and units of connections become factors and offsets; parameter sets and
    mappings become values. SSP prescribes no master: step and order are those of softneck's annotation, else the step
    is OMSimulator's or the smallest of the FMUs, and the order "jacobi". The FMUs are unpacked in a temporary folder
    until this process ends. Raises FileFormatError: no archive, a damaged one, or one that names files that are missing
    or outside of it. Raises SettingsError: features that a loop does not have; the message names them.
    """
    source = Path(path)
    folder = unpack(source, main="SystemStructure.ssd", what="an SSP archive")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    reader = StructureReader(source, folder)
    structure = reader.structure()
    if step is not None:
        require_positive("step", step, "s")
        structure = replace(structure, step=step)
    files = {component.source: reader.file(component.source) for component in _components(structure.root)}
    if not files:
        raise SettingsError(f"{source}: its structure has no components; there is nothing to run.")
    descriptions = {name: _description(source, name, file) for name, file in files.items()}
    flat = flatten(structure, {name: _ports(item) for name, item in descriptions.items()}, source)
    return _TableBuilder(source, structure, flat, files, descriptions).build()


def _components(system: SystemNode) -> list[Component]:
    listed: list[Component] = []
    for element in system.elements.values():
        listed += _components(element) if isinstance(element, SystemNode) else [element]
    return listed


def _description(source: Path, name: str, file: Path) -> Description:
    inside = f"{source}:{name}"
    try:
        with unpacked(file) as folder:
            return read_description(Path(inside), folder, {})
    except FileFormatError as error:  # names the temporary folder
        raise FileFormatError(str(error).replace(str(file), inside)) from error


def _ports(description: Description) -> Ports:
    inputs, outputs, parameters = (
        {port.name: port for port in description.ports(kind)} for kind in ("input", "output", "parameter")
    )
    known = {*inputs, *outputs, *parameters}
    others = frozenset(variable.name or "" for variable in description.model.modelVariables) - known
    lists = frozenset(name for name, variable in description.variables.items() if variable.type == "Enumeration")
    return Ports(inputs, outputs, parameters, others, lists)


@dataclass(frozen=True, slots=True)
class _TableBuilder:
    source: Path
    structure: Structure
    flat: Flat
    files: Mapping[str, Path]
    descriptions: Mapping[str, Description]

    def build(self) -> StructureTable:
        names, closed = self._names()
        table: dict[str, Any] = {
            "duration_s": self._duration(),
            "order": self.structure.order or "jacobi",
            "connections": {
                f"{names[path]}.{name}": {
                    "from": f"{names[origin]}.{output}",
                    "factor": line.factor,
                    "offset": line.offset,
                }
                for (path, name), ((origin, output), line) in self.flat.links.items()
            },
        }
        if self.structure.robot is not None:
            table["robot"] = self.structure.robot
        step = self._step()
        for path, component in self.flat.components.items():
            part = {
                "fmu": str(self.files[component.source]),
                "sample_time_s": step,
                "parameters": self._values(path, component, closed=closed),
            }
            if names[path] in PART_NAMES and closed:
                table[names[path]] = part
            else:
                table.setdefault("part", []).append({"name": names[path], "role": "plant", **part})
        return StructureTable(table, closed)

    def _names(self) -> tuple[dict[tuple[str, ...], str], bool]:
        """Return path -> name in the loop, and whether the FMUs are a closed loop."""
        roles: dict[str, list[tuple[str, ...]]] = {role: [] for role in PART_NAMES}
        for path, component in self.flat.components.items():
            role = self.descriptions[component.source].annotation.role
            role = role or (path[-1] if path[-1] in PART_NAMES else "")
            if role:
                roles[role].append(path)
        closed = all(len(roles[role]) == 1 for role in ("plant", "controller", "reference"))
        closed = closed and len(roles["observer"]) < 2 and self._has_set_points(roles["plant"][0])
        names = {paths[0]: role for role, paths in roles.items() if paths} if closed else {}
        for path in self.flat.components:
            if path not in names:
                plain = re.sub(r"\W", "_", "_".join(path), flags=re.ASCII)
                plain = plain if plain.isidentifier() and plain not in PART_NAMES else f"part_{plain}"
                while plain in names.values():
                    plain += "_"
                names[path] = plain
        return names, closed

    def _has_set_points(self, plant: tuple[str, ...]) -> bool:
        """Return whether all set-points of a plant are connected."""
        description = self.descriptions[self.flat.components[plant].source]
        names = [port.name for port in description.ports("input") if is_set_point(port.name)]
        return bool(names) and all((plant, name) in self.flat.links for name in names)

    def _values(self, path: tuple[str, ...], component: Component, *, closed: bool) -> dict[str, float]:
        """Return the set parameters, and a value for each unconnected input, which prevents a connection by name."""
        description, given = self.descriptions[component.source], self.flat.values[path]
        values = dict(given)
        for port in description.ports("input"):
            if (path, port.name) not in self.flat.links:
                values.setdefault(port.name, float("nan") if port.missing else port.start)
        for port in description.ports("parameter"):
            if closed and port.name == USE_MOTOR_POSITIONS:
                values.setdefault(port.name, port.start)  # the default of a loop is true
        return values

    def _step(self) -> float:
        if self.structure.step is not None:
            return self.structure.step
        if not (steps := self._experiment_values("stepSize")):
            raise SettingsError(
                f"{self.source}: neither the structure nor an FMU has a step size; give one in s, for instance "
                "`--step 0.01`."
            )
        return min(steps)

    def _experiment_values(self, key: str) -> list[float]:
        experiments = [item.model.defaultExperiment for item in self.descriptions.values()]
        return [number_of(text, 0.0) for item in experiments if (text := getattr(item, key, None))]

    def _duration(self) -> float:
        if self.structure.stop is not None:
            return self.structure.stop
        if not (stops := self._experiment_values("stopTime")):
            raise SettingsError(f"{self.source}: neither the structure nor an FMU has a stop time.")
        return max(stops)
