"""Loops as tables: the table of a loop object, and changes of its values by dotted keys."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from softneck.core import SettingsError
from softneck.loop import BlockPart, Loop, Part, fault_field, fault_keys, reference_field, reference_keys, same_quantity
from softneck.robot import Robot

from ..parts._fmu_part import FmuPart
from ..parts._isolated import IsolatedPart
from ._loop_file import LoopSetup, normal_table
from ._loop_parts import OBJECT, SOURCES

_NECK = Robot.preset("neck")
_SOURCE_KEYS = ("fmu", "model", "file", "neck", "python", OBJECT)
_TOP_KEYS = ("duration_s", "order", "angle", "sample_time_s")


def loop_table(loop: Loop | LoopSetup) -> dict[str, Any]:
    """Return the table from which `make_loop` makes `loop`; it holds parts without a file as objects."""
    setup = loop if isinstance(loop, LoopSetup) else LoopSetup(loop=loop)
    plain = setup.loop
    table: dict[str, Any] = {"duration_s": plain.duration, "order": plain.order, "angle": setup.angle}
    parameters, constants = plain.parameters, plain.constants
    for name, part in plain.parts.items():
        chosen = {**parameters.get(name, {}), **constants.get(name, {})}
        described = {**_describe_part(part), **({"parameters": chosen} if chosen else {})}
        if name in plain.others:
            table.setdefault("part", []).append({"name": name, "role": part.role, **described})
        else:
            table[name] = described
    if plain.robot.in_header():
        table["robot"] = plain.robot
    if "reference" not in table:
        table["reference"] = reference_keys(plain.reference, plain.robot) or {OBJECT: plain.reference}  # pyright: ignore[reportArgumentType]
    if plain.faults:
        table["fault"] = [fault_keys(fault) for fault in plain.faults]
    if plain.connections:
        table["connections"] = {
            target: origin
            if isinstance(origin, str)
            else {"from": origin.origin, "factor": origin.factor, "offset": origin.offset}
            for target, origin in plain.connections.items()
        }
    if setup.limits:
        table["limits"] = dict(setup.limits)
    return table


def with_values(table: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the loop's table with other values at dotted keys; whole parts are replaced first."""
    made = {key: copy.copy(value) for key, value in table.items()}
    for key in sorted(values, key=lambda key: key.count(".")):
        _put(made, key, values[key])
    return made


def check_key(table: Mapping[str, Any], key: str, names: Mapping[str, set[str] | None], robot: Robot = _NECK) -> None:
    """Raise SettingsError unless the loop has the key.

    Keys are dotted, such as "plant.parameters.payload" or "fault.0.start_s"; `names` has the parameters and inputs of
    each part, None if the part does not list them.
    """
    head, _, rest = key.partition(".")
    if not rest:
        if head in (*_TOP_KEYS, *SOURCES, "reference"):
            return
        raise SettingsError(
            f"the loop has no key `{key}`; it has {', '.join((*_TOP_KEYS, *SOURCES))} and keys below them."
        )
    if head in ("fault", "part"):
        entry, _, rest = _entry(table, key)
        if head == "fault":
            _check_field(key, rest, fault_field(str(entry.get("kind")), rest), f"a {entry.get('kind')}")
            return
        head = str(entry["name"])
    elif head == "reference":
        reference = table.get("reference", {})
        if OBJECT not in reference and "fmu" not in reference:
            kind = str(reference.get("kind"))
            if not (rest == "file" and kind == "recording"):
                _check_field(key, rest, reference_field(kind, rest, robot), f"a {kind} reference")
            return
    elif head not in table:
        raise SettingsError(f"the loop has no {head}, so no key `{key}`.")
    _check_part_key(key, head, rest, names)


def set_sources(key: str) -> bool:
    """Return whether `key` chooses a part or the reference of the loop."""
    parts = key.split(".")
    return parts[0] in (*SOURCES, "reference", "part") and (len(parts) == 1 or parts[-1] in _SOURCE_KEYS)


def settable(part: Part) -> set[str] | None:
    """Return the names of a part's parameters and inputs; None if the part does not list its parameters."""
    block = getattr(part, "block", None)
    parameters = getattr(part, "parameters", getattr(block, "parameters", None))
    return None if parameters is None else {port.name for port in (*parameters, *part.inputs)}


def _check_part_key(key: str, part: str, rest: str, names: Mapping[str, set[str] | None]) -> None:
    if rest in _SOURCE_KEYS or rest in ("sample_time_s", "names", "units"):
        return
    group, _, name = rest.partition(".")
    known = names.get(part, set())
    if group != "parameters" or not name:
        raise SettingsError(f"the loop has no key `{key}`; write {part}.parameters.NAME.")
    if known is not None and name not in known:
        raise SettingsError(
            f"the loop has no key `{key}`: the {part} has {', '.join(sorted(known)) or 'no parameters'}."
        )


def _check_field(key: str, rest: str, field: str | None, where: str) -> None:
    if field is None:
        raise SettingsError(f"the loop has no key `{key}`: `{rest}` is not part of {where}.")


def _entry(table: Mapping[str, Any], key: str) -> tuple[dict[str, Any], int, str]:
    """Return the list entry of a key such as "fault.0.start_s", its position, and the rest of the key."""
    head, _, below = key.partition(".")
    place, _, rest = below.partition(".")
    entries = table.get(head, [])
    named = [str(entry.get("name", "")) for entry in entries]
    if place in named:
        return entries[named.index(place)], named.index(place), rest
    if not place.isdecimal() or int(place) >= len(entries) or not rest:
        count = f"{len(entries)} ({', '.join(f'{head}.{i}' for i in range(len(entries)))})" if entries else "none"
        raise SettingsError(f"the loop has no key `{key}`: its [[{head}]] tables: {count}.")
    return entries[int(place)], int(place), rest


def _put(table: dict[str, Any], key: str, value: Any) -> None:
    head, _, rest = key.partition(".")
    if not rest:
        table[head] = normal_table({head: value})[head]
        return
    if head in ("fault", "part"):
        entry, place, rest = _entry(table, key)
        changed = dict(entry)
        table[head] = [*table[head][:place], changed, *table[head][place + 1 :]]
    else:
        changed = table[head] = dict(table.get(head, {}))
    if head in ("fault", "reference"):
        # Replaces the same quantity in another unit.
        for old in [k for k in changed if k != "kind" and same_quantity(k, rest)]:
            del changed[old]
        changed[rest] = value
    elif rest in _SOURCE_KEYS:
        for source in _SOURCE_KEYS:
            changed.pop(source, None)
        changed[rest] = value
    else:
        group, _, name = rest.partition(".")
        if name:
            changed[group] = {**changed.get(group, {}), name: value}
        else:
            changed[group] = value


def _describe_part(part: Part) -> dict[str, Any]:
    """Return the table of a part; an FMU by its file, so that other processes can open it."""
    if isinstance(part, FmuPart | IsolatedPart):
        names = {theirs: ours for ours, theirs in part.native_names.items()}
        table = {"fmu": str(part.path.resolve()), "sample_time_s": part.sample_time, "names": names}
        if part.units:
            table["units"] = dict(part.units)
        return table | ({"isolated": True, "timeout_s": part.timeout} if isinstance(part, IsolatedPart) else {})
    return {OBJECT: part.block if isinstance(part, BlockPart) else part}
