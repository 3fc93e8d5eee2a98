"""Who feeds whom: inputs connected to outputs by name, with units converted, on one vector of signals.

All outputs, references and constants of a loop lie side by side in the "bus"; the inputs of a part are a
selection of it, so that a step costs one gather.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Port, SettingsError, Vector, to_si

from ._part import Part

REFERENCE_PORTS = (
    Port(name="pitch_reference", unit="rad", description="wanted pitch"),
    Port(name="roll_reference", unit="rad", description="wanted roll"),
    Port(name="cocontraction_reference", unit="rad", description="wanted co-contraction delta_i (Eq. 11)"),
    Port(name="enabled", description="whether the controller may move the motors", start=1.0, boolean=True),
)

# Where an input comes from, best source first; a name without an entry connects to an equal name.
_SOURCES: dict[str, tuple[tuple[str, str], ...]] = {
    "pitch_measured": (("plant", "pitch_measured"), ("plant", "pitch")),
    "roll_measured": (("plant", "roll_measured"), ("plant", "roll")),
    "pitch_rate_measured": (("plant", "pitch_rate_measured"), ("plant", "pitch_rate")),
    "roll_rate_measured": (("plant", "roll_rate_measured"), ("plant", "roll_rate")),
    "healthy": (("observer", "healthy"), ("plant", "measurement_valid")),
}
_MEASURED = ("pitch", "roll", "pitch_rate", "roll_rate")
# What holds where nobody says otherwise: measurements are valid, controllers enabled.
_DEFAULTS = {"healthy": 1.0, "measurement_valid": 1.0, "enabled": 1.0}


@dataclass(frozen=True, slots=True, eq=False)
class Tap:
    """The inputs of one part as a selection of the bus.

    Attributes:
        part: "plant", "observer" or "controller".
        names: of the inputs.
        sources: text "plant `pitch`" of each source, for messages.
        slots: (n_in,) positions in the bus.
        factors: (n_in,) unit of the source to unit of the input.
        fragile: positions among the inputs where a missing value may come but must not.
    """

    part: str
    names: tuple[str, ...]
    sources: tuple[str, ...]
    slots: np.ndarray
    factors: Vector
    fragile: np.ndarray

    def read(self, bus: Vector, time: float) -> Vector:
        """Return the inputs (n_in,) from the bus; raise DataError if a needed one is missing."""
        u = bus[self.slots] * self.factors
        if self.fragile.size and not np.isfinite(u[self.fragile]).all():
            i = self.fragile[~np.isfinite(u[self.fragile])][0]
            raise DataError(
                f"input `{self.names[i]}` of the {self.part} is {u[i]} at t = {time:g} s (from {self.sources[i]}); "
                "put an observer between that bridges missing measurements."
            )
        return u


@dataclass(frozen=True, slots=True, eq=False)
class Wiring:
    """All connections of a loop.

    Attributes:
        start: (n_bus,) the bus with its start values and constants.
        ports: (part, port) of each place in the bus that belongs to a part or the reference.
        spans: part -> its outputs in the bus.
        taps: part -> its inputs.
    """

    start: Vector
    ports: tuple[tuple[str, Port], ...]
    spans: Mapping[str, slice]
    taps: Mapping[str, Tap]


def wire(parts: Mapping[str, Part], constants: Mapping[str, float]) -> Wiring:
    """Connect the parts "plant", "controller" and, where there is one, "observer".

    Args:
        parts: name in the loop -> part.
        constants: values of plant inputs that nobody writes, such as `payload`.

    Raises:
        SettingsError: an input without a source, two writers, units that do not fit, an unknown constant.
    """
    _check_plant(parts["plant"], constants)
    ports = [(name, port) for name, part in parts.items() for port in part.outputs]
    ports += [("reference", port) for port in REFERENCE_PORTS]
    slots = {(name, port.name): i for i, (name, port) in enumerate(ports)}
    extra: list[float] = []

    taps = {}
    for name, part in parts.items():
        found = [_source(name, port, parts, slots, constants) for port in part.inputs]
        places = []
        for value in found:
            if isinstance(value, tuple):
                places.append(slots[value])
            else:
                extra.append(value)
                places.append(len(ports) + len(extra) - 1)
        taps[name] = _tap(name, part, places, ports)
    start = np.array([port.start for _, port in ports] + extra)
    return Wiring(start, tuple(ports), _spans(parts), taps)


def _check_plant(plant: Part, constants: Mapping[str, float]) -> None:
    names = [port.name for port in plant.inputs]
    for j in (1, 2, 3):
        if f"motor_setpoint_{j}" not in names:
            raise SettingsError(f"the plant has no input `motor_setpoint_{j}`; its inputs are {', '.join(names)}.")
    for name in constants:
        if name.startswith("motor_setpoint_"):
            raise SettingsError(f"the plant's input `{name}` has two writers: the controller and a constant.")
        if name not in names:
            raise SettingsError(f"`{name}` is no input of the plant; its inputs are {', '.join(names)}.")


def _source(
    name: str,
    port: Port,
    parts: Mapping[str, Part],
    slots: Mapping[tuple[str, str], int],
    constants: Mapping[str, float],
) -> tuple[str, str] | float:
    """Return (part, output) that feeds `port` of part `name`, or the constant that it gets."""
    if name == "plant" and not port.name.startswith("motor_setpoint_"):
        return float(constants.get(port.name, math.nan if port.missing else port.start))
    for candidate in _candidates(name, port.name, parts):
        if candidate in slots:
            return candidate
    if port.name in _DEFAULTS:
        return _DEFAULTS[port.name]
    tried = " or ".join(f"`{output}` of the {part}" for part, output in _candidates(name, port.name, parts))
    raise SettingsError(f"nothing feeds input `{port.name}` of the {name}; it would take {tried}.")


def _candidates(name: str, wanted: str, parts: Mapping[str, Part]) -> Iterator[tuple[str, str]]:
    if wanted in _SOURCES:
        yield from _SOURCES[wanted]
    elif wanted.startswith("motor_setpoint_"):
        yield ("controller", wanted)
    elif name == "controller" and wanted in _MEASURED:
        # With an observer its estimate or nothing: a silent fall-back would hide a wrong observer.
        yield from [("observer", wanted)] if "observer" in parts else _SOURCES[f"{wanted}_measured"]
    else:
        yield from ((part, wanted) for part in ("reference", "plant", "observer") if part != name)


def _tap(name: str, part: Part, places: list[int], ports: list[tuple[str, Port]]) -> Tap:
    factors, sources, fragile = [], [], []
    for i, (port, place) in enumerate(zip(part.inputs, places, strict=True)):
        if place >= len(ports):
            factors.append(1.0)
            sources.append("a constant")
            continue
        owner, origin = ports[place]
        factors.append(_factor(f"`{origin.name}` of the {owner}", origin, f"`{port.name}` of the {name}", port))
        sources.append(f"{owner} `{origin.name}`")
        if origin.missing and not port.missing:
            fragile.append(i)
    names = tuple(port.name for port in part.inputs)
    index = np.array(fragile, dtype=np.intp)
    return Tap(name, names, tuple(sources), np.array(places, dtype=np.intp), np.array(factors), index)


def _factor(origin: str, source: Port, target: str, port: Port) -> float:
    """Return the factor from the unit of `source` to that of `port`."""
    if source.unit == port.unit or source.boolean or port.boolean or {"", "1"} & {source.unit, port.unit}:
        return 1.0  # foreign FMUs often state no unit: then there is nothing to convert
    try:
        (a, si_a), (b, si_b) = to_si(source.unit), to_si(port.unit)
    except DataError as error:
        raise SettingsError(f"{origin} [{source.unit}] cannot feed {target} [{port.unit}]: {error}") from error
    if si_a != si_b:
        raise SettingsError(f"{origin} is in [{source.unit}] but {target} in [{port.unit}]; give both the same unit.")
    return a / b


def _spans(parts: Mapping[str, Part]) -> dict[str, slice]:
    spans, first = {}, 0
    for name, part in parts.items():
        spans[name] = slice(first, first + len(part.outputs))
        first += len(part.outputs)
    spans["reference"] = slice(first, first + len(REFERENCE_PORTS))
    return spans
