"""Jogging: move one motor a little, both ways, and compare the tilt with its tendon's direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import CheckFailedError, Matrix, SettingsError, Vector, require_between, require_whole
from softneck.signals import Excitation

from ..running._bus_loop import RunEnd, Session
from ..running._pilot import SignalPilot, raised_cosine
from ._record import record_signal

SAMPLE_TIME = 0.02
# One way takes this long, the motor then stands for this long; angles are means over the last part of it [s].
_WAY, _STAND, _MEAN = 1.0, 1.5, 0.75
# Jogged further or by less than this it is no jog [rad].
LEAST, MOST = 0.1, 1.5
# Less than this part of the tilt that is expected is no movement of the neck.
_LEAST_MOTION_SHARE = 0.25
# The mean angles must be known to this part of what is seen.
_NOISE_SHARE = 0.35


@dataclass(frozen=True, slots=True)
class JogResult:
    """The result of a jog.

    Attributes:
        motor: from 1 on; node: its drive.
        amplitude: [rad], both ways where the motor's range has both.
        expected, seen: outputs for the way up [rad], of a neck (pitch, roll): half of what changes from the lower end
            to the upper; NaN where the directions are to be identified.
        noise: standard error of `seen` [rad].
        turned: what the motor's own encoder says that it moved, both ways together [rad].
        verdict: "ok", "wrong sign", "other motor?", "no movement", "unclear" or "stopped"; "not judged" where the
            directions are to be identified.
        advice: what to do, "" where it holds.
        ended: how the run on the drives ended.
        outputs: names of what is measured.
    """

    motor: int
    node: int
    amplitude: float
    expected: tuple[float, ...]
    seen: tuple[float, ...]
    noise: float
    turned: float
    verdict: str
    advice: str
    ended: RunEnd
    outputs: tuple[str, ...] = ("pitch", "roll")

    @property
    def holds(self) -> bool:
        """Whether the motor pulls where it should."""
        return self.verdict in ("ok", "not judged")

    def require(self) -> None:
        """Raise CheckFailedError unless it does."""
        if self.verdict == "stopped":
            self.ended.require()
        if not self.holds:
            raise CheckFailedError(f"motor {self.motor} (node {self.node}): {self.verdict}. {self.advice}")

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives commission --only jog`."""

        def way(angles: tuple[float, ...]) -> dict[str, float | None]:
            size, named = math.hypot(*angles), zip(self.outputs, angles, strict=True)
            plane = len(angles) == 2 and size > 0.0
            direction = math.degrees(math.atan2(angles[1], angles[0])) % 360.0 if plane else None
            values = {f"{name}_deg": math.degrees(angle) for name, angle in named}
            return {**values, "tilt_deg": math.degrees(size), "direction_deg": direction}

        return {
            "motor": self.motor,
            "node": self.node,
            "amplitude_rad": self.amplitude,
            "expected": way(self.expected),
            "seen": way(self.seen),
            "noise_deg": math.degrees(self.noise),
            "turned_rad": self.turned,
            "verdict": self.verdict,
            "holds": self.holds,
            "advice": self.advice,
            **self.ended.table(),
        }


def jog(
    motor: int,
    session: Session,
    *,
    tendon_angles: tuple[float, ...] | None = None,
    amplitude: float = 0.5,
    report: Callable[[float], None] | None = None,
) -> JogResult:
    """Pull the tendon of one motor a little, let it out as much, and look where the neck goes.

    The drives must be zeroed; the same pre-flight, ramps, supervisor, limits and watches as in a run.

    Args:
        motor: number of the motor in the drives file.
        session: on which drives.
        tendon_angles: psi_1.. of the neck file [rad]: P > 0 tilts towards (cos psi, sin psi) in (pitch, roll); None:
            P > 0 moves the outputs along the motor's direction, that of the drives' robot.
        amplitude: of the motor [rad]; where its range ends before, no further.
        report: called now and then with the done fraction.

    Raises:
        SettingsError: no such motor, an amplitude that is too small, or one beyond the limits of the drives file.
        CheckFailedError: the pre-flight failed; nothing moved.
    """
    robot = session.file.moves
    motors, outputs = len(robot.motors.names), robot.outputs.names
    require_whole("motor", motor, 1, motors)
    require_between("--travel", amplitude, LEAST, MOST, "rad")
    low, high, speed = session.file.ranges[motor - 1]
    whose = "drives file" if session.file.robot is None else "drives file or robot"
    if amplitude > high:
        raise SettingsError(f"--travel {amplitude:g} is beyond the {high:g} rad of the {whose}.")
    fastest = 0.5 * math.pi * amplitude / _WAY
    if fastest > speed:
        raise SettingsError(f"--travel {amplitude:g} moves at up to {fastest:.2g} rad/s; the {whose} allows {speed:g}.")
    lowest = max(-amplitude, low)
    path, stands = _path(amplitude, lowest)
    played = {"motor": motor, "amplitude": amplitude, "lowest": lowest, "motors": motors}
    time, rows = np.arange(len(path)) * SAMPLE_TIME, _rows(path, motor, motors)
    session = replace(session, facts={**session.facts, "jog": played})
    run = record_signal([Excitation(f"motor {motor}", time, rows, SAMPLE_TIME)], session, report=report)
    # The direction in which each motor moves the outputs; none where they are to be identified.
    ways = list(zip(*session.file.weights, strict=True))
    if tendon_angles is not None:
        ways = [(math.cos(angle), math.sin(angle)) for angle in tendon_angles]
    way = 0.5 * (amplitude - lowest) * session.file.watch.gain
    expected = tuple(way * part for part in ways[motor - 1]) if ways else (math.nan,) * len(outputs)
    found = JogResult(
        motor, session.file.nodes[motor - 1], amplitude, expected, (math.nan,) * len(outputs), math.nan, math.nan,
        *_explain_stop(run.ended, motor), run.ended, outputs,
    )  # fmt: skip
    if run.recording is None or run.rows < len(path):
        return found
    seen, noise = _response(np.column_stack([run.recording.channels[name] for name in outputs]), stands)
    position = run.recording.motor_positions[:, motor - 1]
    turned = float(position[stands[1]].mean() - position[stands[3]].mean())
    verdict, advice = judge(seen, noise, expected, ways, motor) if ways else ("not judged", "")
    if verdict == "no movement" and turned < 0.5 * (amplitude - lowest):
        advice = f"The motor itself turned by {turned:.2f} of {amplitude - lowest:g} rad: is it blocked? {advice}"
    return replace(found, seen=seen, noise=noise, turned=turned, verdict=verdict, advice=advice)


def jog_pilot(motor: int, amplitude: float, lowest: float | None = None, motors: int = 3) -> SignalPilot:
    """Return the pilot that moves one motor up by `amplitude` [rad], and down as far or to `lowest`."""
    return SignalPilot(_rows(_path(amplitude, -amplitude if lowest is None else lowest)[0], motor, motors))


def _rows(path: Vector, motor: int, motors: int) -> Matrix:
    rows = np.zeros((len(path), motors))
    rows[:, motor - 1] = path
    return rows


def _explain_stop(ended: RunEnd, motor: int) -> tuple[str, str]:
    """Return verdict and advice for a jog that did not get to its end.

    A tendon can only pull: a motor whose current says that it is pushed has the wrong sign.
    """
    fault = ended.master.supervisor.fault
    if fault is not None and fault.name == "pushed":
        nodes = ended.master.settings.bus.nodes
        if fault.node == nodes[motor - 1]:
            return "wrong sign", (
                f"{fault.detail.partition(':')[0]}: its current says that its tendon pushes. Change `reversed` of this "
                "drive, and zero it again."
            )
        return (
            "stopped",
            f"The current of motor {nodes.index(fault.node) + 1} says that its tendon pushes: jog that one first.",
        )
    return "stopped", "It was stopped before it was done."


def _path(amplitude: float, lowest: float) -> tuple[Vector, tuple[slice, ...]]:
    """Return rest, up, rest, down, rest as set-points of the motor, and over which samples angles are averaged."""
    way, stand, mean = (round(value / SAMPLE_TIME) for value in (_WAY, _STAND, _MEAN))
    levels = (0.0, amplitude, 0.0, lowest, 0.0)
    parts, stands, at, length = [], [], 0.0, 0
    for level in levels:
        moved = np.full(stand, level) if level == at else np.concatenate(
            [at + (level - at) * raised_cosine(way), np.full(stand, level)]
        )  # fmt: skip
        parts.append(moved)
        length += len(moved)
        stands.append(slice(length - mean, length))
        at = level
    return np.concatenate(parts), tuple(stands)


def _response(angles: Matrix, stands: tuple[slice, ...]) -> tuple[tuple[float, ...], float]:
    """Return half of the change of all outputs from the lower end to the upper, and its standard error.

    Samples of an inclinometer are not independent of each other (the lab's stay off by 0.3 deg for a while): the
    error is the larger of that of independent samples and of what the three stands at rest differ by.
    """
    parts = [angles[part] for part in stands]
    means = np.array([np.nanmean(part, axis=0) for part in parts])
    spread = max(float(np.sqrt(np.nanvar(part, axis=0).sum())) for part in parts)
    count = min(int(np.isfinite(part).all(axis=1).sum()) for part in parts)
    alone = spread / math.sqrt(max(count, 1)) / math.sqrt(2.0)
    # Rest before, between and after should be one: what is left is drift, hysteresis and slow noise.
    slow = float(np.sqrt(np.var(means[::2], axis=0).sum())) / math.sqrt(2.0)
    return tuple(((means[1] - means[3]) / 2.0).tolist()), max(alone, slow)


def judge(
    seen: Sequence[float], noise: float, expected: Sequence[float], ways: Sequence[Sequence[float]], motor: int
) -> tuple[str, str]:
    """Return verdict and advice for measured outputs (on the way up), compared with `expected`.

    The nearest of all `ways` (each motor pulling, or letting out) says which one moved, and which way.
    """
    size, wanted = math.hypot(*seen), math.hypot(*expected)
    if not math.isfinite(size):
        return "unclear", "The inclinometer gave no angles."
    if noise > _NOISE_SHARE * max(size, wanted):
        return "unclear", (
            f"The inclinometer is noisier ({math.degrees(noise):.1f} deg) than what is to be seen "
            f"({math.degrees(wanted):.1f} deg); look at it, or raise --travel."
        )
    if size < _LEAST_MOTION_SHARE * wanted:
        return (
            "no movement",
            "Is its tendon attached and tight (`softneck drives commission --only zero`)? Is the inclinometer fixed?",
        )
    gaps = {(number, sign): _gap(seen, way, sign) for number, way in enumerate(ways, start=1) for sign in (1, -1)}
    # Where two motors pull the same way, or against each other, this one is meant.
    number, sign = min(gaps, key=lambda key: (round(gaps[key], 6), key[0] != motor))
    direction = ""
    if len(seen) == 2:
        direction = f": it tilts towards {math.degrees(math.atan2(seen[1], seen[0])) % 360.0:.0f} deg"
    if (number, sign) == (motor, 1):
        return "ok", ""
    if number == motor:
        return "wrong sign", (
            f"A positive move lets the tendon out{direction}. Change `reversed` of this drive; where every motor shows "
            "this, the inclinometer is mounted turned."
        )
    turned = "" if sign > 0 else ", turning the wrong way"
    return "other motor?", (
        f"It moves the neck as motor {number} would{turned}{direction}. Exchange the node numbers in the drives "
        "file; where every motor is off by the same angle, the inclinometer is mounted turned."
    )


def _gap(seen: Sequence[float], way: Sequence[float], sign: int) -> float:
    """Return the angle between the measured and a motor's direction [rad]; pi if nothing moves."""
    size = math.hypot(*seen) * math.hypot(*way)
    along = sum(a * b for a, b in zip(seen, way, strict=True))
    return math.acos(min(1.0, max(-1.0, sign * along / size))) if size > 0.0 else math.pi
