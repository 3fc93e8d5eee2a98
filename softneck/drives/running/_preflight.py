"""Before anything moves: who is on the bus, are they the drives of the file, do they take every value."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from softneck.core import CheckFailedError

from ..bus._file import DriveEntry, DrivesFile
from ..bus._link import BusError, Link
from ..bus._objects import (
    CSP,
    GUARDED_BY,
    GUARDING_OBJECTS,
    HOMED_MARK,
    MASTER_NODE,
    Write,
    guarding_writes,
    limit_writes,
    mode_writes,
    option_writes,
    pdo_writes,
)
from ..bus._robot import limits_said
from ..bus._sdo import Objects, SdoError
from ..master import Frame
from ..master._cia402 import DriveState, state_of
from ..master._fieldbus import Command, nmt_frame
from ..sensing._sources import LOOK, Sensor, look_at

# All nodes answer within this time [s] after the last request, and so do two devices with one node number.
_SCAN_TIME = 0.2
# Bits of a CAN frame with 8 bytes, stuffed: what a request needs on the wire. An adapter's queue may hold 10 frames
# (txqueuelen of can0), so a request waits for an answer to the one before, or as long as that took some times over.
_FRAME_BITS, _PAUSE_FRAMES, _SHORTEST_PAUSE = 135, 3, 2e-3
DRIVE = 0x192  # device profile in 1000h


def require_bus(link: Link) -> None:
    """Raise BusError if the bus refused a frame; without frames no drive can answer."""
    if link.problem:
        raise BusError(f"the bus takes no frames: {link.problem} Nothing was moved.")


def scan(link: Link, *, bit_rate: int = 1_000_000) -> list[dict[str, Any]]:
    """Read the device type of every node number; return the answers, with identity if available.

    Args:
        link: to the bus.
        bit_rate: of the bus [bit/s], by which requests are paced.

    Raises:
        CheckFailedError: another master is on the bus; nothing was sent.
        BusError: the bus takes no frames.
    """
    require_alone(link)
    pause = max(_SHORTEST_PAUSE, _PAUSE_FRAMES * _FRAME_BITS / bit_rate)
    answers: dict[int, int] = {}

    def take(until: float, wanted: int = 0) -> None:
        while link.now < until and wanted not in answers:
            for frame in link.receive(until - link.now):
                node = frame.identifier - 0x580
                if 1 <= node <= 126 and _answers(frame, node, 0x1000):
                    answers[node] = int.from_bytes(frame.data[4:8], "little")

    for node in range(1, 127):
        link.send([_question(node, 0x1000)])
        require_bus(link)
        take(link.now + pause, node)
    take(link.now + _SCAN_TIME)
    require_bus(link)
    return [_identity(link, Objects(link, node), kind) for node, kind in sorted(answers.items())]


def _question(node: int, index: int, subindex: int = 0) -> Frame:
    """Return the request to read an object (CiA 301, 7.2.4.3.5)."""
    return Frame(0x600 + node, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0]))


def _answers(frame: Frame, node: int, index: int, subindex: int = 0) -> bool:
    """Return whether `frame` answers that request, by a value or an abort."""
    about = bytes([index & 0xFF, index >> 8, subindex])
    return frame.identifier == 0x580 + node and len(frame.data) == 8 and not frame.error and frame.data[1:4] == about


def devices_at(link: Link, nodes: Sequence[int]) -> dict[int, list[int | None]]:
    """Return node -> serial number of each device that answers there, None of one that tells none.

    Two devices with one number both answer each request, and an SDO client believes the first.
    """
    link.receive(0.0)
    found: dict[int, list[int | None]] = {node: [] for node in nodes}
    for node in nodes:
        link.send([_question(node, 0x1018, 4)])
    until = link.now + _SCAN_TIME
    while link.now < until:
        for frame in link.receive(until - link.now):
            node = frame.identifier - 0x580
            if node in found and _answers(frame, node, 0x1018, 4):
                refused = frame.data[0] == 0x80
                found[node].append(None if refused else int.from_bytes(frame.data[4:8], "little"))
    return found


def several_devices(serials: Sequence[int | None]) -> str:
    """Return the message on a node number with several devices; "" for a single device."""
    if len(serials) < 2:
        return ""
    told = ", ".join("not told" if serial is None else str(serial) for serial in serials)
    return f"{len(serials)} devices answer (serial numbers {told})"


def _identity(link: Link, objects: Objects, kind: int) -> dict[str, Any]:
    serials = devices_at(link, [objects.node])[objects.node]
    found: dict[str, Any] = {
        "node": objects.node,
        "device_type": kind,
        "drive": kind & 0xFFFF == DRIVE,
        "serials": serials,
    }
    for name, subindex in (("vendor", 1), ("product", 2), ("revision", 3), ("serial", 4)):
        found[name] = or_none(lambda sub=subindex: objects.read(0x1018, sub))
    found["name"] = or_none(lambda: objects.read_text(0x1008))
    found["firmware"] = or_none(lambda: objects.read_text(0x100A))
    word = or_none(lambda: objects.read(0x6041))
    found["state"] = None if word is None else state_of(int(word)).name
    return found


def or_none(read: Any) -> Any:
    try:
        return read()
    except SdoError:
        return None


# Another master shows within this time [s]: heartbeats and SYNCs come faster.
LISTEN = 1.0
# What a row may be overridden by; a missing drive or a second master never.
OVERRIDES = ("certificate", "identity", "firmware", "modes", "homed")
# Default of 6502h in the manual: no bit for the cyclic mode though the drive has it.
_NO_CSP_BIT = 0x001F0065
_MODE_OBJECT = 0x6060
# Why a drive that has a mode may refuse it (CiA 301, table 22): its state, its state of another kind, or no reason.
_NOT_NOW = (0x08000022, 0x08000021, 0x08000020, 0x08000000)
# What such a drive does when it gets power: nothing (0), what bit 4 of the control word asks for (1, 6), the speed that
# we set to zero (3), what we want (8).
_HOLDING_MODES = (0, 1, 3, 6, 8)
_MODE_PENDING = "to be taken in Operation Enabled"


@dataclass(frozen=True, slots=True)
class PreflightCheck:
    """One line of the report.

    Attributes:
        node: of the drive, 0 for the bus.
        name: what was looked at; `--override` takes it where it may be overridden.
        found: what was there.
        holds: whether it is as it must be.
        advice: what to do where it is not.
    """

    node: int
    name: str
    found: str
    holds: bool
    advice: str = ""


@dataclass(slots=True)
class Report:
    """The result of one check.

    `overridden`: names that are let pass by the user. `guarding`: "life" or "heartbeat", as it was set up. `rows`: all
    lines. `late_modes`: nodes of drives that take their mode in Operation Enabled alone.
    """

    overridden: tuple[str, ...] = ()
    guarding: str = "none"
    rows: list[PreflightCheck] = field(default_factory=list)
    late_modes: list[int] = field(default_factory=list)

    def add(self, node: int, name: str, found: str, holds: bool, advice: str = "") -> None:
        """Add a line."""
        self.rows.append(PreflightCheck(node, name, found, holds, "" if holds else advice))

    @property
    def holds(self) -> bool:
        """Whether all that was not overridden holds."""
        return all(row.holds or row.name in self.overridden for row in self.rows)

    def require(self) -> None:
        """Raise CheckFailedError with the first line that does not hold."""
        failed = [row for row in self.rows if not row.holds and row.name not in self.overridden]
        if failed:
            row = failed[0]
            where = f"node {row.node}: " if row.node else ""
            more = f" ({len(failed)} checks failed in all)" if len(failed) > 1 else ""
            raise CheckFailedError(f"{where}{row.name}: {row.found}. {row.advice}{more} Nothing was moved.")

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives check`."""
        rows = [{"check": row["name"], **{key: row[key] for key in ("node", "found", "holds", "advice")}}
                for row in map(asdict, self.rows)]  # fmt: skip
        overridden = list(self.overridden)
        return {"holds": self.holds, "guarding": self.guarding, "overridden": overridden, "rows": rows}


def foreign_master(frames: Sequence[Frame]) -> str:
    """Return the frame in `frames` that only a master sends; "" if there is none."""
    for frame in frames:
        if frame.error:
            continue
        if frame.identifier == 0x000:
            return "an NMT command"
        if frame.identifier == 0x080:
            return "a SYNC"
        if 0x600 < frame.identifier < 0x680:
            return f"an SDO request to node {frame.identifier - 0x600}"
        if frame.remote and 0x700 < frame.identifier < 0x780:
            return f"a guarding request to node {frame.identifier - 0x700}"
        if frame.identifier == 0x700 + MASTER_NODE:
            return "a master's heartbeat"
    return ""


def set_points_of_others(frames: Sequence[Frame], nodes: Collection[int]) -> str:
    """Return which set-point frame somebody else sends to our nodes, "" if none."""
    known = {0x200 + node: node for node in nodes}
    return next(
        (f"set-points to node {known[f.identifier]}" for f in frames if f.identifier in known and not f.error), ""
    )


def listen(link: Link, nodes: Collection[int]) -> str:
    """Return a frame of another master while this one is silent; "" if there is none."""
    until = link.now + LISTEN
    while link.now < until:
        frames = link.receive(until - link.now)
        found = foreign_master(frames) or set_points_of_others(frames, nodes)
        if found:
            return found
    return ""


def require_alone(link: Link) -> None:
    """Raise CheckFailedError if another master is on the bus: it would stop its run for one request of ours."""
    other = listen(link, range(1, 127))
    if other:
        raise CheckFailedError(f"another master is on the bus ({other}); stop it first. Nothing was sent.")


def preflight(
    link: Link, file: DrivesFile, *, override: Collection[str] = (), homed: bool = False, sensor: Sensor | None = None
) -> Report:
    """Check all drives and write their configuration, each value read back; no motor moves.

    Args:
        link: to the bus.
        file: what the drives should be.
        override: names of rows that may fail.
        homed: whether the drives' zero is needed.
        sensor: the inclinometer, which must give a sample.

    Raises:
        BusError: the bus takes no frames.
    """
    rows = Report(tuple(override))
    if file.robot is not None:
        _tell_robot(file, rows)
    other = listen(link, file.nodes)
    rows.add(0, "second master", other or "none", not other, "Stop the other master before this one starts.")
    if other:
        return rows
    link.send([nmt_frame(Command.PRE_OPERATIONAL, node) for node in file.nodes])
    require_bus(link)
    guarding = file.guarding.kind
    devices = {node: several_devices(serials) for node, serials in devices_at(link, file.nodes).items()}
    for node, found in devices.items():
        rows.add(node, "node number", found or "one device", not found, "Give one of them another node number.")
    if any(devices.values()):
        return rows
    for entry in file.drives:
        objects = Objects(link, entry.node)
        try:
            kind = _check_drive(objects, file, entry, guarding, rows)
            if homed:
                found = objects.read(0x607C)
                advice = "Run `softneck drives commission --only zero`: a drive loses its zero with every reset."
                rows.add(entry.node, "homed", "yes" if found == HOMED_MARK else "no", found == HOMED_MARK, advice)
        except SdoError as error:
            if error.aborted:
                rows.add(entry.node, "objects", str(error), False, "Is this a drive of the profile in the drives file?")
            else:
                rows.add(entry.node, "present", "no answer", False, "Is it on, is its node number and bit rate right?")
            continue
        guarding = guarding if guarding != "auto" else kind
    if sensor is not None:
        _check_sensor(link, file, sensor, rows)
    rows.guarding = guarding
    return rows


def _tell_robot(file: DrivesFile, rows: Report) -> None:
    """Add rows on the robot's tighter limits, the supervision, and the bus load."""
    robot = file.moves
    rows.add(0, "robot", robot.label(), True)
    for node, said in zip(file.nodes, limits_said(robot, file.limits), strict=True):
        rows.add(node, "set-points", said, True)
    if not file.weights:
        rows.add(0, "diverged", "not watched: the robot's directions are to be identified", True)
    rows.add(0, "bus load", f"{100.0 * file.load:.0f} % of {file.bit_rate:g} bit/s at worst", True)


def _check_sensor(link: Link, file: DrivesFile, sensor: Sensor, rows: Report) -> None:
    """Look for one sample that may be an angle of the neck; a drive must not get power without."""
    on_bus = file.sensor_kind == "can"
    if on_bus:
        # After power-up a CANopen node says nothing by itself before it is started (CiA 301, 7.3.2).
        link.send([nmt_frame(Command.START, file.sensor_node)])
    tilt = look_at(sensor, link, LOOK)
    node, holds, found = file.sensor_node if on_bus else 0, False, f"no sample within {LOOK:g} s"
    advice = "Is it on, is `node` of [sensor] right?" if on_bus else "Is it plugged in and does it send?"
    if tilt is not None:
        angles = [math.degrees(angle) for angle in tilt.values]
        holds = tilt.valid and all(abs(angle) <= math.degrees(file.sensor_angle) for angle in angles)
        named = zip(file.moves.outputs.names, angles, strict=True)
        found = ", ".join(f"{name} {angle:.2f}" for name, angle in named) + " deg"
        advice = "The neck cannot have that angle: is it mounted upright, is it the right sensor?"
    rows.add(node, "inclinometer", found, holds, getattr(sensor, "problem", "") or advice)


def _check_drive(objects: Objects, file: DrivesFile, entry: DriveEntry, guarding: str, rows: Report) -> str:
    """Add the rows of one drive; return the guarding it got."""
    node = entry.node
    kind = objects.read(0x1000)
    rows.add(node, "present", f"device type {kind:08X}h", kind & 0xFFFF == DRIVE, "It is not a CiA 402 drive.")
    _check_identity(objects, entry, rows)
    _check_factors(objects, node, rows)
    word = objects.read(0x6041)
    state = state_of(word)
    quiet = state in (DriveState.DISABLED, DriveState.READY, DriveState.SWITCHED_ON)
    rows.add(node, "state", state.name, quiet, "Run `softneck drives reset` and look for the cause first."
             if state is DriveState.FAULT else "Run `softneck drives stop`.")  # fmt: skip
    _check_modes(objects, node, rows)
    rows.add(node, "slow loop", f"{entry.scale.slow_loop * 1e3:g} ms by the drives file; `zero` measures it", True)
    guarding, has = _guarding(objects, guarding, rows)
    if not guarding:
        return "auto"
    late = node in rows.late_modes
    for topic, writes in (
        ("modes", [write for write in mode_writes(file) if not (late and write.at == _MODE_OBJECT)]),
        ("options", option_writes()),
        ("limits", limit_writes(file, entry)),
        ("guarding", guarding_writes(file, guarding, MASTER_NODE, has)),
        ("mapping", pdo_writes(entry, file.profile)),
    ):
        _apply(objects, topic, writes, rows)
    return guarding


def _check_identity(objects: Objects, entry: DriveEntry, rows: Report) -> None:
    wrong, found = [], []
    for name, subindex, wanted in (("vendor", 1, entry.vendor), ("product", 2, entry.product),
                                   ("serial", 4, entry.serial)):  # fmt: skip
        value = objects.read(0x1018, subindex)
        found.append(f"{name} {value}")
        if wanted is not None and value != wanted:
            wrong.append(f"{name} {value} instead of {wanted}")
    text = ", ".join(wrong or found)
    rows.add(entry.node, "identity", text, not wrong, "Is this the motor that the drives file means?")
    firmware = or_none(lambda: objects.read_text(0x100A))
    holds = entry.firmware is None or firmware == entry.firmware
    rows.add(entry.node, "firmware", firmware or "not told", holds, f"The drives file says {entry.firmware}.")


def _check_factors(objects: Objects, node: int, rows: Report) -> None:
    wrong = []
    for index in (0x6093, 0x6094, 0x6097):
        pair = [or_none(lambda i=index, s=sub: objects.read(i, s)) for sub in (1, 2)]
        if None not in pair and pair[0] != pair[1]:
            wrong.append(f"{index:04X}h is {pair[0]}/{pair[1]}")
    advice = "Set the factor group to 1/1 and save it: positions are in encoder counts here."
    rows.add(node, "factor group", ", ".join(wrong) or "neutral", not wrong, advice)


def _check_modes(objects: Objects, node: int, rows: Report) -> None:
    modes = objects.read(0x6502) & 0xFFFFFFFF
    said = bool(modes & 0x80) or modes == _NO_CSP_BIT
    try:
        taken = "taken" if objects.write_checked(_MODE_OBJECT, 0, CSP) == CSP else "not kept"
    except SdoError as error:
        if not error.aborted:
            raise
        taken = _when_enabled(objects) if said and error.code in _NOT_NOW else "refused"
    if taken.startswith(_MODE_PENDING):
        rows.late_modes.append(node)
    found = f"6502h is {modes:08X}h, mode 8 is {taken}"
    holds = said and taken in ("taken", _MODE_PENDING)
    rows.add(node, "modes", found, holds, "The cyclic synchronous position mode is needed.")


def _when_enabled(objects: Objects) -> str:
    """Return the message on a drive that takes no mode while it is off: until then it must hold its motor."""
    now = objects.read(0x6061)
    if now not in _HOLDING_MODES:
        return f"{_MODE_PENDING}, and until then it would be in mode {now}"
    objects.write(0x60FF, 0, 0)
    return _MODE_PENDING


def _guarding(objects: Objects, wanted: str, rows: Report) -> tuple[str, frozenset[int]]:
    """Return the guarding of the drive and its objects; "" after a row with the reason if there is none.

    With "auto" by heartbeat where the drive can send and watch one, else by life guarding.
    """
    has = frozenset(index for index, subindex in GUARDING_OBJECTS if objects.has(index, subindex))
    lacks = {kind: [index for index in needed if index not in has] for kind, needed in GUARDED_BY.items()}
    possible = [kind for kind in ("heartbeat", "life") if not lacks[kind] and wanted in (kind, "auto")]
    if possible:
        return possible[0], has
    kinds = GUARDED_BY if wanted == "auto" else (wanted,)
    named = {kind: ", ".join(f"{index:04X}h" for index in lacks[kind]) for kind in kinds}
    told = " and ".join(f"no {kind} guarding: it lacks {named[kind]}" for kind in kinds)
    rows.add(objects.node, "guarding", told, False, "A drive must notice by itself that its master is gone.")
    return "", has


def _apply(objects: Objects, topic: str, writes: Sequence[Write], rows: Report) -> None:
    """Write all of one topic and read each back."""
    for write in writes:
        place = f"{write.at:04X}h:{write.sub}"
        try:
            found = objects.write_checked(*write)
        except SdoError as error:
            if not error.aborted:
                raise
            advice = "The value is beyond what the drive takes; change the drives file."
            rows.add(objects.node, topic, str(error).rstrip("."), False, advice)
            return
        bits = 0xFFFFFFFF
        if found & bits != write.value & bits:
            advice = "The drive did not keep what was written; change the drives file or its set-up."
            rows.add(objects.node, topic, f"{place} reads {found} after {write.value} was written", False, advice)
            return
    untold = sorted(objects.untold)
    told = f" (not {', '.join(untold)}: write only)" if untold else ""
    rows.add(objects.node, topic, f"{len(writes)} values written and read back{told}", True)
