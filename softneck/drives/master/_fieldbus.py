"""Cyclic traffic with the drives, without I/O: received frames to drive states and events, targets to frames."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from softneck.core import require_between, require_whole

from ._cia402 import DriveState, Goal, control_word, state_of
from ._events import Event


class Frame(NamedTuple):
    """One frame on the CAN bus.

    Attributes:
        identifier: COB-ID.
        data: at most 8 bytes.
        remote: a remote request (RTR).
        error: an error reported by the adapter, not a frame on the bus; data is b"off" for bus-off.
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
    error: bool = False


BUS_OFF = Frame(0, b"off", error=True)
"""Frame that the I/O layer inserts when the adapter is bus-off or gone."""


class NodeState(IntEnum):
    """NMT states, coded as in heartbeat and guarding messages."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F
    UNKNOWN = 0xFF


class Command(IntEnum):
    """NMT commands."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


def nmt_frame(command: Command, node: int) -> Frame:
    """Return the frame that commands `node` (0: all)."""
    return Frame(0x000, bytes([command, node]))


def node_state(code: int) -> NodeState:
    """Return the NMT state in a heartbeat or guarding byte; the toggle bit is ignored."""
    try:
        return NodeState(code & 0x7F)
    except ValueError:
        return NodeState.UNKNOWN


_TPDO = struct.Struct("<Hih")
_RPDO = struct.Struct("<Hi")
_EMERGENCY = struct.Struct("<HB")
SYNC = Frame(0x080)
# SDO request to write 8 to 6060h, and the start of the answer that confirms it (CiA 301, 7.2.4.3.3).
_LATE_MODE, _MODE_TAKEN = b"\x2f\x60\x60\0\x08\0\0\0", b"\x60\x60\x60\0"
# Not faults: a drive at its own software limit decelerates and reports it (FF06h, FF07h).
_LIMIT_CODES = (0xFF06, 0xFF07)


# A second TPDO with each SYNC for so long comes from a second device [s].
_TWICE_TIME = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class BusSettings:
    """Settings of the cyclic traffic.

    Attributes:
        nodes: node numbers of the motors, in their order.
        cycle: [s].
        guarding: "life" (guarding by RTR) or "heartbeat".
        guard_cycles: cycles between two guarding requests, or two heartbeats of the master.
        master: node number of the master, for the heartbeat.
        silent_cycles: cycles without any drive's answer after which the bus counts as dead.
        missing_cycles: cycles without a drive's TPDO after which the drive counts as lost.
        answer_time: time without a drive's guarding answer or heartbeat after which it counts as lost [s].
        stalled_cycles: cycles between two steps after which the loop counts as stalled.
        late_modes: nodes whose drive only accepts its mode in Operation Enabled, so that it is written there.
        off: names of disabled guards, for the tests that show that each guard is needed.
    """

    nodes: tuple[int, ...] = (1, 2, 3)
    cycle: float = 0.01
    guarding: str = "life"
    guard_cycles: int = 2
    master: int = 127
    silent_cycles: int = 3
    missing_cycles: int = 5
    answer_time: float = 0.25
    stalled_cycles: int = 5
    late_modes: tuple[int, ...] = ()
    off: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        require_between("cycle", self.cycle, 0.005, 0.05, "s")
        for node in self.nodes:
            require_whole("node", node, 1, 126)


class DriveView:
    """The master's view of one drive.

    Attributes:
        node: its number.
        word, state: last status word and the state in it.
        counts, current: last position and current in the drive's units.
        fresh: whether a TPDO came since the last step.
        silent: cycles without a TPDO.
        received: TPDOs since the last step.
        excess: TPDOs beyond one for each SYNC, accumulated; 0 where one device answers.
        answered: when guarding or heartbeat last came [s]; None before the first.
        nmt: NMT state in the last guarding answer or heartbeat.
        emergencies: (time, code, register) of the last 20.
        mode: "taken" if the drive has the cyclic mode, "asked" while its answer is pending, else "missing".
    """

    __slots__ = (
        "answered", "counts", "current", "emergencies", "excess", "fresh", "heard", "mode", "nmt", "node", "received",
        "silent", "state", "toggle", "word",
    )  # fmt: skip

    def __init__(self, node: int, *, late_mode: bool) -> None:
        """Start with unknown states."""
        self.mode = "missing" if late_mode else "taken"
        self.node = node
        self.word, self.state = 0, DriveState.UNKNOWN
        self.counts = self.current = 0
        self.fresh, self.heard, self.silent = False, False, 0
        self.received = self.excess = 0
        self.answered: float | None = None
        self.nmt, self.toggle = NodeState.UNKNOWN, -1
        self.emergencies: list[tuple[float, int, int]] = []

    @property
    def follows(self) -> bool:
        """Whether the drive reported Operation Enabled in this cycle and has the cyclic mode."""
        return self.state is DriveState.ENABLED and self.fresh and self.mode == "taken"


def _malformed(now: float, view: DriveView, what: str, data: bytes) -> Event:
    return Event(now, "frame_length", view.node, f"{what} of {len(data)} byte(s)")


class Fieldbus:
    """Reader and writer of the cyclic frames of all drives.

    `settings`: as given. `drives`: the views.
    """

    def __init__(self, settings: BusSettings) -> None:
        """Build the table of identifiers."""
        self.settings = settings
        self.drives = tuple(DriveView(node, late_mode=node in settings.late_modes) for node in settings.nodes)
        self._cycle = 0
        self._handlers = {}
        foreign = {0x000, 0x080, 0x100, 0x700 + settings.master}
        for view in self.drives:
            self._handlers[0x180 + view.node] = (self._tpdo, view)
            self._handlers[0x080 + view.node] = (self._emergency, view)
            self._handlers[0x700 + view.node] = (self._error_control, view)
            if view.mode != "taken":
                self._handlers[0x580 + view.node] = (self._answer, view)
            foreign |= {base + view.node for base in (0x200, 0x300, 0x400, 0x500, 0x600)}
        self._foreign = frozenset(foreign)
        self._guards = tuple(Frame(0x700 + node, b"\0", remote=True) for node in settings.nodes)
        self._beat = Frame(0x700 + settings.master, bytes([NodeState.OPERATIONAL]))

    def receive(self, now: float, frames: Sequence[Frame]) -> list[Event]:
        """Process all frames since the last step and return the events."""
        events: list[Event] = []
        for view in self.drives:
            view.fresh, view.received = False, 0
        for frame in frames:
            identifier, data, remote, error = frame
            if error:
                if data == b"off":
                    events.append(Event(now, "bus_off"))
                continue
            handler = self._handlers.get(identifier)
            if handler is not None and not remote:
                handler[0](now, handler[1], data, events)
            elif identifier in self._foreign or (remote and handler is not None):
                kind = "request" if remote else "frame"
                events.append(Event(now, "second_master", 0, f"{kind} {identifier:03X}h, not sent by us"))
        self._watch(now, events)
        return events

    def _tpdo(self, now: float, view: DriveView, data: bytes, events: list[Event]) -> None:
        if len(data) != _TPDO.size:
            events.append(_malformed(now, view, "TPDO", data))
            return
        view.word, view.counts, view.current = _TPDO.unpack(data)
        view.state = state_of(view.word)
        view.fresh = view.heard = True
        view.received += 1

    def _emergency(self, now: float, view: DriveView, data: bytes, events: list[Event]) -> None:
        if len(data) < _EMERGENCY.size:
            events.append(_malformed(now, view, "emergency", data))
            return
        code, register = _EMERGENCY.unpack_from(data)
        view.emergencies = [*view.emergencies[-19:], (now, code, register)]
        if code in _LIMIT_CODES:
            events.append(Event(now, "drive_limit", view.node, f"{code:04X}h"))
        elif code:
            events.append(Event(now, "emergency", view.node, f"code {code:04X}h, register {register:02X}h"))

    def _error_control(self, now: float, view: DriveView, data: bytes, events: list[Event]) -> None:
        if len(data) != 1:
            events.append(_malformed(now, view, "heartbeat or guarding answer", data))
            return
        state = node_state(data[0])
        if state is NodeState.BOOT_UP:
            events.append(Event(now, "boot_up", view.node))
            view.nmt = NodeState.PRE_OPERATIONAL
            return
        if self.settings.guarding == "life":
            toggle = data[0] >> 7
            # An answer with the old toggle bit is an old answer (CiA 301, 7.2.8.2.2.2): it counts as none. The next
            # one is compared with it, so that a lost answer costs one more and not all.
            stale, view.toggle = toggle == view.toggle, toggle
            if stale:
                return
        view.answered, view.nmt = now, state
        if state is not NodeState.OPERATIONAL:
            events.append(Event(now, "node_left", view.node, f"it says {state.name}"))

    def _answer(self, now: float, view: DriveView, data: bytes, events: list[Event]) -> None:
        """Process the answer to `_LATE_MODE`; after a refusal the wait for Operation Enabled times out."""
        del now, events
        if view.mode == "asked" and data[:4] == _MODE_TAKEN:
            view.mode = "taken"

    def _watch(self, now: float, events: list[Event]) -> None:
        s = self.settings
        dead = True
        for view in self.drives:
            if view.fresh:
                view.silent = 0
                dead = False
            else:
                view.silent += 1
                dead = dead and view.silent >= s.silent_cycles
            # One that came late is followed by a cycle with two; one device never sends more than it got SYNCs.
            view.excess = max(0, view.excess + view.received - 1)
            if view.received > 1:
                events.append(Event(now, "tpdo_twice", view.node, f"{view.received} TPDOs since the last SYNC"))
            if view.excess * s.cycle >= _TWICE_TIME:
                events.append(Event(now, "node_twice", view.node))
            if view.silent == s.missing_cycles or (view.silent > s.missing_cycles and view.silent % 100 == 0):
                events.append(Event(now, "tpdo_missing", view.node))
            if view.answered is not None and now - view.answered > s.answer_time:
                events.append(Event(now, "heartbeat_missing", view.node))
                view.answered = now
        if dead and self._cycle and all(view.heard for view in self.drives):
            events.append(Event(now, "bus_silent"))

    def send(self, goals: Sequence[Goal], targets: Sequence[int], *, guard: bool = True) -> list[Frame]:
        """Return the frames of this cycle: set-points, SYNC, and guarding if it is due and `guard` is set."""
        frames = []
        for view, goal, target in zip(self.drives, goals, targets, strict=True):
            word = control_word(view.state, goal)
            frames.append(Frame(0x200 + view.node, _RPDO.pack(word, target)))
            if view.mode == "missing" and goal is Goal.ENABLED and view.state is DriveState.ENABLED:
                view.mode = "asked"
                frames.append(Frame(0x600 + view.node, _LATE_MODE))
        frames.append(SYNC)
        if guard and self._cycle % self.settings.guard_cycles == 0:
            frames.extend(self.signs_of_life())
        self._cycle += 1
        return frames

    def signs_of_life(self) -> tuple[Frame, ...]:
        """Return the frames that keep the drives' guarding alive: a request to each, or the master's heartbeat."""
        return self._guards if self.settings.guarding == "life" else (self._beat,)

    def start(self) -> list[Frame]:
        """Return the frames that start the nodes."""
        return [nmt_frame(Command.START, view.node) for view in self.drives]
