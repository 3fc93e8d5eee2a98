"""A simulated drive: objects, power states, modes, faults, and their effect on its row of the motion table."""

from __future__ import annotations

import math
import struct
from collections import deque

from softneck.core import Vector

from . import _servo_runtime as servo
from ._profiles import Item, Profile
from ._quirks import NOT_TOLD, DriveQuirks
from ._sdo import NO_OBJECT, NO_SUBINDEX, READ_ONLY, WRITE_ONLY, WRONG_LENGTH, WRONG_VALUE

# Current in internal units: A x 65520 / (2 I_peak).
_CURRENT_RANGE = 65520.0
# Speed of the demand below which a stop ramp is over [counts/s].
_STANDSTILL_SPEED = 1.0
_FOLLOWING_ERROR, _ENABLE_INPUT, _GUARDING = 0x8611, 0x5441, 0x8130
# Fault -> bit of 2000h. The bits are not verified on hardware.
_MOTION_ERRORS = {_GUARDING: 1 << 0, 0x2340: 1 << 1, _FOLLOWING_ERROR: 1 << 3, 0x2310: 1 << 8, 0x4310: 1 << 11,
                  0x3210: 1 << 12, 0x3220: 1 << 13, _ENABLE_INPUT: 1 << 15}  # fmt: skip
_LIMIT_CODES = {1.0: 0xFF06, -1.0: 0xFF07}

# The power state machine of a drive (CiA 402-2): states by their status word under the mask 6Fh.
STATES = {0x00: "NOT_READY", 0x40: "DISABLED", 0x21: "READY", 0x23: "SWITCHED_ON", 0x27: "ENABLED", 0x07: "QUICK_STOP",
          0x0F: "REACTION", 0x08: "FAULT"}  # fmt: skip
NOT_READY, SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, REACTION, FAULT = STATES

# Requests of control words: (mask, value, request), first match wins; bit 7 acts by its rising edge.
_REQUEST_TABLE = (
    (0x02, 0x00, "disable voltage"),
    (0x06, 0x02, "quick stop"),
    (0x07, 0x06, "shutdown"),
    (0x0F, 0x07, "switch on"),
    (0x0F, 0x0F, "enable"),
)
_TRANSITIONS = {
    (SWITCH_ON_DISABLED, "shutdown"): READY,
    (READY, "disable voltage"): SWITCH_ON_DISABLED,
    (READY, "quick stop"): SWITCH_ON_DISABLED,
    (READY, "switch on"): SWITCHED_ON,
    # Through Switched On at once (CiA 402-2, transition 3 followed by 4).
    (READY, "enable"): ENABLED,
    (SWITCHED_ON, "disable voltage"): SWITCH_ON_DISABLED,
    (SWITCHED_ON, "quick stop"): SWITCH_ON_DISABLED,
    (SWITCHED_ON, "shutdown"): READY,
    (SWITCHED_ON, "enable"): ENABLED,
    (ENABLED, "disable voltage"): SWITCH_ON_DISABLED,
    (ENABLED, "shutdown"): READY,
    (ENABLED, "switch on"): SWITCHED_ON,
    (ENABLED, "quick stop"): QUICK_STOP,
    (QUICK_STOP, "disable voltage"): SWITCH_ON_DISABLED,
    (QUICK_STOP, "enable"): ENABLED,
}


class Axis:
    """Objects and power stage of one drive; its node handles CAN.

    Attributes:
        values: (index, subindex) -> value of every object.
        state: of the power state machine.
        emergencies: codes not yet sent, with error register.
        fault: code of the active fault, 0 if none.
        homed: whether the encoder's zero was set since the last reset.
        enable_input: the hardware input; without it the drive faults.
        quirks: its restrictions compared with other drives.
        device_name: its type (1008h), "" if it has none.
        counts_per_turn: of the motor; the encoder's index pulse occurs once a turn.
    """

    def __init__(
        self, node: int, profile: Profile, motion: Vector, *, peak_current: float, slow_loop: float,
        quirks: DriveQuirks | None = None,
    ) -> None:  # fmt: skip
        """Make a drive with node number `node` and its row `motion` of the servo runtime."""
        self.node, self.profile, self.motion = node, profile, motion
        self.peak_current, self.slow_loop = peak_current, slow_loop
        self.enable_input, self.quirks = True, quirks or DriveQuirks()
        self.device_name = profile.name_of(peak_current)
        self.tick, self.counts_per_turn = 1e-3, 2048.0
        self.values: dict[tuple[int, int], int] = {}
        self.emergencies: deque[tuple[int, int]] = deque()
        self.setters = {(0x6040, 0): self._control, (0x607A, 0): self._set_target, (0x60FF, 0): self._set_speed}
        self.getters = {
            (0x6041, 0): self.status_word,
            (0x6064, 0): lambda: int(motion[servo.SERVO_POSITION]),
            (0x606C, 0): lambda: round(motion[servo.SERVO_ACTUAL_SPEED] * self._units_per_count),
            (0x6061, 0): self._shown_mode,
            (0x207E, 0): lambda: round(motion[servo.SERVO_CURRENT] * _CURRENT_RANGE / (2.0 * self.peak_current)),
            (0x6078, 0): lambda: round(1000.0 * motion[servo.SERVO_CURRENT] / max(profile.rated_current, 1e-9)),
            (0x603F, 0): lambda: self.fault,
            (0x1001, 0): lambda: 1 if self.fault else 0,
            (0x2000, 0): lambda: _MOTION_ERRORS.get(self.fault, 0),
            (0x60B9, 0): lambda: 0 if self._captured is None else 0x03,
            (0x60BA, 0): lambda: self._captured or 0,
        }
        self.reset()

    # -- life cycle ---------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Reset all objects to their start values, as after power-on; the encoder's zero is lost."""
        self.values = {key: item.start for key, item in self.profile.items.items()}
        for key in ((0x1018, 4), (0x1018, 2)):
            self.values[key] = 1000 + self.node if key[1] == 4 else self.profile.products.get(self.device_name, 0)
        own = [(base + n, 1) for base in (0x1400, 0x1800) for n in range(4)]
        for key in (*own, (0x1014, 0), (0x1200, 1), (0x1200, 2)):
            self.values[key] += self.node
        if self.profile.rated_current:
            self.values[(0x6075, 0)] = round(1000.0 * self.profile.rated_current)
        if (0x207F, 0) in self.values:
            self.values[(0x207F, 0)] = 32760  # the peak current: no limit unless set
        self.state, self.fault, self.homed = SWITCH_ON_DISABLED, 0, False
        self._word = self._stop_then = 0
        self._attained = self._acknowledged = False
        self._limit_told = self._target = 0
        self._turn, self._captured = None, None
        m = self.motion
        m[servo.SERVO_POWER] = m[servo.SERVO_TRIPPED] = m[servo.SERVO_LEFT] = 0.0
        m[servo.SERVO_ZERO] -= m[servo.SERVO_POSITION]
        m[servo.SERVO_POSITION] = 0.0
        self._configure()

    @property
    def _units_per_count(self) -> float:
        return self.profile.units_per_count or 65536.0 * self.slow_loop

    # -- objects ------------------------------------------------------------------------------------------------

    def read(self, index: int, subindex: int) -> bytes | int:
        """Return an object's bytes, or an SDO abort code."""
        item = self.profile.items.get((index, subindex))
        if item is None or index in self.quirks.lacks:
            return self._not_there(index)
        if self.quirks.write_only and index in NOT_TOLD:
            return WRITE_ONLY
        if not item.size:
            return (self.device_name if index == 0x1008 else item.text).encode("ascii")
        getter = self.getters.get((index, subindex))
        value = getter() if getter else self.values[(index, subindex)]
        return (int(value) & ((1 << 8 * item.size) - 1)).to_bytes(item.size, "little")

    def _not_there(self, index: int) -> int:
        known = index not in self.quirks.lacks and any(key[0] == index for key in self.profile.items)
        return NO_SUBINDEX if known else NO_OBJECT

    def size(self, index: int, subindex: int) -> int:
        """Return the size of an object [bytes]; 4 for an unknown one."""
        item = self.profile.items.get((index, subindex))
        return item.size if item else 4

    def write(self, index: int, subindex: int, data: bytes) -> int:
        """Store an object's bytes; return 0 or an SDO abort code."""
        item = self.profile.items.get((index, subindex))
        if item is None or index in self.quirks.lacks:
            return self._not_there(index)
        if not item.writable:
            return READ_ONLY
        if len(data) != item.size:
            return WRONG_LENGTH
        value = int.from_bytes(data, "little", signed=item.signed)
        refused = self.quirks.unwritable(index, value, enabled=self.state == ENABLED)
        return refused or self.store((index, subindex), value, item)

    def store(self, key: tuple[int, int], value: int, item: Item) -> int:
        """Store a value that fits `item`; return 0 or an SDO abort code."""
        del item
        if not self._is_allowed(key, value):
            return WRONG_VALUE
        self.values[key] = value
        setter = self.setters.get(key)
        if setter is not None:
            setter(value)
        else:
            self._configure()
        return 0

    def _is_allowed(self, key: tuple[int, int], value: int) -> bool:
        allowed = {
            (0x605A, 0): (0, 1, 2, 5, 6),
            (0x605E, 0): (-1, 0, 2),
            (0x6007, 0): (0, 1, 2, 3),
            (0x6098, 0): (0, 35, 37),
            (0x1003, 0): (0,),
            **{(0x1800 + n, 2): (*range(241), 254, 255) for n in range(4)},
        }.get(key)
        return allowed is None or value in allowed

    def _configure(self) -> None:
        """Copy the settings in the objects to the motion row."""
        v, m = self.values, self.motion
        unit, square = self._units_per_count, self._units_per_count * (1.0 if self._plain else self.slow_loop)
        m[servo.SERVO_SPEED] = v[(0x6081, 0)] / unit
        m[servo.SERVO_ACCELERATION] = v[(0x6083, 0)] / square or math.inf
        m[servo.SERVO_DECELERATION] = v[(0x6085, 0)] / square or math.inf
        m[servo.SERVO_LOW], m[servo.SERVO_HIGH] = v[(0x607D, 1)], v[(0x607D, 2)]
        m[servo.SERVO_WINDOW], m[servo.SERVO_TIMEOUT] = v[(0x6065, 0)], v[(0x6066, 0)] / 1000.0
        if (0x207F, 0) in v:
            m[servo.SERVO_CURRENT_LIMIT] = v[(0x207F, 0)] * 2.0 * self.peak_current / _CURRENT_RANGE
        else:
            m[servo.SERVO_CURRENT_LIMIT] = v[(0x6073, 0)] * v[(0x6075, 0)] / 1e6
        if self.state == ENABLED and m[servo.SERVO_MODE] != v[(0x6060, 0)]:
            self._take_mode()

    @property
    def _plain(self) -> bool:
        return self.profile.units_per_count is not None

    # -- power states -------------------------------------------------------------------------------------------

    def status_word(self) -> int:
        """Return 6041h."""
        m, mode = self.motion, self.values[(0x6060, 0)]
        word = self.state | 0x0200 | 0x0010
        if self.state != QUICK_STOP:
            word |= 0x0020 if self.state & 0x04 else 0
        if m[servo.SERVO_AT_LIMIT] != 0.0:
            word |= 0x0800
        if mode == 6:
            return word | (0x1400 if self._attained else 0)
        if mode == 1 and m[servo.SERVO_DEMAND] == m[servo.SERVO_TARGET]:
            word |= 0x0400
        if (mode == 8 and self.state == ENABLED) or (mode == 1 and self._acknowledged):
            word |= 0x1000
        return word | (0x2000 if m[servo.SERVO_TRIPPED] else 0)

    def _shown_mode(self) -> int:
        mode = self.values[(0x6060, 0)]
        return 0 if mode == 8 and self.profile.late_mode_display and self.state != ENABLED else mode

    def _control(self, word: int) -> None:
        before, self._word = self._word, word
        if self.state == FAULT:
            if word & 0x80 and not before & 0x80 and self.enable_input:
                self.fault = 0
                self.motion[servo.SERVO_TRIPPED] = 0.0
                self.emergencies.append((0x0000, 0))
                self.state = SWITCH_ON_DISABLED
            return
        if self.state == REACTION:
            return
        self._enter(next_state(self.state, word))
        if self.state == ENABLED:
            self._mode_bits(word, before)

    def _mode_bits(self, word: int, before: int) -> None:
        """Execute bits 4 to 6 of the control word: a move in mode 1, homing in mode 6."""
        mode, m = self.values[(0x6060, 0)], self.motion
        rising = word & 0x10 and not before & 0x10
        self._acknowledged = bool(word & 0x10)
        if mode == 1 and rising:
            m[servo.SERVO_TARGET] = self._target + (m[servo.SERVO_DEMAND] if word & 0x40 else 0.0)
        if mode == 6 and rising and self.values[(0x6098, 0)] in (35, 37):
            shift = self.values[(0x607C, 0)] - m[servo.SERVO_POSITION]
            for column in (servo.SERVO_ZERO, servo.SERVO_POSITION, servo.SERVO_DEMAND, servo.SERVO_TARGET):
                m[column] += shift
            self._attained = self.homed = True

    def _enter(self, state: int) -> None:
        if state == self.state:
            return
        before, self.state = self.state, state
        if state == QUICK_STOP:
            option = self.values[(0x605A, 0)]
            if option == 0:
                self._enter(SWITCH_ON_DISABLED)
            else:
                self._stop(SWITCH_ON_DISABLED if option in (1, 2) else 0)
        elif state == ENABLED:
            if not self.enable_input:
                self.trip(_ENABLE_INPUT)
                return
            if before != QUICK_STOP:
                self.motion[servo.SERVO_DEMAND] = self.motion[servo.SERVO_POSITION]
                self.motion[servo.SERVO_DEMAND_SPEED] = 0.0
            self.motion[servo.SERVO_POWER] = 1.0
            self._attained = False
            self._take_mode()
        elif state != REACTION:
            self.motion[servo.SERVO_POWER] = 0.0

    def _take_mode(self) -> None:
        m, mode = self.motion, self.values[(0x6060, 0)]
        m[servo.SERVO_MODE] = mode if mode in (1, 3, 8) else 0
        m[servo.SERVO_LEFT] = 0.0
        if mode == 1:
            m[servo.SERVO_TARGET] = m[servo.SERVO_DEMAND]

    def _stop(self, then: int) -> None:
        """Ramp down, then go to state `then`; 0 stays in Quick Stop Active."""
        self.motion[servo.SERVO_MODE] = 0.0
        self._stop_then = then

    def trip(self, code: int) -> None:
        """Enter a fault: report it once, react by 605Eh, and latch it."""
        if self.state in (FAULT, REACTION):
            return
        self.fault = code
        self.emergencies.append((code, 1))
        if self.motion[servo.SERVO_POWER] > 0.5 and self.values[(0x605E, 0)] == 2:
            self._enter(REACTION)
            self._stop(FAULT)
        else:
            self._enter(FAULT)

    def connection_lost(self) -> None:
        """Handle a failure of guarding or heartbeat: report it and react by 6007h."""
        option = self.values[(0x6007, 0)]
        if option == 1:
            self.trip(_GUARDING)
            return
        self.emergencies.append((_GUARDING, 0x10))
        if option == 2:
            self._enter(next_state(self.state, 0x00))
        elif option == 3 and self.state == ENABLED:
            self._enter(QUICK_STOP)

    def watch(self) -> None:
        """Update limits, following error, inputs and the end of stop ramps; called after each cycle of motion."""
        m = self.motion
        self._probe()
        if m[servo.SERVO_POWER] < 0.5:
            return
        if m[servo.SERVO_TRIPPED] and self.state not in (FAULT, REACTION):
            self.trip(_FOLLOWING_ERROR)
        if not self.enable_input:
            self.trip(_ENABLE_INPUT)
        at = m[servo.SERVO_AT_LIMIT]
        if at != self._limit_told:
            self._limit_told = at
            if at:
                self.emergencies.append((_LIMIT_CODES[at], 0))
        if m[servo.SERVO_MODE] == 0.0 and self._stop_then and abs(m[servo.SERVO_DEMAND_SPEED]) < _STANDSTILL_SPEED:
            then, self._stop_then = self._stop_then, 0
            self._enter(then)

    def _probe(self) -> None:
        """Keep the position of the last index pulse while the touch probe (60B8h) waits for it."""
        if self.values[(0x60B8, 0)] & 0x17 != 0x17:  # on, at each, at the index, at its rising edge
            self._turn = self._captured = None
            return
        # Counts that home offset and reset do not move: the index sits on the rotor.
        m = self.motion
        turn = math.floor((m[servo.SERVO_POSITION] - m[servo.SERVO_ZERO]) / self.counts_per_turn)
        if self._turn is not None and turn != self._turn:
            self._captured = round(max(turn, self._turn) * self.counts_per_turn + m[servo.SERVO_ZERO])
        self._turn = turn

    # -- set-points ---------------------------------------------------------------------------------------------

    def _set_target(self, counts: int) -> None:
        self._target = counts

    def _set_speed(self, units: int) -> None:
        self.motion[servo.SERVO_TARGET_SPEED] = units / self._units_per_count

    def synchronise(self) -> None:
        """SYNC came: in the cyclic mode go to the target within one interpolation period (60C2h)."""
        m = self.motion
        if m[servo.SERVO_MODE] != 8.0 or m[servo.SERVO_POWER] < 0.5:
            return
        period = self.values[(0x60C2, 1)] * 10.0 ** self.values[(0x60C2, 2)]
        ticks = max(1.0, float(round(period / self.tick)))
        m[servo.SERVO_TARGET] = self._target
        m[servo.SERVO_SLOPE] = (self._target - m[servo.SERVO_DEMAND]) / ticks
        m[servo.SERVO_LEFT] = ticks


def fields_of(
    items: dict[tuple[int, int], Item], mapping: list[int]
) -> tuple[struct.Struct, list[tuple[int, int]]] | None:
    """Return how the mapping entries (index, subindex, bits) pack into a PDO; None if one does not fit."""
    letters = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h", (4, False): "I", (4, True): "i"}
    code, keys = "<", []
    for entry in mapping:
        key, bits = (entry >> 16, (entry >> 8) & 0xFF), entry & 0xFF
        item = items.get(key)
        if item is None or not item.size or bits != 8 * item.size:
            return None
        code += letters[item.size, item.signed]
        keys.append(key)
    packed = struct.Struct(code)
    return (packed, keys) if packed.size <= 8 else None


def request(word: int) -> str:
    """Return the request in control word `word`; "" for none."""
    return next((name for mask, value, name in _REQUEST_TABLE if word & mask == value), "")


def next_state(state: int, word: int) -> int:
    """Return the state after control word `word`; unchanged without a transition."""
    return _TRANSITIONS.get((state, request(word)), state)
