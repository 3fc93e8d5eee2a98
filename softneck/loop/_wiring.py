"""Connect inputs to outputs by name, with conversion of units, on one vector of signals.

The "bus" holds all outputs, references and constants of a loop; the inputs of a part are a selection of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, to_si
from softneck.robot import Robot
from softneck.runtime import Port

from ._loop import PART_NAMES, Link, Part
from ._references import reference_ports

_HEALTHY_SOURCES = (("observer", "healthy"), ("plant", "measurement_valid"))
_NECK = Robot.preset("neck")
# Inputs without a source: measurements are valid, controllers enabled.
_DEFAULTS = {"healthy": 1.0, "measurement_valid": 1.0, "enabled": 1.0}


def measured_names(robot: Robot) -> tuple[str, ...]:
    """Return the names of outputs and their rates, which a sensor may measure."""
    return (*robot.outputs.names, *(f"{name}_rate" for name in robot.outputs.names))


def _sources(wanted: str, robot: Robot) -> tuple[tuple[str, str], ...]:
    """Return the sources of an input, best first; empty for an input that connects to an output of the same name."""
    if wanted == "healthy":
        return _HEALTHY_SOURCES
    bare = wanted.removesuffix("_measured")
    return (("plant", wanted), ("plant", bare)) if wanted != bare and bare in measured_names(robot) else ()


@dataclass(frozen=True, slots=True)
class BusSignal:
    """A position on the bus that a result has as a signal; `part` is "sensor" or "fault" for copies of faults."""

    slot: int
    part: str
    port: Port


@dataclass(frozen=True, slots=True, eq=False)
class Tap:
    """The inputs of one part as a selection of the bus.

    `part`: its name in the loop. `ports`: of the inputs. `owners`: part that feeds each input, "" for a constant.
    `sources`: name of each source, such as "plant `pitch`", for messages. `slots`: (n_in,) positions in the bus.
    `scales`: (2, n_in) factor and offset from the source to the input; None where nothing is converted. `fragile`:
    inputs whose source may be missing, but that must not be missing themselves.
    """

    part: str
    ports: tuple[Port, ...]
    owners: tuple[str, ...]
    sources: tuple[str, ...]
    slots: np.ndarray
    scales: Matrix | None
    fragile: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the inputs."""
        return tuple(port.name for port in self.ports)

    def read(self, bus: Vector, time: float) -> Vector:
        """Return the inputs (n_in,) from the bus; raise DataError if a needed one is missing."""
        u = bus[self.slots] if self.scales is None else bus[self.slots] * self.scales[0] + self.scales[1]
        if self.fragile.size and not np.isfinite(u[self.fragile]).all():
            i = self.fragile[~np.isfinite(u[self.fragile])][0]
            raise DataError(
                f"input `{self.names[i]}` of the {self.part} is {u[i]} at t = {time:g} s (from {self.sources[i]}); "
                "put an observer between, which bridges missing measurements."
            )
        return u


@dataclass(frozen=True, slots=True, eq=False)
class Wiring:
    """All connections of a loop.

    `start`: (n_bus,) the bus with its start values and constants. `named`: its signals in a result. `spans`: part ->
    its outputs in the bus. `taps`: part -> its inputs.
    """

    start: Vector
    named: tuple[BusSignal, ...]
    spans: Mapping[str, slice]
    taps: Mapping[str, Tap]


def wire(
    parts: Mapping[str, Part],
    constants: Mapping[str, Mapping[str, float]],
    connections: Mapping[str, str | Link] | None = None,
    robot: Robot = _NECK,
    *,
    closed: bool = True,
) -> Wiring:
    """Connect the parts "plant", "controller" and others by name.

    `parts`: name in the loop -> part. `constants`: part -> values of inputs that are not connected, such as `payload`
    of the plant. `connections`: "part.input" -> "part.output", or a `Link`, for ports with different names. `robot`:
    that is controlled. `closed`: whether it is a loop with a plant and a reference. Raises SettingsError: an input
    without a source, two writers, units that do not fit, an unknown name.
    """
    wired = _Wired(tuple((name, tuple(part.inputs), tuple(part.outputs)) for name, part in parts.items()),
                   tuple((name, tuple(values.items())) for name, values in constants.items()),
                   tuple((connections or {}).items()), robot, closed)  # fmt: skip
    return _wire(wired)


@dataclass(frozen=True, slots=True)
class _Ports:
    """The ports of a part."""

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]


@dataclass(frozen=True, slots=True)
class _Wired:
    """What a wiring depends on.

    `ports`: name, inputs and outputs of each part. `constants`: part, and name and value of each. `connections`: target
    and origin.
    """

    ports: tuple[tuple[str, tuple[Port, ...], tuple[Port, ...]], ...]
    constants: tuple[tuple[str, tuple[tuple[str, float], ...]], ...]
    connections: tuple[tuple[str, str | Link], ...]
    robot: Robot
    closed: bool


@lru_cache(maxsize=64)
def _wire(asked: _Wired) -> Wiring:
    """Connect parts; of a search and its certificate thousands of loops have the same few wirings."""
    parts = {name: _Ports(inputs, outputs) for name, inputs, outputs in asked.ports}
    constants = {name: dict(values) for name, values in asked.constants}
    connections, robot, closed = dict(asked.connections), asked.robot, asked.closed
    if closed:
        _check_plant(parts["plant"], constants.get("plant", {}), robot)
    ports = [(name, port) for name, part in parts.items() for port in part.outputs]
    if closed and "reference" not in parts:
        ports += [("reference", port) for port in reference_ports(robot)]
    slots = {(name, port.name): i for i, (name, port) in enumerate(ports)}
    links = _links(connections, parts, slots, constants)
    extra: list[float] = []

    taps = {}
    for name, part in parts.items():
        names = [port.name for port in part.inputs]
        for constant in constants.get(name, {}):
            if constant not in names:
                raise SettingsError(f"`{constant}` is not an input of the {name}; its inputs are {', '.join(names)}.")
        finder = _SourceFinder(name, parts, slots, constants.get(name, {}), links, robot)
        places = []
        for value in map(finder.source, part.inputs):
            if isinstance(value, tuple):
                places.append(slots[value])
            else:
                extra.append(value)
                places.append(len(ports) + len(extra) - 1)
        taps[name] = _tap(name, part, places, ports, connections)
    start = np.array([port.start for _, port in ports] + extra)
    named = tuple(BusSignal(i, part, port) for i, (part, port) in enumerate(ports))
    spans, first = {}, 0
    for name, part in parts.items():
        spans[name] = slice(first, first + len(part.outputs))
        first += len(part.outputs)
    spans.setdefault("reference", slice(first, len(ports)))
    return Wiring(start, named, spans, taps)


def _links(
    connections: Mapping[str, str | Link],
    parts: Mapping[str, _Ports],
    slots: Mapping[tuple[str, str], int],
    constants: Mapping[str, Mapping[str, float]],
) -> dict[tuple[str, str], tuple[str, str]]:
    """Return (part, input) -> (part, output) of explicit connections."""
    links = {}
    for target, origin in connections.items():
        origin = origin.origin if isinstance(origin, Link) else origin
        (part, name), (owner, output) = _ends(target), _ends(origin)
        if part not in parts or name not in {port.name for port in parts[part].inputs}:
            raise SettingsError(f"connection to `{target}`: there is no such input; {_offers(part, parts, 'inputs')}")
        if (owner, output) not in slots:
            offers = _offers(owner, parts, "outputs")
            raise SettingsError(f"connection from `{origin}`: there is no such output; {offers}")
        if name in constants.get(part, {}):
            raise SettingsError(f"input `{name}` of the {part} has two writers: `{origin}` and a constant.")
        links[part, name] = (owner, output)
    return links


def _ends(text: str) -> tuple[str, str]:
    part, dot, name = text.partition(".")
    if not dot or not part or not name:
        raise SettingsError(f"a connection is written part.variable; got `{text}`.")
    return part, name


def _offers(part: str, parts: Mapping[str, _Ports], what: str) -> str:
    if part not in parts:
        return f"the parts are {', '.join(parts)}."
    return f"the {part} has {', '.join(port.name for port in getattr(parts[part], what)) or 'none'}."


def _check_plant(plant: _Ports, constants: Mapping[str, float], robot: Robot) -> None:
    names = [port.name for port in plant.inputs]
    for name in robot.set_points:
        if name not in names:
            raise SettingsError(f"the plant has no input `{name}`; its inputs are {', '.join(names)}.")
    for name in constants:
        if name in robot.set_points:
            raise SettingsError(f"the plant's input `{name}` has two writers: the controller and a constant.")


@dataclass(frozen=True, slots=True, eq=False)
class _SourceFinder:
    """Finds the sources of the inputs of part `name`."""

    name: str
    parts: Mapping[str, _Ports]
    slots: Mapping[tuple[str, str], int]
    constants: Mapping[str, float]
    links: Mapping[tuple[str, str], tuple[str, str]]
    robot: Robot

    def source(self, port: Port) -> tuple[str, str] | float:
        """Return the (part, output) that feeds `port`, or its constant."""
        if (self.name, port.name) in self.links:
            return self.links[self.name, port.name]
        if port.name in self.constants:
            return float(self.constants[port.name])
        if self.name == "plant" and port.name not in self.robot.set_points:
            return math.nan if port.missing else port.start
        for candidate in _candidates(self.name, port.name, self.parts, self.robot):
            if candidate in self.slots:
                return candidate
        # Any output of the same name may feed a further part; the four usual parts are never connected by chance.
        usual = PART_NAMES if self.name in PART_NAMES else ()
        others = [part for part in self.parts if part not in (self.name, *usual) and (part, port.name) in self.slots]
        if len(others) > 1:
            raise SettingsError(
                f"input `{port.name}` of the {self.name} has {len(others)} writers: {', '.join(others)}; "
                "choose one in [connections]."
            )
        if others:
            return others[0], port.name
        if port.name in _DEFAULTS:
            return _DEFAULTS[port.name]
        candidates = _candidates(self.name, port.name, self.parts, self.robot)
        tried = " or ".join(f"`{out}` of the {part}" for part, out in candidates)
        raise SettingsError(f"nothing feeds input `{port.name}` of the {self.name}; it needs {tried}.")


def _candidates(name: str, wanted: str, parts: Mapping[str, _Ports], robot: Robot) -> Iterator[tuple[str, str]]:
    if sources := _sources(wanted, robot):
        yield from sources
    elif wanted in robot.set_points:
        yield ("controller", wanted)
    elif name == "controller" and wanted in measured_names(robot):
        # With an observer only its estimate: a silent fall-back would hide a wrong observer.
        yield from [("observer", wanted)] if "observer" in parts else _sources(f"{wanted}_measured", robot)
    else:
        yield from ((part, wanted) for part in ("reference", "plant", "observer") if part != name)


def _tap(
    name: str, part: _Ports, places: list[int], ports: list[tuple[str, Port]], connections: Mapping[str, str | Link]
) -> Tap:
    scales, owners, sources, fragile = [], [], [], []
    for i, (port, place) in enumerate(zip(part.inputs, places, strict=True)):
        if place >= len(ports):
            scales.append((1.0, 0.0))
            owners.append("")
            sources.append("a constant")
            continue
        owner, origin = ports[place]
        link = connections.get(f"{name}.{port.name}")
        if isinstance(link, Link):
            scales.append((link.factor, link.offset))
        else:
            scales.append(
                (_factor(f"`{origin.name}` of the {owner}", origin, f"`{port.name}` of the {name}", port), 0.0)
            )
        owners.append(owner)
        sources.append(f"{owner} `{origin.name}`")
        if origin.missing and not port.missing:
            fragile.append(i)
    index = np.array(fragile, dtype=np.intp)
    scale = None if all(pair == (1.0, 0.0) for pair in scales) else np.array(scales).T.copy()
    return Tap(name, tuple(part.inputs), tuple(owners), tuple(sources), np.array(places, dtype=np.intp), scale, index)


def _factor(origin: str, source: Port, target: str, port: Port) -> float:
    """Return the factor from the unit of `source` to that of `port`."""
    if source.unit == port.unit or source.boolean or port.boolean or {"", "1"} & {source.unit, port.unit}:
        return 1.0  # many FMUs of other tools state no unit
    try:
        (a, si_a), (b, si_b) = to_si(source.unit), to_si(port.unit)
    except DataError as error:
        raise SettingsError(f"{origin} [{source.unit}] cannot feed {target} [{port.unit}]: {error}") from error
    if si_a != si_b:
        raise SettingsError(f"{origin} is in [{source.unit}] but {target} in [{port.unit}]; give both the same unit.")
    return a / b
