"""What happens in a row of a loop, in which order, and why there may be none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

from softneck.core import SettingsError

from ._part import Part
from ._rows_runtime import ROWS_DISTURB, ROWS_RECORD, ROWS_REFER, ROWS_SHOW, ROWS_STEP
from ._wiring import Tap

# What to do, the part or place that it is about, every how many rows.
Action = tuple[int, int, int]

# Their outputs are valid one sample after the step: they break every loop of dependencies.
LATE_ROLES = ("plant", "reference")


def late(part: Part) -> bool:
    """Return whether what a step of `part` returns is valid one sample later."""
    return part.role in LATE_ROLES


def cycle(
    parts: Mapping[str, Part], taps: Mapping[str, Tap], ratios: Mapping[str, int], *, order: str, disturbed: bool
) -> list[Action]:
    """Return the actions of a row: what is valid at t_k comes to the bus, the parts step, the row is recorded.

    Sequential, as on the hardware: the plant is read, then observer and controller step, each seeing what those
    before it say, then the plant. Jacobi: all step with what is on the bus at t_k; the outputs are seen at t_k+1.

    Args:
        parts: name -> part.
        taps: part -> its inputs.
        ratios: part -> its sample time in rows.
        order: "sequential" or "jacobi".
        disturbed: whether faults act.

    Raises:
        SettingsError: an algebraic loop.
    """
    numbers = {name: i for i, name in enumerate(parts)}

    def each(what: int, names: Iterable[str]) -> list[Action]:
        return [(what, numbers[name], ratios[name]) for name in names]

    waiting = [name for name, part in parts.items() if late(part)]
    refer = [] if "reference" in parts else [(ROWS_REFER, len(parts), 1)]
    # Sensors' faults act on what arrives, the others on what the plant is about to read.
    at_sensors, at_plant = ([(ROWS_DISTURB, place, 1)] if disturbed else [] for place in (0, 1))
    arrive = [*each(ROWS_SHOW, waiting), *refer, *at_sensors]
    leave = [*at_plant, (ROWS_RECORD, 0, 1)]
    if order == "jacobi":
        return [*arrive, *leave, *each(ROWS_STEP, parts), *each(ROWS_SHOW, [n for n in parts if n not in waiting])]
    ordered = [
        (what, numbers[name], ratios[name]) for name in step_order(parts, taps) for what in (ROWS_STEP, ROWS_SHOW)
    ]
    return [*arrive, *ordered, *leave, *each(ROWS_STEP, waiting)]


def step_order(parts: Mapping[str, Part], taps: Mapping[str, Tap]) -> tuple[str, ...]:
    """Return the names of the parts whose outputs hold at once, each after those that feed it.

    An observer's set-points are those held until now (docs, "Timing"): they wait for no controller.

    Raises:
        SettingsError: an algebraic loop; the line names its parts and variables.
    """
    waits = {name: _feeders(name, parts, taps[name]) for name, part in parts.items() if not late(part)}
    done: list[str] = []
    while len(done) < len(waits):
        ready = [name for name in waits if name not in done and all(feeder in done for feeder in waits[name])]
        if not ready:
            raise SettingsError(_circle({name: waits[name] for name in waits if name not in done}))
        done.append(ready[0])
    return tuple(done)


def _feeders(name: str, parts: Mapping[str, Part], tap: Tap) -> dict[str, str]:
    """Return the part -> variable that must be known before `name` steps."""
    feeders = {}
    for owner, port in zip(tap.owners, tap.ports, strict=True):
        held = parts[name].role == "observer" and port.name.startswith("motor_setpoint_")
        if owner in parts and not late(parts[owner]) and not held:
            feeders.setdefault(owner, port.name)
    return feeders


def _circle(waits: Mapping[str, Mapping[str, str]]) -> str:
    path = [next(iter(waits))]
    while path.count(path[-1]) < 2:
        path.append(next(feeder for feeder in waits[path[-1]] if feeder in waits))
    path = path[path.index(path[-1]) :][::-1]
    links = [f"{a} -> {b} `{waits[b][a]}`" for a, b in pairwise(path)]
    return (
        f"an algebraic loop: {', '.join(links)}. Each needs the other's output of the same instant; "
        'use order = "jacobi", which puts a sample between them, or break a connection.'
    )
