"""An SSP archive as the table of a loop file: nested systems become flat, connections get factors and offsets."""

from __future__ import annotations

import atexit
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softneck.core import SI_BASES, DataError, FileFormatError, SettingsError, to_si
from softneck.fmu import unpack, unpacked
from softneck.loop import USE_MOTOR_POSITIONS
from softneck.robot import is_set_point
from softneck.runtime import Port

from ..parts._variables import Description, number_of, read_description
from ._parse import Affine, Binding, Component, Connector, Reader, Structure, SystemNode, Unit, Value

# An element by the names on the way to it, and one of its connectors.
Place = tuple[tuple[str, ...], str]
# Kinds of connectors at which a connection can begin only, and end only, seen from outside of their element.
_GIVES = ("output", "calculatedParameter")
_TAKES = ("input", "parameter", "structuralParameter")


@dataclass(frozen=True, slots=True)
class Line:
    """factor * value + offset."""

    factor: float = 1.0
    offset: float = 0.0

    def of(self, value: float) -> float:
        """Return the line's value."""
        return self.factor * value + self.offset

    def then(self, other: Line) -> Line:
        """Return this line and then the other as one."""
        return Line(other.factor * self.factor, other.factor * self.offset + other.offset)


@dataclass(frozen=True, slots=True)
class Ports:
    """What an FMU's description says of its variables: those that a loop moves, and the names of all others.

    Attributes:
        inputs, outputs, parameters: name -> port.
        others: names of variables that are none of these.
        enumerations: names of those above whose numbers stand for items of a list.
    """

    inputs: Mapping[str, Port]
    outputs: Mapping[str, Port]
    parameters: Mapping[str, Port]
    others: frozenset[str]
    enumerations: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Flat:
    """The FMUs of a structure without its systems.

    Attributes:
        components: path -> component.
        links: input of an FMU -> (output of an FMU, line).
        values: path -> values of inputs and parameters, in the FMU's units.
    """

    components: Mapping[tuple[str, ...], Component]
    links: Mapping[Place, tuple[Place, Line]]
    values: Mapping[tuple[str, ...], Mapping[str, float]]


def flatten(structure: Structure, ports: Mapping[str, Ports], where: Path) -> Flat:
    """Return the FMUs of a structure and how they are connected.

    Args:
        structure: as read.
        ports: source of each component -> its variables.
        where: the archive, for messages.

    Raises:
        SettingsError: two writers of an input, connectors that are not there, units that do not fit, what a loop
            cannot carry; the line names it.
    """
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
    # What ends at a place: where it starts, and its transformation.
    ending: dict[Place, tuple[Place, Affine]] = field(default_factory=dict)
    # Values by place, with the units of their own list; those of outer systems come later and win.
    values: dict[Place, tuple[Value, Affine, Mapping[str, Unit]]] = field(default_factory=dict)

    def visit(self, path: tuple[str, ...], system: SystemNode) -> None:
        """Take in a system and all below it."""
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
                # Seen from within a system, what comes into it leaves its own connector.
                if kind in (_GIVES if ends != (place[0] == path) else _TAKES):
                    raise self._wrong(
                        f"connects `{_named(start)}` to `{_named(end)}` against direction: `{_named(place)}` is of "
                        f"kind {kind}"
                    )
            if end in self.ending:
                raise self._wrong(f"`{_named(end)}` has two writers")
            self.ending[end] = (start, connection.affine)
        self._bind(path, system.bindings)

    def result(self) -> Flat:
        """Return what was taken in, without systems."""
        links, values = {}, {path: dict[str, float]() for path in self.components}
        for path, component in self.components.items():
            ports = self.ports[component.source]
            for place, found in self._given(path):
                name = place[1]
                if name in ports.inputs or name in ports.parameters:
                    values[path][name] = self._number(place, found, Line())
                elif name in ports.others or name in ports.outputs:
                    raise self._wrong(f"sets `{_named(place)}`, which is neither a number's parameter nor an input")
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
                        ends = f"`{_named(origin)}` to `{_named(place)}`"
                        raise self._wrong(f"connects {ends}; softneck connects outputs to inputs")
                    self._check_types(origin, place, line)
                    links[place] = (origin, line)
                elif origin in self.values:
                    values[path][name] = self._number(origin, self.values[origin], line, place)
        return Flat(self.components, links, values)

    def _check_types(self, origin: Place, place: Place, line: Line) -> None:
        """Refuse to round: whole numbers and Booleans count as numbers, numbers do not count as them."""
        start = self.ports[self.components[origin[0]].source].outputs[origin[1]]
        end = self.ports[self.components[place[0]].source].inputs[place[1]]
        whole = (start.integer or start.boolean) and line.factor.is_integer() and line.offset.is_integer()
        if (end.integer and not whole) or (end.boolean and not (start.boolean and line == Line())):
            kind = "Boolean" if end.boolean else "whole number"
            raise self._wrong(
                f"connects `{_named(origin)}` to `{_named(place)}`, which is a {kind}; softneck does not round what it "
                "is given"
            )

    def _given(self, path: tuple[str, ...]) -> Iterator[tuple[Place, tuple[Value, Affine, Mapping[str, Unit]]]]:
        for place, found in self.values.items():
            if place[0] == path:
                yield place, found

    def _origin(self, place: Place) -> tuple[Place, Line]:
        """Return what feeds a place, through systems, and the line from there."""
        line, seen = Line(), {place}
        while place in self.ending:
            start, affine = self.ending[place]
            line = self._step(start, place, affine).then(line)
            place = start
            if place in seen:
                raise self._wrong(f"connects `{_named(place)}` to itself")
            seen.add(place)
        return place, line

    def _step(self, start: Place, end: Place, affine: Affine) -> Line:
        after = Line(affine.factor, affine.offset)
        if not affine.convert:
            return after
        (a, unit_a), (b, unit_b) = ((self._unit(place), self._connector(place).unit) for place in (start, end))
        return self._converted(unit_a, a, unit_b, b, f"`{_named(start)}` to `{_named(end)}`").then(after)

    def _converted(self, unit_a: str, a: Unit | None, unit_b: str, b: Unit | None, what: str) -> Line:
        """Return the line from unit a to unit b; where one is not said nothing is converted."""
        if unit_a == unit_b or not unit_a or not unit_b:
            return Line()
        if a is None or b is None:
            unknown = unit_a if a is None else unit_b
            raise self._wrong(f"has the unknown unit `{unknown}` on the way from {what}; define it in ssd:Units")
        if a.base != b.base:
            raise self._wrong(f"connects [{unit_a}] to [{unit_b}]: {what}; these units do not fit")
        return Line(a.factor / b.factor, (a.offset - b.offset) / b.factor)

    def _connector(self, place: Place) -> Connector:
        """Return a connector as the structure says it; what it leaves out, as the FMU does."""
        path, name = place
        if path in self.components:
            component = self.components[path]
            ports = self.ports[component.source]
            said = component.connectors.get(name)
            kind = "Enumeration" if name in ports.enumerations else said.type if said is not None else ""
            if kind in ("Enumeration", "String", "Binary", "Clock"):
                raise self._wrong(f"connects `{_named(place)}`, which is of type {kind}; softneck connects numbers")
            for kind, table in (("input", ports.inputs), ("output", ports.outputs), ("parameter", ports.parameters)):
                if name in table:
                    unit = "" if table[name].unit == "1" else table[name].unit
                    return Connector(kind, said.unit if said is not None and said.unit else unit)
            if name in ports.others:
                raise self._wrong(f"connects `{_named(place)}`, which is no number's input, output or parameter")
        elif path in self.systems and name in self.systems[path].connectors:
            return self.systems[path].connectors[name]
        raise self._wrong(f"connects `{_named(place)}`, which is not there")

    def _unit(self, place: Place) -> Unit | None:
        return self._known(self._connector(place).unit, {})

    def _known(self, name: str, own: Mapping[str, Unit]) -> Unit | None:
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
            for name, (value, affine) in _mapped(binding).items():
                place = self._place(path, name)
                if place is not None:
                    self.values[place] = (value, affine, binding.units)

    def _place(self, path: tuple[str, ...], name: str) -> Place | None:
        """Return the place of a hierarchical name below `path`; None where nothing has it, which SSP ignores."""
        if path in self.components or name in self.systems[path].connectors:
            return path, name
        # An element's name may have dots itself: the longest that fits.
        for element in sorted(self.systems[path].elements, key=len, reverse=True):
            if name.startswith(f"{element}."):
                return self._place((*path, element), name[len(element) + 1 :])
        return None

    def _number(
        self, place: Place, found: tuple[Value, Affine, Mapping[str, Unit]], line: Line, target: Place | None = None
    ) -> float:
        """Return the value given at a place, behind the line from there to `target`, the place itself by default."""
        value, affine, own = found
        if isinstance(value.value, str):
            raise self._wrong(f"sets `{_named(place)}` to the {value.type} `{value.value}`; softneck sets numbers")
        after = Line(affine.factor, affine.offset)
        if affine.convert and value.unit:
            unit = self._connector(place).unit
            what = f"the value of `{_named(place)}`"
            after = self._converted(value.unit, self._known(value.unit, own), unit, self._known(unit, {}), what).then(
                after
            )
        number, (path, name) = after.then(line).of(value.value), target or place
        ports = self.ports[self.components[path].source]
        port = ports.inputs.get(name) or ports.parameters[name]
        if (port.integer and not number.is_integer()) or (port.boolean and number not in (0.0, 1.0)):
            kind = "Boolean" if port.boolean else "whole number"
            raise self._wrong(f"sets `{_named((path, name))}`, which is a {kind}, to {number:g}")
        return number

    def _wrong(self, what: str) -> SettingsError:
        return SettingsError(f"{self.where}: its structure {what}.")


def _mapped(binding: Binding) -> dict[str, tuple[Value, Affine]]:
    if binding.mapping is None:
        return {name: (value, Affine()) for name, value in binding.values.items()}
    return {
        target: (binding.values[source], affine)
        for target, source, affine in binding.mapping
        if source in binding.values
    }


def _named(place: Place) -> str:
    return ".".join((*place[0], place[1]))


_ROLES = ("plant", "observer", "controller", "reference")


@dataclass(frozen=True, slots=True)
class StructureTable:
    """What an archive holds.

    Attributes:
        table: with the keys of a loop file; paths lead to where the archive was unpacked.
        closed: whether it is a closed loop, with one plant, controller and reference; else its FMUs stand under
            "part", whatever they are.
    """

    table: dict[str, Any]
    closed: bool


def read_ssp(path: str | Path) -> StructureTable:
    """Read an SSP 1.0 or 2.0 archive of FMUs for co-simulation (FMI 2.0 or 3.0), of any tool.

    Nested systems become flat; lines and units on connections become factors and offsets; parameter sets and mappings
    become values. SSP prescribes no master: step and order are those that softneck noted, else the step is
    OMSimulator's or the smallest of the FMUs', and the order "jacobi". The FMUs are unpacked in a temporary folder
    until this process ends.

    Raises:
        FileFormatError: no archive, or one that is damaged, reaches out of itself or lacks what it names.
        SettingsError: what a loop cannot carry; the line names it.
    """
    source = Path(path)
    folder = unpack(source, main="SystemStructure.ssd", what="an SSP archive")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    reader = Reader(source, folder)
    structure = reader.structure()
    files = {component.source: reader.file(component.source) for component in _components(structure.root)}
    if not files:
        raise SettingsError(f"{source}: its structure has no components; there is nothing to run.")
    descriptions = {name: _description(source, name, file) for name, file in files.items()}
    flat = flatten(structure, {name: _ports(item) for name, item in descriptions.items()}, source)
    return _Writer(source, structure, flat, files, descriptions).write()


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
    except FileFormatError as error:  # of a place that nobody knows
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
class _Writer:
    source: Path
    structure: Structure
    flat: Flat
    files: Mapping[str, Path]
    descriptions: Mapping[str, Description]

    def write(self) -> StructureTable:
        names, closed = self._names()
        table: dict[str, Any] = {
            "duration_s": self._duration(),
            "order": self.structure.order or "jacobi",
            "connections": {
                f"{names[path]}.{name}": _link(f"{names[origin]}.{output}", line)
                for (path, name), ((origin, output), line) in self.flat.links.items()
            },
        }
        step = self._step()
        for path, component in self.flat.components.items():
            part = {
                "fmu": str(self.files[component.source]),
                "sample_time_s": step,
                "parameters": self._values(path, component, closed=closed),
            }
            if names[path] in _ROLES and closed:
                table[names[path]] = part
            else:
                table.setdefault("part", []).append({"name": names[path], "role": "plant", **part})
        return StructureTable(table, closed)

    def _names(self) -> tuple[dict[tuple[str, ...], str], bool]:
        """Return path -> name in a loop, and whether the FMUs make a closed one."""
        roles: dict[str, list[tuple[str, ...]]] = {role: [] for role in _ROLES}
        for path, component in self.flat.components.items():
            role = self.descriptions[component.source].annotation.role
            role = role or (path[-1] if path[-1] in _ROLES else "")
            if role:
                roles[role].append(path)
        closed = all(len(roles[role]) == 1 for role in ("plant", "controller", "reference"))
        closed = closed and len(roles["observer"]) < 2 and self._moved(roles["plant"][0])
        names = {paths[0]: role for role, paths in roles.items() if paths} if closed else {}
        for path in self.flat.components:
            if path not in names:
                plain = re.sub(r"\W", "_", "_".join(path), flags=re.ASCII)
                plain = plain if plain.isidentifier() and plain not in _ROLES else f"part_{plain}"
                while plain in names.values():
                    plain += "_"
                names[path] = plain
        return names, closed

    def _moved(self, plant: tuple[str, ...]) -> bool:
        """Return whether somebody feeds all set-points of a plant."""
        description = self.descriptions[self.flat.components[plant].source]
        moved = [port.name for port in description.ports("input") if is_set_point(port.name)]
        return bool(moved) and all((plant, name) in self.flat.links for name in moved)

    def _values(self, path: tuple[str, ...], component: Component, *, closed: bool) -> dict[str, float]:
        """Return parameters that are set, and a value for each input that nobody feeds: no name connects by itself."""
        description, given = self.descriptions[component.source], self.flat.values[path]
        values = dict(given)
        for port in description.ports("input"):
            if (path, port.name) not in self.flat.links:
                values.setdefault(port.name, float("nan") if port.missing else port.start)
        for port in description.ports("parameter"):
            if closed and port.name == USE_MOTOR_POSITIONS:
                values.setdefault(port.name, port.start)  # a loop of ours would say true
        return values

    def _step(self) -> float:
        if self.structure.step is not None:
            return self.structure.step
        experiments = [item.model.defaultExperiment for item in self.descriptions.values()]
        steps = [number_of(item.stepSize, 0.0) for item in experiments if item is not None and item.stepSize]
        if not steps:
            raise SettingsError(
                f"{self.source}: neither the structure nor an FMU says a step size; put `<ssd:Annotations>"
                '<ssc:Annotation type="softneck"><Master order="jacobi" stepSize="0.01"/></ssc:Annotation>'
                "</ssd:Annotations>` at the end of its system."
            )
        return min(steps)

    def _duration(self) -> float:
        if self.structure.stop is not None:
            return self.structure.stop
        experiments = [item.model.defaultExperiment for item in self.descriptions.values()]
        stops = [number_of(item.stopTime, 0.0) for item in experiments if item is not None and item.stopTime]
        if not stops:
            raise SettingsError(f"{self.source}: neither the structure nor an FMU says a stop time.")
        return max(stops)


def _link(origin: str, line: Line) -> str | dict[str, Any]:
    return {"from": origin, "factor": line.factor, "offset": line.offset}
