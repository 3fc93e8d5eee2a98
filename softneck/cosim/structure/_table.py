"""An SSP archive as the table of a loop file: its FMUs by role, their values, all connections by name."""

from __future__ import annotations

import atexit
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck.core import FileFormatError, SettingsError
from softneck.fmu import unpack, unpacked
from softneck.loop import USE_MOTOR_POSITIONS
from softneck.robot import is_set_point

from ..parts._variables import Description, number_of, read_description
from ._flat import Flat, Line, Ports, flatten
from ._parse import Component, Reader, Structure, SystemNode

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
