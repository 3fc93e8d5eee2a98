"""`terminalsAndIcons` (FMI 3.0, section 2.4.9; FMI 2.0.4, section 2.3): terminals, and `model.png`.

The picture tells a plant, an observer, a controller and a reference apart in diagrams. Members of terminals have the
same names in all four, so that tools connect them by name.
"""

from __future__ import annotations

import colorsys
import itertools
import math
import struct
import zlib
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from softneck.core import Matrix
from softneck.runtime import Block, Port

_SIZE = 96
# Polylines in a unit square, y downwards; drawn with round ends. One picture a role, one colour a kind.
_BEND = [(0.5 + 0.22 * (1 - math.cos(a)), 0.82 - 0.6 * math.sin(a) / math.sin(1.2)) for a in np.linspace(0, 1.2, 9)]
_EYE = [(0.15 + 0.7 * s, 0.5 - 0.22 * math.sin(math.pi * s)) for s in np.linspace(0, 1, 13)]
_STROKES: dict[str, list[list[tuple[float, float]]]] = {
    "plant": [[(0.25, 0.82), (0.75, 0.82)], _BEND, [(0.5, 0.2), (0.8, 0.3)], [(0.3, 0.82), (0.42, 0.5), (0.48, 0.19)]],
    "observer": [
        _EYE,
        [(x, 1.0 - y) for x, y in _EYE],
        [(0.5, 0.45), (0.55, 0.5), (0.5, 0.55), (0.45, 0.5), (0.5, 0.45)],
    ],
    "controller": [
        [(0.12, 0.4), (0.3, 0.4)],
        [(0.3, 0.25), (0.7, 0.25), (0.7, 0.55), (0.3, 0.55), (0.3, 0.25)],
        [(0.7, 0.4), (0.88, 0.4), (0.88, 0.78), (0.2, 0.78), (0.2, 0.5)],
    ],
    "reference": [[(0.15, 0.75), (0.45, 0.75), (0.45, 0.3), (0.85, 0.3)]],
}  # fmt: skip


def icon_png(kind: str, role: str) -> bytes:
    """Return a PNG of 96 x 96 pixels."""
    # The golden ratio spreads whatever numbers kinds come to over the colours; letters alone add up alike in some.
    hue = (sum(place * letter for place, letter in enumerate(kind.encode(), 1)) * 0.6180339887) % 1.0
    colour = np.array(colorsys.hls_to_rgb(hue, 0.36, 0.6))
    near = np.full((_SIZE, _SIZE), np.inf)
    for stroke in _STROKES[role]:
        for a, b in itertools.pairwise(stroke):
            near = np.minimum(near, _distance(np.array(a), np.array(b)))
    ink = np.clip((0.03 - near) * _SIZE + 0.5, 0.0, 1.0)[..., None]  # half a pixel of soft edge
    pixels = np.round(255.0 * (ink + (1.0 - ink) * colour)).astype(np.uint8)  # white on the kind's colour
    return _png(pixels)


def _distance(a: Matrix, b: Matrix) -> Matrix:
    """Return the distance of every pixel's middle from the stroke a-b."""
    middle = (np.arange(_SIZE) + 0.5) / _SIZE
    x, y = np.meshgrid(middle, middle)
    along = b - a
    share = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / float(along @ along), 0.0, 1.0)
    return np.hypot(x - a[0] - share * along[0], y - a[1] - share * along[1])


def _png(pixels: np.ndarray) -> bytes:
    """Return (height, width, 3) bytes as a PNG (ISO/IEC 15948): header, one block of unfiltered rows, end."""
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


TERMINALS = "terminalsAndIcons/terminalsAndIcons.xml"
_DESCRIPTIONS = {
    "motors": "Set-points and positions of the motors",
    "angles": "Angles of the platform, and what an observer says of them",
    "outputs": "Outputs of the robot, and what an observer says of them",
    "measurement": "What the sensors say",
    "reference": "Where the platform shall be",
}
# Behind an output's name: what tells that there is one.
_TOLD = ("_measured", "_reference")


def terminals(block: Block) -> dict[str, list[str]]:
    """Return terminal -> names of its inputs and outputs, without empty terminals."""
    ports = (*block.inputs, *block.outputs)
    outputs = {port.name.removesuffix(end) for port in ports for end in _TOLD if port.name.endswith(end)}
    found = {title: [port.name for port in ports if _terminal_of(port, outputs) == title] for title in _DESCRIPTIONS}
    return {title: members for title, members in found.items() if members}


def _terminal_of(port: Port, outputs: set[str]) -> str:
    name = port.name
    if "_measured" in name or name == "measurement_valid":
        return "measurement"
    if name.startswith(("motor_setpoint_", "motor_position_")):
        return "motors"
    if name.endswith("_reference") or name == "enabled":
        return "reference"
    if name != "healthy" and name.removesuffix("_rate") not in outputs - {"cocontraction"}:
        return ""
    return "angles" if port.boolean or port.unit in ("rad", "rad/s") else "outputs"


def terminals_file(block: Block) -> dict[str, bytes]:
    """Return the file's name in the FMU and its XML; nothing for a block without terminals."""
    found = terminals(block)
    if not found:
        return {}
    root = Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    group = SubElement(root, "Terminals")
    for title, members in found.items():
        # A bus: an observer takes the set-points and leaves the positions.
        head = {"name": title, "matchingRule": "bus", "description": _DESCRIPTIONS[title]}
        terminal = SubElement(group, "Terminal", head)
        for name in members:
            SubElement(
                terminal, "TerminalMemberVariable", {"variableName": name, "memberName": name, "variableKind": "signal"}
            )
    indent(root)
    return {TERMINALS: b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"}
