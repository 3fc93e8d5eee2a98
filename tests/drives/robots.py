"""Robots with 1 to 8 motors and 1 to 4 outputs, for drives."""

from __future__ import annotations

from typing import Any

from softneck.robot import Robot

# Directions of eight motors and four outputs: no two motors alike, all outputs spanned.
_MATRIX = [[1, 0, 0, 0, 0.5, 0, 0, -1], [0, 1, 0, 0, 0, 0.5, -1, 0], [0, 0, 1, 0, -1, 0, 0.5, 0],
           [0, 0, 0, 1, 0, -1, 0, 0.5]]  # fmt: skip


def robot(count: int, **changes: dict[str, Any]) -> Robot:
    """Return a robot of `count` motors; `changes` are keys of its tables."""
    names = [f"tendon_{j}" for j in range(1, count + 1)]
    outputs = {1: ["bend"], 2: ["bend"], 8: ["a", "b", "c", "d"]}.get(count, ["pitch", "roll"])
    angles = [360.0 * j / count for j in range(count)]
    directions: dict[str, Any] = {"kind": "tendons", "angles_deg": angles}
    if count == 8:
        directions = {"kind": "matrix", "matrix": _MATRIX}
    tables: dict[str, Any] = {
        "name": f"robot of {count}",
        "motors": {"names": names, "unit": "rad", "setpoint_min": -5.0, "setpoint_max": 4.0, "rate_limit": 12.0},
        "outputs": {"names": outputs, "unit": "rad", "display_unit": "deg"},
        "directions": directions,
    }
    for table, keys in changes.items():
        tables[table] = {**tables.get(table, {}), **keys}
    return Robot.from_dict(tables)
