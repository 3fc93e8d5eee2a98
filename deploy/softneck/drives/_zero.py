"""Zeroing: tension each tendon gently, then call that zero, and look at the inclinometer whether it may be."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from canopen.objectdictionary import ObjectDictionary

from softneck.core import CheckFailedError, SoftneckError

from ._bus_loop import Operator
from ._file import DriveEntry, DrivesFile
from ._link import Link
from ._objects import (
    HOMED_MARK,
    MASTER_NODE,
    Write,
    current_write,
    disarm_writes,
    option_writes,
    speed_of_units,
    speed_units,
)
from ._preflight import require_bus
from ._sdo import Objects, SdoError, load_eds
from ._units import counts_to_position
from .master import DriveState, Frame, Tilt, state_of

_VELOCITY, _HOMING, _HERE = 3, 6, 35
# Between two looks at a drive [s].
_LOOK = 0.02
# Speeds of 606Ch and of 6064h differ by less than this part, or the slow loop is not what the drives file says.
_SLOW_LOOP_TOLERANCE = 0.25
# What is slower than this tells nothing about the slow loop [rad/s].
_FAST_ENOUGH = 0.3
_SETTLE = 1.0
_ENABLE_TIME = 1.0

Look = Callable[[], Tilt | None]


@dataclass(frozen=True, slots=True)
class Zeroed:
    """What zeroing found, for each motor.

    Attributes:
        nodes: of the drives.
        pulled: how far each winch turned until its tendon was tight [rad].
        pitch, roll: of the neck then [rad].
    """

    nodes: tuple[int, ...]
    pulled: tuple[float, ...]
    pitch: float
    roll: float

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives zero`."""
        return {
            "zeroed": True,
            "motors": [{"node": n, "pulled_rad": p} for n, p in zip(self.nodes, self.pulled, strict=True)],
            "pitch_deg": math.degrees(self.pitch),
            "roll_deg": math.degrees(self.roll),
        }


class _Motor:
    """One drive while it is zeroed."""

    def __init__(self, link: Link, entry: DriveEntry, file: DrivesFile, dictionary: ObjectDictionary) -> None:
        self.entry, self.file = entry, file
        self.objects = Objects(link, entry.node, dictionary)
        self.link = link
        self.start = self.pulled = 0.0

    def position(self) -> float:
        return counts_to_position(self.objects.read(0x6064), self.entry.scale)

    def speed(self) -> float:
        return speed_of_units(self.objects.read(0x606C), self.entry, self.file.profile)

    def state(self) -> DriveState:
        return state_of(self.objects.read(0x6041))

    def word(self, value: int) -> None:
        self.objects.write(0x6040, 0, value)

    def prepare(self) -> None:
        zero = self.file.zero
        pull = speed_units(zero.speed, self.entry, self.file.profile)
        writes = [
            *option_writes(),
            Write(0x6065, 0, 0, "zero"),
            Write(0x607D, 1, -(2**31), "zero"),
            Write(0x607D, 2, 2**31 - 1, "zero"),
            Write(0x6083, 0, max(1, abs(pull)), "zero"),
            Write(0x6085, 0, max(1, abs(pull)), "zero"),
            current_write(zero.current, self.entry, self.file.profile, "zero"),
            Write(0x60FF, 0, 0, "zero"),
            Write(0x6060, 0, _VELOCITY, "zero"),
        ]
        for write in writes:
            if self.objects.written(write.index, write.subindex, write.value) != write.value:
                raise CheckFailedError(f"node {self.entry.node}: {write.index:04X}h does not keep {write.value}.")

    def enable(self) -> None:
        until = self.link.now + _ENABLE_TIME
        for word, state in ((0x06, DriveState.READY), (0x07, DriveState.SWITCHED_ON), (0x0F, DriveState.ENABLED)):
            self.word(word)
            while self.state() is not state:
                if self.link.now > until:
                    found = self.state()
                    advice = " Is the hardware stop released? Then `softneck drives reset`." * (
                        found is DriveState.FAULT
                    )
                    raise CheckFailedError(
                        f"node {self.entry.node}: does not get to {state.name}; it is in {found.name}.{advice}"
                    )
                wait(self.link, _LOOK)


def wait(link: Link, seconds: float) -> None:
    """Let time pass; what comes meanwhile is not needed."""
    until = link.now + seconds
    while link.now < until - 1e-9:
        link.receive(until - link.now)


def zero(link: Link, file: DrivesFile, look: Look, *, guarding: str, operator: Operator | None = None) -> Zeroed:
    """Tension the tendons of motors 1 to 3, set the encoders' zero there, verify, and switch the drives off.

    Args:
        link: to the bus; the drives are configured and their nodes operational or pre-operational.
        file: with the settings.
        look: returns the inclinometer's newest sample.
        guarding: "life" or "heartbeat", as the pre-flight set it up; it is fed from here while tendons are pulled.
        operator: asked every 20 ms; whatever is asked for switches the drives off.

    Raises:
        CheckFailedError: a tendon does not get tight in time, the neck is not upright, or the slow loop is another.
    """
    dictionary = load_eds(file.profile, file.eds)
    motors = [_Motor(link, entry, file, dictionary) for entry in file.drives]
    guard = _feeder(link, file, guarding, operator)
    try:
        for motor in motors:
            motor.prepare()
            motor.start = motor.position()
            motor.enable()
            _tension(link, motor, guard)
        # What the later ones pulled may have loosened the first: all pull on with their small current.
        _rest(link, _SETTLE, guard)
        tilt = _upright(file, look)
        for motor in motors:
            _set_zero(link, motor)
    finally:
        _off(motors, guarding)
    pulled = tuple(motor.pulled for motor in motors)
    return Zeroed(file.nodes, pulled, tilt.pitch, tilt.roll)


def _tension(link: Link, motor: _Motor, guard: Callable[[], None]) -> None:
    zero, node = motor.file.zero, motor.entry.node
    motor.objects.write(0x60FF, 0, speed_units(zero.speed, motor.entry, motor.file.profile))
    begin = link.now
    still_since: float | None = None
    before, before_at, ratios = motor.position(), link.now, []
    while True:
        _rest(link, _LOOK, guard)
        now, position, speed = link.now, motor.position(), motor.speed()
        moved = (position - before) / max(now - before_at, 1e-6)
        if abs(moved) > _FAST_ENOUGH and abs(speed) > 0.01:
            ratios.append(speed / moved)
        before, before_at = position, now
        if abs(speed) > zero.still or now - begin < 2.0 * _LOOK:
            still_since = None
        elif still_since is None:
            still_since = now
        elif now - still_since >= zero.still_time:
            break
        if now - begin > zero.timeout:
            raise CheckFailedError(
                f"node {node}: the tendon of this motor did not get tight within {zero.timeout:g} s; "
                "is it attached, does the winch turn the right way (`reversed`)?"
            )
        if motor.state() is not DriveState.ENABLED:
            raise CheckFailedError(
                f"node {node}: left Operation Enabled while it pulled; it is in {motor.state().name}."
            )
    motor.pulled = position - motor.start
    middle = sorted(ratios)[len(ratios) // 2] if len(ratios) >= 3 else 1.0
    if abs(middle - 1.0) > _SLOW_LOOP_TOLERANCE:
        raise CheckFailedError(
            f"node {node}: its speed (606Ch) is {middle:.2f} times that of its position; the drives file's "
            "`slow_loop_s`, `gear` or `encoder_counts` is not the drive's."
        )


def _upright(file: DrivesFile, look: Look) -> Tilt:
    tilt = look()
    if tilt is None or not tilt.valid:
        raise CheckFailedError("the inclinometer gives no sample; the zero cannot be verified.")
    worst = max(abs(tilt.pitch), abs(tilt.roll))
    if not worst <= file.zero.tilt:
        raise CheckFailedError(
            f"the neck leans by pitch {math.degrees(tilt.pitch):.1f}, roll {math.degrees(tilt.roll):.1f} deg with all "
            f"tendons tight; {math.degrees(file.zero.tilt):g} deg are allowed. No zero was set: look for a tendon that "
            "slipped or hangs."
        )
    return tilt


def _set_zero(link: Link, motor: _Motor) -> None:
    objects = motor.objects
    objects.write(0x607C, 0, HOMED_MARK)
    objects.write(0x6098, 0, _HERE)
    # The drive holds while its mode changes: its speed is zero and the tendon is tight.
    objects.write(0x60FF, 0, 0)
    objects.write(0x6060, 0, _HOMING)
    motor.word(0x1F)
    wait(link, _LOOK)
    word = objects.read(0x6041)
    counts = objects.read(0x6064)
    if not word & 0x1000 or abs(counts - HOMED_MARK) > 50:
        raise CheckFailedError(f"node {motor.entry.node}: homing did not end (status {word:04X}h, position {counts}).")


def _feeder(link: Link, file: DrivesFile, guarding: str, operator: Operator | None) -> Callable[[], None]:
    """Return what tells the drives that we live: guarding requests, or our heartbeat."""
    if guarding == "life":
        frames = [Frame(0x700 + node, b"\0", remote=True) for node in file.nodes]
    else:
        frames = [Frame(0x700 + MASTER_NODE, b"\x05")]

    def feed() -> None:
        if operator is not None and operator() is not None:
            raise CheckFailedError("stopped by the operator. The drives are off; zero them again.")
        link.send(frames)

    return feed


def _off(motors: list[_Motor], guarding: str) -> None:
    """Switch all off and end their guarding; one that does not answer must not keep the others on."""
    for motor in motors:
        try:
            motor.word(0x06)
            motor.word(0x00)
        except SoftneckError:
            continue
    for motor in motors:
        try:
            for write in disarm_writes(guarding):
                motor.objects.write(write.index, write.subindex, write.value)
        except SoftneckError:
            continue


def _rest(link: Link, seconds: float, guard: Callable[[], None]) -> None:
    """Wait, feeding the drives' guarding from here: a master that hangs stops feeding."""
    until = link.now + seconds
    while link.now < until - 1e-9:
        guard()
        wait(link, min(_LOOK, until - link.now))


def stop(link: Link, file: DrivesFile) -> dict[int, str]:
    """Quick stop, then no voltage, for every drive that answers; return node -> state after it.

    Raises:
        BusError: the bus takes no frames: nobody was stopped.
    """
    dictionary = load_eds(file.profile, file.eds)
    drives = {entry.node: Objects(link, entry.node, dictionary) for entry in file.drives}
    # At once and to all, without waiting for answers; then with answers.
    for word in (0x02, 0x02):
        link.send([Frame(0x600 + node, bytes([0x2B, 0x40, 0x60, 0, word, 0, 0, 0])) for node in drives])
    require_bus(link)
    wait(link, 0.5)
    states = {}
    for node, objects in drives.items():
        try:
            objects.write(0x6040, 0, 0x00)
            states[node] = state_of(objects.read(0x6041)).name
        except SdoError:
            states[node] = "no answer"
    return states


def reset(link: Link, file: DrivesFile) -> dict[int, str]:
    """Acknowledge latched faults, the only place where that happens; return node -> state after it.

    Raises:
        BusError: the bus takes no frames.
    """
    dictionary = load_eds(file.profile, file.eds)
    states = {}
    for entry in file.drives:
        objects = Objects(link, entry.node, dictionary)
        try:
            for word in (0x00, 0x80, 0x00):
                objects.write(0x6040, 0, word)
                wait(link, _LOOK)
            states[entry.node] = state_of(objects.read(0x6041)).name
        except SdoError:
            states[entry.node] = "no answer"
        require_bus(link)
    return states


# Where the motor surely has no current. A drive in REACTION or QUICK_STOP still brakes.
_OFF = (DriveState.NOT_READY, DriveState.DISABLED, DriveState.READY, DriveState.SWITCHED_ON, DriveState.FAULT)


def require_stopped(states: Mapping[int, str]) -> None:
    """Raise CheckFailedError if a drive that `stop` spoke to may still have power."""
    powered = [f"node {node}: {state}" for node, state in states.items() if state not in {one.name for one in _OFF}]
    if powered:
        raise CheckFailedError(f"{', '.join(powered)}: not stopped for sure. Press the hardware stop (Enable input).")


def require_reset(states: Mapping[int, str]) -> None:
    """Raise CheckFailedError if a drive is still in Fault, or did not answer `reset`."""
    left = [f"node {node}: {state}" for node, state in states.items() if state in ("no answer", DriveState.FAULT.name)]
    if left:
        raise CheckFailedError(
            f"{', '.join(left)} after the reset. Is the hardware stop released, is the drive on, is its number right?"
        )
