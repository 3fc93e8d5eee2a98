"""Jogging: one motor a little, both ways, and whether the neck tilts the way that its tendon says."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import CheckFailedError, SettingsError, Vector, require_between, require_whole

from ..running._bus_loop import RunEnd, Session, run_session
from ..running._pilot import SignalLog, SignalPilot, raised_cosine

SAMPLE_TIME = 0.02
# One way takes this long, the motor then stands for this long; angles are means over the last part of it [s].
_WAY, _STAND, _MEAN = 1.0, 1.5, 0.75
# Jogged further or by less than this it is no jog [rad].
LEAST, MOST = 0.1, 1.5
# Less than this part of the tilt that is expected is no movement of the neck.
_MOVED = 0.25
# The mean angles must be known to this part of what is seen.
_NOISE = 0.35


@dataclass(frozen=True, slots=True)
class JogResult:
    """What a jog showed.

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
            size = math.hypot(*angles)
            table: dict[str, float | None] = {
                f"{name}_deg": math.degrees(angle) for name, angle in zip(self.outputs, angles, strict=True)
            }
            plane = len(angles) == 2 and size > 0.0
            direction = math.degrees(math.atan2(angles[1], angles[0])) % 360.0 if plane else None
            return {**table, "tilt_deg": math.degrees(size), "direction_deg": direction}

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
    log = SignalLog(len(path), session=session)

    def tell(*cycle: Any) -> None:
        master = cycle[4]
        if report is not None and master.ran and master.index % 25 == 0:
            report(master.index / len(path))

    played: dict[str, Any] = {"motor": motor, "amplitude": amplitude}
    if not robot.is_neck:
        played |= {"lowest": lowest, "motors": motors}
    facts = {**session.facts, "jog": played}
    session = replace(session, watches=(log, tell, *session.watches), facts=facts)
    ended = run_session(session, jog_pilot(**played), sample_time=SAMPLE_TIME, most=len(path) * SAMPLE_TIME)
    ways = _ways(session, tendon_angles)
    way = 0.5 * (amplitude - lowest) * session.file.watch.gain
    expected = tuple(way * part for part in ways[motor - 1]) if ways else (math.nan,) * len(outputs)
    node = session.file.nodes[motor - 1]
    if log.rows < len(path):
        nothing = (math.nan,) * len(outputs)
        verdict, advice = _stopped(ended, motor)
        return JogResult(motor, node, amplitude, expected, nothing, math.nan, math.nan, verdict, advice, ended, outputs)
    columns = log.columns()
    seen, noise = _seen(columns, outputs, stands)
    position = columns[f"motor_position_{motor}"]
    up, down = stands[1], stands[3]
    turned = float(position[up].mean() - position[down].mean())
    verdict, advice = judge(seen, noise, expected, ways, motor) if ways else ("not judged", "")
    if verdict == "no movement" and turned < 0.5 * (amplitude - lowest):
        advice = f"The motor itself turned by {turned:.2f} of {amplitude - lowest:g} rad: is it blocked? {advice}"
    return JogResult(motor, node, amplitude, expected, seen, noise, turned, verdict, advice, ended, outputs)


def _ways(session: Session, tendon_angles: tuple[float, ...] | None) -> list[tuple[float, ...]]:
    """Return the direction in which each motor moves the outputs; none where they are to be identified."""
    if tendon_angles is not None:
        return [(math.cos(angle), math.sin(angle)) for angle in tendon_angles]
    return list(zip(*session.file.weights, strict=True))


def jog_pilot(motor: int, amplitude: float, lowest: float | None = None, motors: int = 3) -> SignalPilot:
    """Return what moves one of the motors up by `amplitude` [rad], and down as far or to `lowest`."""
    path, _ = _path(amplitude, -amplitude if lowest is None else lowest)
    set_points = np.zeros((len(path), motors))
    set_points[:, motor - 1] = path
    return SignalPilot(set_points)


def _stopped(ended: RunEnd, motor: int) -> tuple[str, str]:
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


def _seen(
    columns: Mapping[str, Vector], outputs: Sequence[str], stands: tuple[slice, ...]
) -> tuple[tuple[float, ...], float]:
    """Return the response of all outputs and its standard error; two at a time, as a complex number."""
    names = [*outputs, *outputs[:1]] if len(outputs) % 2 else list(outputs)
    pairs = [_response(columns[a] + 1j * columns[b], stands) for a, b in zip(names[::2], names[1::2], strict=True)]
    parts = [part for seen, _ in pairs for part in (seen.real, seen.imag)]
    return tuple(parts[: len(outputs)]), math.hypot(*(noise for _, noise in pairs))


def _response(angles: np.ndarray, stands: tuple[slice, ...]) -> tuple[complex, float]:
    """Return half of the change from the lower end to the upper, and its standard error.

    Samples of an inclinometer are not independent of each other (the lab's stay off by 0.3 deg for a while): the
    error is the larger of that of independent samples and of what the three stands at rest differ by.
    """
    means = [complex(np.nanmean(angles[part])) for part in stands]
    seen = (means[1] - means[3]) / 2.0
    spread = max(float(np.nanstd(angles[part])) for part in stands)
    count = min(int(np.isfinite(angles[part]).sum()) for part in stands)
    alone = spread / math.sqrt(max(count, 1)) / math.sqrt(2.0)
    # Rest before, between and after should be one: what is left is drift, hysteresis and slow noise.
    rest = np.array([means[0], means[2], means[4]])
    slow = float(np.sqrt(np.mean(np.abs(rest - rest.mean()) ** 2))) / math.sqrt(2.0)
    return seen, max(alone, slow)


def judge(
    seen: Sequence[float], noise: float, expected: Sequence[float], ways: Sequence[Sequence[float]], motor: int
) -> tuple[str, str]:
    """Return verdict and advice for outputs `seen` (for the way up) where `expected` should be.

    The nearest of all `ways` (each motor pulling, or letting out) says which one moved, and which way.
    """
    size, wanted = math.hypot(*seen), math.hypot(*expected)
    if not math.isfinite(size):
        return "unclear", "The inclinometer gave no angles."
    if noise > _NOISE * max(size, wanted):
        return "unclear", (
            f"The inclinometer is noisier ({math.degrees(noise):.1f} deg) than what is to be seen "
            f"({math.degrees(wanted):.1f} deg); look at it, or raise --travel."
        )
    if size < _MOVED * wanted:
        return (
            "no movement",
            "Is its tendon attached and tight (`softneck drives commission --only zero`)? Is the inclinometer fixed?",
        )
    gaps = {(number, sign): _gap(seen, way, sign) for number, way in enumerate(ways, start=1) for sign in (1, -1)}
    # Where two motors pull the same way, or against each other, this one is meant.
    number, sign = min(gaps, key=lambda key: (round(gaps[key], 6), key[0] != motor))
    count = {1: "the motor", 2: "both motors"}.get(len(ways), f"all {_COUNTS.get(len(ways), len(ways))} motors")
    direction = ""
    if len(seen) == 2:
        direction = f": it tilts towards {math.degrees(cmath.phase(complex(*seen))) % 360.0:.0f} deg"
    if (number, sign) == (motor, 1):
        return "ok", ""
    if number == motor:
        show = "shows" if len(ways) == 1 else "show"
        return "wrong sign", (
            f"A positive move lets the tendon out{direction}. Change `reversed` of this drive; where {count} "
            f"{show} this, the inclinometer is mounted turned."
        )
    turned = "" if sign > 0 else ", turning the wrong way"
    return "other motor?", (
        f"It moves the neck as motor {number} would{turned}{direction}. Exchange the node numbers in the drives "
        f"file; where {count} are off by the same angle, the inclinometer is mounted turned."
    )


_COUNTS = {3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight"}


def _gap(seen: Sequence[float], way: Sequence[float], sign: int) -> float:
    """Return the angle between what is seen and a motor's direction [rad]; a motor that moves nothing is far off."""
    size = math.hypot(*seen) * math.hypot(*way)
    along = sum(a * b for a, b in zip(seen, way, strict=True))
    return math.acos(min(1.0, max(-1.0, sign * along / size))) if size > 0.0 else math.pi
