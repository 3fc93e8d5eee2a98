"""A simulated CANopen node: NMT, SDO, PDOs, SYNC, EMCY, heartbeat, life guarding (CiA 301), around an `Axis`."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from ._axis import Axis, fields_of
from ._sdo import WRONG_STATE, WRONG_VALUE, SdoServer


class CanFrame(NamedTuple):
    """One frame with an 11-bit identifier.

    `identifier`: COB-ID. `data`: at most 8 bytes. `remote`: a request (RTR).
    """

    identifier: int
    data: bytes
    remote: bool = False


_PREOPERATIONAL, _OPERATIONAL, _STOPPED = 0x7F, 0x05, 0x04
_COMMANDS = {0x01: _OPERATIONAL, 0x02: _STOPPED, 0x80: _PREOPERATIONAL}
_PDO_DISABLED = 0x80000000


@dataclass(slots=True)
class _Pdo:
    """One active PDO."""

    packed: struct.Struct
    keys: list[tuple[int, int]]
    kind: int
    identifier: int
    actions: list[Callable]
    waiting: tuple[int, ...] | None = None
    sent: bytes = b""
    syncs: int = 0


class SimulatedDrive:
    """One node on the bus.

    Attributes:
        axis: the drive behind it.
        nmt: its NMT state as the protocol codes it.
        alive: False while it has no supply: then it neither receives nor sends.
    """

    def __init__(self, axis: Axis) -> None:
        """Put `axis` on the bus; it first sends at the next `tick`."""
        self.axis, self.alive = axis, True
        self._out: list[CanFrame] = []
        self._sdo = SdoServer(axis.read, self._write, axis.size)
        self._boot(0.0)

    def _boot(self, now: float) -> None:
        self.axis.emergencies.clear()
        self.nmt = _PREOPERATIONAL
        self._toggle = 0
        self._guarded_at = self._heard_at = None
        self._told = False
        self._beat_at = now
        self._receive_pdos: dict[int, _Pdo] = {}
        self._transmit_pdos: list[_Pdo] = []
        self._errors: list[int] = []
        node = self.axis.node
        self._ids = (0x600 + node, 0x700 + node)
        self._out.append(CanFrame(0x700 + node, b"\0"))
        self._watch_times()

    def power_cycle(self, now: float) -> None:
        """Simulate a short loss of supply: start values, lost zero, boot-up message."""
        self._out.clear()
        self.axis.reset()
        self._boot(now)

    # -- frames in ----------------------------------------------------------------------------------------------

    def receive(self, now: float, frame: CanFrame) -> None:
        """Process one frame from the bus."""
        identifier, data, remote = frame
        if not self.alive:
            return
        pdo = self._receive_pdos.get(identifier)
        if pdo is not None and not remote:
            if self.nmt == _OPERATIONAL and len(data) >= pdo.packed.size:
                values = pdo.packed.unpack_from(data)
                if pdo.kind <= 240:
                    pdo.waiting = values
                else:
                    self._apply(pdo, values)
        elif identifier == self.axis.values[(0x1005, 0)] & 0x7FF and not remote:
            self._sync()
        elif identifier == self._ids[1] and remote:
            self._guard(now)
        elif identifier == self._ids[0] and not remote:
            if self.nmt != _STOPPED:
                self._out += [CanFrame(0x580 + self.axis.node, answer) for answer in self._sdo.answers(data)]
        elif identifier == 0x000 and len(data) == 2 and data[1] in (0, self.axis.node):
            self._command(now, data[0])
        elif self._consumed and identifier == 0x700 + self._consumed[0]:
            self._heard_at, self._told = now, False

    def _command(self, now: float, command: int) -> None:
        if command in _COMMANDS:
            self.nmt = _COMMANDS[command]
            self._map()
        elif command == 0x81:
            self.power_cycle(now)
        elif command == 0x82:
            self._boot(now)

    def _guard(self, now: float) -> None:
        if self.axis.values.get((0x1017, 0)) or (0x100C, 0) not in self.axis.values:
            return  # heartbeat and guarding exclude each other (CiA 301, 7.2.8.3.2)
        self._out.append(CanFrame(self._ids[1], bytes([self._toggle | self.nmt])))
        self._toggle ^= 0x80
        self._guarded_at, self._told = now, False

    def _sync(self) -> None:
        if self.nmt != _OPERATIONAL:
            return
        for pdo in self._receive_pdos.values():
            if pdo.waiting is not None:
                values, pdo.waiting = pdo.waiting, None
                self._apply(pdo, values)
        self.axis.synchronise()
        for pdo in self._transmit_pdos:
            if pdo.kind > 240:
                continue
            pdo.syncs += 1
            data = self._pack(pdo)
            # Type n: with each n-th SYNC; type 0: with the SYNC after a change (CiA 301, 7.5.2.35).
            if pdo.syncs == pdo.kind or (pdo.kind == 0 and data != pdo.sent):
                pdo.syncs = 0
                self._send(pdo, data)

    def _send(self, pdo: _Pdo, data: bytes) -> None:
        pdo.sent = data
        self._out.append(CanFrame(pdo.identifier, data))

    def _apply(self, pdo: _Pdo, values: tuple[int, ...]) -> None:
        # The last entries first: a set-point stands before the control word that may start it.
        for action, value in zip(reversed(pdo.actions), reversed(values), strict=True):
            action(value)

    def _pack(self, pdo: _Pdo) -> bytes:
        try:
            return pdo.packed.pack(*[action() for action in pdo.actions])
        except struct.error:
            # A value beyond its field, such as a speed: its lowest bits, as in a register.
            sizes = [self.axis.profile.items[key].size for key in pdo.keys]
            pairs = zip(pdo.actions, sizes, strict=True)
            return b"".join((int(action()) & ((1 << 8 * size) - 1)).to_bytes(size, "little") for action, size in pairs)

    # -- time ---------------------------------------------------------------------------------------------------

    def tick(self, now: float) -> list[CanFrame]:
        """Process the events due at `now` and return all frames to send since the last call."""
        if not self.alive:
            self._out.clear()
            return []
        axis = self.axis
        axis.watch()
        life, beat, consumed = self._life, self._beat, self._consumed
        heard = self._guarded_at if life else self._heard_at
        limit = life or (consumed[1] if consumed else 0.0)
        if heard is not None and limit and not self._told and now - heard >= limit - 1e-9:
            self._told = True
            axis.connection_lost()
            if self.axis.profile.heartbeat_consumer and self.axis.values[(0x1029, 1)] == 0:
                self.nmt = _PREOPERATIONAL
        if beat and now - self._beat_at >= beat - 1e-9:
            self._beat_at = now
            self._out.append(CanFrame(self._ids[1], bytes([self.nmt])))
        while axis.emergencies:
            code, register = axis.emergencies.popleft()
            self._remember(code)
            told = axis.values[(0x1014, 0)]
            if self.nmt != _STOPPED and not told & _PDO_DISABLED:
                self._out.append(CanFrame(told & 0x7FF, struct.pack("<HB5x", code, register)))
        if self.nmt == _OPERATIONAL:
            for pdo in self._transmit_pdos:  # the event-driven ones with changed data
                if pdo.kind >= 254 and (data := self._pack(pdo)) != pdo.sent:
                    self._send(pdo, data)
        frames, self._out = self._out, []
        return frames

    def _remember(self, code: int) -> None:
        """Store an error in 1003h, newest first."""
        v = self.axis.values
        self._errors = [code, *self._errors][:2] if v[(0x1003, 0)] else [code]
        v[(0x1003, 0)] = len(self._errors)
        v |= {(0x1003, place): error for place, error in enumerate(self._errors, start=1)}

    def _watch_times(self) -> None:
        v = self.axis.values
        self._life = v.get((0x100C, 0), 0) * v.get((0x100D, 0), 0) / 1000.0
        self._beat = v.get((0x1017, 0), 0) / 1000.0
        entry = v.get((0x1016, 1), 0)
        self._consumed = ((entry >> 16) & 0x7F, (entry & 0xFFFF) / 1000.0) if entry & 0xFFFF else None
        if not self._life and not self._consumed:
            self._guarded_at = self._heard_at = None

    # -- objects that are the node's own --------------------------------------------------------------------------

    def _write(self, index: int, subindex: int, data: bytes) -> int:
        kind, number = index & 0xFE00, index & 0x1FF
        if kind in (0x1400, 0x1600, 0x1800, 0x1A00) and number < 4:
            code = self._check_pdo(index, subindex, data)
            if code:
                return code
        code = self.axis.write(index, subindex, data)
        if not code:
            if 0x1400 <= index < 0x1C00:
                self._map()
            elif index in (0x100C, 0x100D, 0x1016, 0x1017):
                self._watch_times()
        return code

    def _check_pdo(self, index: int, subindex: int, data: bytes) -> int:
        """Check that mappings are only changed while the PDO is off and their count is 0 (CiA 301, 7.5.2.36)."""
        v = self.axis.values
        mapping = bool(index & 0x200)
        communication = (index & ~0x200, 1)
        if mapping:
            if not v[communication] & _PDO_DISABLED:
                return WRONG_STATE
            if subindex > 0 and v[(index, 0)]:
                return WRONG_STATE
            if subindex == 0 and data and data[0]:
                entries = [v.get((index, i), 0) for i in range(1, data[0] + 1)]
                if data[0] > 4 or fields_of(dict(self.axis.profile.items), entries) is None:
                    return WRONG_VALUE
        return 0

    def _map(self) -> None:
        """Build the active PDOs from the objects."""
        v, axis = self.axis.values, self.axis
        self._receive_pdos, self._transmit_pdos = {}, []
        items = dict(axis.profile.items)
        for n in range(4):
            for base, mapping in ((0x1400, 0x1600), (0x1800, 0x1A00)):
                identifier, count = v[(base + n, 1)], v[(mapping + n, 0)]
                if identifier & _PDO_DISABLED or not count:
                    continue
                fields = fields_of(items, [v[(mapping + n, i)] for i in range(1, count + 1)])
                if fields is None:
                    continue
                packed, keys = fields
                if base == 0x1400:
                    actions = [self._setter(key) for key in keys]
                    pdo = _Pdo(packed, keys, v[(base + n, 2)], identifier & 0x7FF, actions)
                    self._receive_pdos[identifier & 0x7FF] = pdo
                else:
                    actions = [self._getter(key) for key in keys]
                    pdo = _Pdo(packed, keys, v[(base + n, 2)], identifier & 0x7FF, actions)
                    self._transmit_pdos.append(pdo)

    def _setter(self, key: tuple[int, int]) -> Callable[[int], object]:
        axis, item = self.axis, self.axis.profile.items[key]
        direct = axis.setters.get(key)
        if direct is None:
            return lambda value: axis.store(key, value, item)

        def put(value: int) -> None:
            axis.values[key] = value
            direct(value)

        return put

    def _getter(self, key: tuple[int, int]) -> Callable[[], int]:
        axis = self.axis
        return axis.getters.get(key) or (lambda: axis.values[key])
