"""`terminalsAndIcons/terminalsAndIcons.xml` (FMI 3.0, section 2.4.9; FMI 2.0.4, section 2.3): what goes together.

Members have the same names in a plant, an observer, a controller and a reference, so that tools connect them by name.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softneck.runtime import Block

TERMINALS = "terminalsAndIcons/terminalsAndIcons.xml"
_DESCRIPTIONS = {
    "motors": "Set-points and positions of the motors",
    "angles": "Angles of the platform, and what an observer says of them",
    "measurement": "What the sensors say",
    "reference": "Where the platform shall be",
}
_ANGLES = ("pitch", "roll", "pitch_rate", "roll_rate", "healthy")


def terminals(block: Block) -> dict[str, list[str]]:
    """Return terminal -> names of its inputs and outputs, without empty terminals."""
    names = [port.name for port in (*block.inputs, *block.outputs)]
    found = {title: [name for name in names if _terminal_of(name) == title] for title in _DESCRIPTIONS}
    return {title: members for title, members in found.items() if members}


def _terminal_of(name: str) -> str:
    if "_measured" in name or name == "measurement_valid":
        return "measurement"
    if name.startswith(("motor_setpoint_", "motor_position_")):
        return "motors"
    if name.endswith("_reference") or name == "enabled":
        return "reference"
    return "angles" if name in _ANGLES else ""


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
