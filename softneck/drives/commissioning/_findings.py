"""Findings of a commissioning, each with its advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from softneck.core import CheckFailedError

from ..bus._file import DrivesFile
from ..running._preflight import several_devices


@dataclass(frozen=True, slots=True)
class Finding:
    """One deviation from the files.

    Attributes:
        name: in two words, such as `exchanged motors`.
        text: what was found, with numbers.
        advice: what to do.
        motors: which it is about, from 1 on; () for the sensor, or the bus.
        instead: what it may be as well, where no move can tell.
        factor: how many times as large it is as the file says, where it is a scale; 0 where it is none.
    """

    name: str
    text: str
    advice: str
    motors: tuple[int, ...] = ()
    instead: tuple[str, ...] = ()
    factor: float = 0.0

    def table(self) -> dict[str, Any]:
        """Return the JSON values."""
        table: dict[str, Any] = {
            "name": self.name,
            "motors": list(self.motors),
            "text": self.text,
            "advice": self.advice,
        }
        if self.instead:
            table["or"] = list(self.instead)
        return {**table, "factor": self.factor} if self.factor else table

    def __str__(self) -> str:
        """One line for people."""
        who = "" if not self.motors else f"motor{'s' * (len(self.motors) > 1)} {', '.join(map(str, self.motors))}: "
        return f"{who}{self.name}: {self.text}"


# Type of a drive, as 1008h begins -> its peak current [A], to which its current is relative (Technosoft's data sheets);
# and the product codes (1018h:2) of those types, which are their order codes, as far as they are public here.
PEAKS: Mapping[str, float] = {"iPOS3604": 10.0, "iPOS4808": 20.0}
PRODUCTS: Mapping[int, str] = {27014101: "iPOS4808"}
# What keeps everything from moving.
_FATAL_FINDINGS = ("duplicate node", "no drive")


def require_answers(found: Sequence[Mapping[str, Any]], where: str) -> None:
    """Raise CheckFailedError if no node answers."""
    if not found:
        raise CheckFailedError(
            f"{where}: no node answers. Are the drives on, is the bit rate right, is the line terminated (60 ohm "
            "between CAN_H and CAN_L)? Nothing was moved."
        )


def peak_of(drive: Mapping[str, Any]) -> float | None:
    """Return the peak current of a drive of that identity [A]; None where its type is not public."""
    name = PRODUCTS.get(drive.get("product") or 0) or str(drive.get("name") or "")
    return next((peak for known, peak in PEAKS.items() if name.startswith(known)), None)


def known_before(file: DrivesFile, found: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Return the findings of a scan, before any move; `found` is of `scan`."""
    by_node = {item["node"]: item for item in found}
    findings = []
    for j, entry in enumerate(file.drives, start=1):
        drive = by_node.get(entry.node)
        several = several_devices(drive["serials"]) if drive else ""
        if drive is None or not drive["drive"]:
            what = "nobody answers" if drive is None else f"a device of type {drive['device_type']:08X}h answers"
            findings.append(
                Finding("no drive", f"{what} at node {entry.node}", "Is it on, is its node number right?", (j,))
            )
        elif several:
            findings.append(Finding("duplicate node", f"node {entry.node}: {several}", "Give one of them another node "
                                    "number.", (j,)))  # fmt: skip
        else:
            findings += [*_serial(file, j, drive), *_type(file, j, drive)]
    known = {*file.nodes, file.sensor_node}
    for node, drive in by_node.items():
        if node not in known and drive["drive"]:
            text = f"node {node}: a drive that no motor of the drives file has"
            findings.append(Finding("unknown node", text, "Is it one of this robot's?"))
    return findings


def fatal(findings: Sequence[Finding]) -> bool:
    """Return whether these findings forbid any move."""
    return any(one.name in _FATAL_FINDINGS for one in findings)


def _serial(file: DrivesFile, motor: int, drive: Mapping[str, Any]) -> list[Finding]:
    wanted = {entry.serial: k for k, entry in enumerate(file.drives, start=1) if entry.serial is not None}
    other = wanted.get(drive["serial"])
    if other is None or other == motor:
        return []
    text = f"node {drive['node']} has serial number {drive['serial']}, that of motor {other}"
    return [Finding("exchanged nodes", text, "Exchange the node numbers of these drives.", (motor, other))]


def _type(file: DrivesFile, motor: int, drive: Mapping[str, Any]) -> list[Finding]:
    peak, said = peak_of(drive), file.drives[motor - 1].scale.peak_current
    if peak is None or peak == said:
        return []
    text = f"{drive['name']} has a peak current of {peak:g} A, the drives file says {said:g} A"
    return [Finding("wrong type", text, "Take the proposed `peak_current_A`.", (motor,), factor=peak / said)]


def with_type_currents(file: DrivesFile, found: Sequence[Mapping[str, Any]]) -> tuple[DrivesFile, dict[int, float]]:
    """Return the file with the peak currents of the drives' types, and those: motor, from 1 on -> [A]."""
    by_node = {item["node"]: peak_of(item) for item in found}
    peaks = {j: peak for j, node in enumerate(file.nodes, start=1) if (peak := by_node.get(node)) is not None}
    drives = tuple(replace(entry, scale=replace(entry.scale, peak_current=peaks.get(j, entry.scale.peak_current)))
                   for j, entry in enumerate(file.drives, start=1))  # fmt: skip
    return replace(file, drives=drives), peaks
