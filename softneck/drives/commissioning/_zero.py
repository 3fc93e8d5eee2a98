"""Zeroing: tension each tendon gently, then call that zero, and look at the inclinometer whether it may be."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from softneck.core import CheckFailedError, SoftneckError

from ..bus._file import DriveEntry, DrivesFile
from ..bus._link import GuardedLink, Link
from ..bus._objects import HOMED_MARK, MASTER_NODE, Write, current_write, option_writes, speed_of_units, speed_units
from ..bus._sdo import Objects, SdoError
from ..bus._units import counts_to_position
from ..master import Frame
from ..master._cia402 import DriveState, state_of
from ..master._gate import Reading
from ..running._stop import disarm, wait
from ..running._timing import Operator

_MODE, _VELOCITY, _HOMING, _HERE = 0x6060, 3, 6, 35
# A winch that holds is slower [rad/s], and moves less between two looks [rad].
_STANDSTILL_RAD = 0.01
# A winch that turns more slowly has come to a stop [rad/s] if it does for this long, and each has to in this time [s].
_STILL, _STILL_TIME, _TIME = 0.2, 0.3, 10.0
# Between two looks at a drive [s].
_POLL_S = 0.02
# Speeds of 606Ch and of 6064h differ by less than this part, or the slow loop is not what the drives file says.
_SLOW_LOOP_TOLERANCE = 0.25
# What is slower than this tells nothing about the slow loop [rad/s].
_FAST_ENOUGH = 0.3
_SETTLING_S = 1.0
_ENABLE_TIME = 1.0

Look = Callable[[], Reading | None]


@dataclass(frozen=True, slots=True)
class ZeroResult:
    """The result of zeroing, for each motor.

    `nodes`: of the drives. `pulled`: how far each winch turned until its tendon was tight [rad]. `outputs`: what is
    measured, and how much of it then [rad].
    """

    nodes: tuple[int, ...]
    pulled: tuple[float, ...]
    outputs: Mapping[str, float]

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives commission --only zero`."""
        return {
            "zeroed": True,
            "motors": [{"node": n, "pulled_rad": p} for n, p in zip(self.nodes, self.pulled, strict=True)],
            **{f"{name}_deg": math.degrees(angle) for name, angle in self.outputs.items()},
        }


class _Motor:
    """One drive while it is zeroed."""

    def __init__(self, link: Link, entry: DriveEntry, file: DrivesFile) -> None:
        self.entry, self.file = entry, file
        self.objects = Objects(link, entry.node)
        self.link = link
        self.start = self.pulled = 0.0
        self.held, self.late_mode = 0, False

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
            Write(0x6065, 0, 0),
            Write(0x607C, 0, 0),
            Write(0x607D, 1, -(2**31)),
            Write(0x607D, 2, 2**31 - 1),
            Write(0x6083, 0, max(1, abs(pull))),
            Write(0x6085, 0, max(1, abs(pull))),
            current_write(zero.current, self.entry, self.file.profile),
            Write(0x60FF, 0, 0),
        ]
        for write in writes:
            self._keep(*write)
        try:
            self._keep(_MODE, 0, _VELOCITY)
        except SdoError as error:
            if not error.aborted:
                raise
            self.late_mode = True  # until then its speed, if that is what it has, is zero

    def _keep(self, index: int, subindex: int, value: int) -> None:
        if self.objects.write_checked(index, subindex, value) != value:
            raise CheckFailedError(f"node {self.entry.node}: {index:04X}h does not keep {value}.")

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
                wait(self.link, _POLL_S)
        if self.late_mode:
            self._keep(_MODE, 0, _VELOCITY)

    def take_homing(self) -> int:
        """Change to the homing mode; return by how many counts the winch went back meanwhile.

        A drive that takes a mode only without power loses it for an instant, and the tendon turns the winch back.
        """
        try:
            self.objects.write(_MODE, 0, _HOMING)
        except SdoError as error:
            if not error.aborted or self.late_mode:
                raise
            self.word(0x06)
            wait(self.link, _POLL_S)
            self.objects.write(_MODE, 0, _HOMING)
            self.enable()
            until = self.link.now + _SETTLING_S  # it may still turn back when the drive begins to hold it
            while abs(_creep(self.link, self)) > _STANDSTILL_RAD and self.link.now < until:
                pass
            return self.objects.read(0x6064) - self.held
        return 0


def zero(link: Link, file: DrivesFile, look: Look, *, guarding: str, operator: Operator | None = None) -> ZeroResult:
    """Tension the tendons of all motors, set the encoders' zero there, verify, and switch the drives off.

    Args:
        link: to the bus; the drives are configured and their nodes operational or pre-operational.
        file: with the settings.
        look: returns the inclinometer's newest sample.
        guarding: "life" or "heartbeat", as the pre-flight set it up; it is fed from here while tendons are pulled.
        operator: asked every 20 ms; whatever is asked for switches the drives off.

    Raises:
        CheckFailedError: a tendon does not get tight in time, the neck is not upright, or the slow loop is another.
    """
    signs = _signs_of_life(file, guarding)
    # Fed from every wait of this thread, those for answers too: a master that hangs stops feeding.
    guarded = GuardedLink(link, signs, file.guard_cycles * file.cycle)
    motors = [_Motor(guarded, entry, file) for entry in file.drives]
    left: dict[int, str] = {}
    zeroed = False
    try:
        for motor in motors:
            motor.prepare()
            motor.start = motor.position()
            motor.enable()
            _tension(guarded, motor, operator)
        # What the later ones pulled may have loosened the first: all pull on with their small current.
        _rest(guarded, _SETTLING_S, operator)
        outputs = _upright(file, look)
        for motor in motors:
            motor.held = motor.objects.read(0x6064)
        for motor in motors:
            _set_zero(guarded, motor)
        zeroed = True
    finally:
        _each(motors, (0x6040, 0x06), (0x6040, 0x00))
        if not zeroed:  # a mark that stayed would let the next run start from a zero that nobody confirmed
            _each(motors, (0x607C, 0))
        left = disarm(link, file, guarding, signs)
    for node, why in left.items():
        raise CheckFailedError(
            f"node {node}: did not confirm that it is switched off: {why}. Press the hardware stop (Enable input)."
        )
    pulled = tuple(motor.pulled for motor in motors)
    return ZeroResult(file.nodes, pulled, outputs)


def _tension(link: Link, motor: _Motor, operator: Operator | None) -> None:
    zero, node = motor.file.zero, motor.entry.node
    motor.objects.write(0x60FF, 0, speed_units(zero.speed, motor.entry, motor.file.profile))
    begin = link.now
    still_since: float | None = None
    before, before_at, ratios = motor.position(), link.now, []
    while True:
        _rest(link, _POLL_S, operator)
        now, position, speed = link.now, motor.position(), motor.speed()
        moved = (position - before) / max(now - before_at, 1e-6)
        if abs(moved) > _FAST_ENOUGH and abs(speed) > 0.01:
            ratios.append(speed / moved)
        before, before_at = position, now
        if abs(speed) > _STILL or now - begin < 2.0 * _POLL_S:
            still_since = None
        elif still_since is None:
            still_since = now
        elif now - still_since >= _STILL_TIME:
            break
        if now - begin > _TIME:
            raise CheckFailedError(
                f"node {node}: the tendon of this motor did not get tight within {_TIME:g} s; "
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


def _upright(file: DrivesFile, look: Look) -> dict[str, float]:
    tilt = look()
    if tilt is None or not tilt.valid:
        raise CheckFailedError("the inclinometer gives no sample; the zero cannot be verified.")
    found = dict(zip(file.moves.outputs.names, tilt.values, strict=True))
    worst = max(map(abs, found.values()))
    if not worst <= file.zero.tilt:
        told = ", ".join(f"{name} {math.degrees(angle):.1f}" for name, angle in found.items())
        raise CheckFailedError(
            f"the robot leans by {told} deg with all tendons tight; "
            f"{math.degrees(file.zero.tilt):g} deg are allowed. No zero was set: look for a tendon that slipped or "
            "hangs."
        )
    return found


def _set_zero(link: Link, motor: _Motor) -> None:
    objects = motor.objects
    before = _creep(link, motor)
    # The drive holds while its mode changes: its speed is zero and the tendon is tight.
    objects.write(0x60FF, 0, 0)
    back = motor.take_homing()
    objects.write(0x607C, 0, HOMED_MARK + back)
    objects.write(0x6098, 0, _HERE)
    begin = link.now
    motor.word(0x1F)
    told = link.now
    wait(link, _POLL_S)
    word = objects.read(0x6041)
    asked = link.now
    counts = objects.read(0x6064) - back
    passed = link.now - begin
    speeds = (before, _creep(link, motor))
    # The zero was taken between `begin` and `told`, the position after `asked`: what a winch, pulled on by its small
    # current, creeps meanwhile, and what one that counts as still turns between two looks.
    ways = [speed * time for speed in speeds for time in (asked - told, passed)]
    off, slack = counts_to_position(counts - HOMED_MARK, motor.entry.scale), _STILL * _POLL_S
    attained = word & 0x3000 == 0x1000  # bit 13: an error
    near = min(ways) - slack <= off <= max(ways) + slack
    if not (attained and near and max(map(abs, speeds)) <= _STILL):
        raise CheckFailedError(
            f"node {motor.entry.node}: homing did not end (status {word:04X}h, position {counts}, "
            f"{speeds[1]:.3f} rad/s). Is its tendon tight still? Zero again."
        )
    if back:
        _mark(motor, counts_to_position(back, motor.entry.scale))


def _mark(motor: _Motor, back: float) -> None:
    """Leave the mark of a zero whose home offset was another one; a drive that counts by it at once is refused."""
    before = motor.position()
    motor.objects.write(0x607C, 0, HOMED_MARK)
    if abs(motor.position() - before) > max(0.5 * abs(back), _STANDSTILL_RAD):
        raise CheckFailedError(
            f"node {motor.entry.node}: its position follows 607Ch at once, and it takes no mode with power; "
            "it cannot be zeroed."
        )


def _creep(link: Link, motor: _Motor) -> float:
    """Return how fast the winch turns, by its position at two looks [rad/s]: 606Ch steps by a count per sample."""
    first, begin = motor.position(), link.now
    wait(link, _POLL_S)
    return (motor.position() - first) / max(link.now - begin, _POLL_S)


def _signs_of_life(file: DrivesFile, guarding: str) -> list[Frame]:
    """Return the frames that prove the master alive: guarding requests, or its heartbeat."""
    if guarding == "life":
        return [Frame(0x700 + node, b"\0", remote=True) for node in file.nodes]
    return [Frame(0x700 + MASTER_NODE, b"\x05")]


def _each(motors: list[_Motor], *writes: tuple[int, int]) -> None:
    """Write to all, as when they are switched off; one that does not answer must not keep the others on."""
    for motor in motors:
        try:
            for index, value in writes:
                motor.objects.write(index, 0, value)
        except SoftneckError:
            continue


def _rest(link: Link, seconds: float, operator: Operator | None) -> None:
    """Wait, and end it all if somebody asks for it."""
    until = link.now + seconds
    while link.now < until - 1e-9:
        if operator is not None and operator() is not None:
            raise CheckFailedError("stopped by the operator. The drives are off; zero them again.")
        wait(link, min(_POLL_S, until - link.now))
