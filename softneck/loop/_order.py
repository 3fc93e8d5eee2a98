"""The order in which the parts of a cycle step, and why there may be none."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

from softneck.core import SettingsError

from ._part import Part
from ._wiring import Tap

# Their outputs are valid one sample after the step: they break every loop of dependencies.
LATE_ROLES = ("plant", "reference")


def late(part: Part) -> bool:
    """Return whether what a step of `part` returns is valid one sample later."""
    return part.role in LATE_ROLES


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
