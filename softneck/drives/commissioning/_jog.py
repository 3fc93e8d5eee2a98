"""Jogging: one motor a little, both ways, and whether the neck tilts the way that its tendon says."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import CheckFailedError, SettingsError, Vector, require_between, require_whole

from ..running._bus_loop import RunEnd, Session, run_session
from ..running._signals import SignalLog, SignalPilot, raised_cosine

SAMPLE_TIME = 0.02
# One way takes this long, the motor then stands for this long; angles are means over the last part of it [s].
_WAY, _STAND, _MEAN = 1.0, 1.5, 0.75
# Jogged further or by less than this it is no jog [rad].
LEAST, MOST = 0.1, 1.5
# Six ways a tilt can go: three tendons, each pulled or let out; they are 60 deg apart.
_WIDTH = math.radians(30.0)
# Less than this part of the tilt that is expected is no movement of the neck.
_MOVED = 0.25
# The mean angles must be known to this part of what is seen.
_NOISE = 0.35


@dataclass(frozen=True, slots=True)
class JogResult:
    """What a jog showed.

    Attributes:
        motor: 1 to 3; node: its drive.
        amplitude: [rad], both ways.
        expected, seen: (pitch, roll) for the way up [rad]: half of what changes from the lower end to the upper.
        noise: standard error of `seen` [rad].
        turned: what the motor's own encoder says that it moved, both ways together [rad].
        verdict: "ok", "wrong sign", "other motor?", "no movement", "unclear" or "stopped".
        advice: what to do, "" where it holds.
        ended: how the run on the drives ended.
    """

    motor: int
    node: int
    amplitude: float
    expected: tuple[float, float]
    seen: tuple[float, float]
    noise: float
    turned: float
    verdict: str
    advice: str
    ended: RunEnd

    @property
    def holds(self) -> bool:
        """Whether the motor pulls where it should."""
        return self.verdict == "ok"

    def require(self) -> None:
        """Raise CheckFailedError unless it does."""
        if self.verdict == "stopped":
            self.ended.require()
        if not self.holds:
            raise CheckFailedError(f"motor {self.motor} (node {self.node}): {self.verdict}. {self.advice}")

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives jog`."""

        def way(angles: tuple[float, float]) -> dict[str, float | None]:
            pitch, roll = angles
            size = math.hypot(pitch, roll)
            direction = math.degrees(math.atan2(roll, pitch)) % 360.0 if size > 0.0 else None
            return {
                "pitch_deg": math.degrees(pitch),
                "roll_deg": math.degrees(roll),
                "tilt_deg": math.degrees(size),
                "direction_deg": direction,
            }

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
    tendon_angles: tuple[float, float, float],
    amplitude: float = 0.5,
    report: Callable[[float], None] | None = None,
) -> JogResult:
    """Pull the tendon of one motor a little, let it out as much, and look where the neck goes.

    The drives must be zeroed; the same pre-flight, ramps, supervisor, limits and watches as in a run.

    Args:
        motor: 1, 2 or 3 of the drives file.
        session: on which drives.
        tendon_angles: psi_1..3 of the neck file [rad]: P > 0 tilts towards (cos psi, sin psi) in (pitch, roll).
        amplitude: of the motor [rad].
        report: called now and then with the done fraction.

    Raises:
        SettingsError: no such motor, an amplitude that is too small, or one beyond the limits of the drives file.
        CheckFailedError: the pre-flight failed; nothing moved.
    """
    require_whole("motor", motor, 1, 3)
    require_between("--amplitude", amplitude, LEAST, MOST, "rad")
    limits = session.file.limits
    if amplitude > limits.position:
        raise SettingsError(f"--amplitude {amplitude:g} is beyond the {limits.position:g} rad of the drives file.")
    fastest = 0.5 * math.pi * amplitude / _WAY
    if fastest > limits.speed:
        raise SettingsError(
            f"--amplitude {amplitude:g} moves at up to {fastest:.2g} rad/s; the drives file allows {limits.speed:g}."
        )
    path, stands = _path(amplitude)
    log = SignalLog(len(path), session=session)

    def tell(*cycle: Any) -> None:
        master = cycle[4]
        if report is not None and master.ran and master.index % 25 == 0:
            report(master.index / len(path))

    facts = {**session.facts, "jog": {"motor": motor, "amplitude": amplitude}}
    session = replace(session, watches=(log, tell, *session.watches), facts=facts)
    ended = run_session(session, jog_pilot(motor, amplitude), sample_time=SAMPLE_TIME, most=len(path) * SAMPLE_TIME)
    expected = amplitude * session.file.watch.gain * cmath.exp(1j * tendon_angles[motor - 1])
    node = session.file.nodes[motor - 1]
    if log.rows < len(path):
        nothing = (math.nan, math.nan)
        verdict, advice = _stopped(ended, motor)
        return JogResult(motor, node, amplitude, (expected.real, expected.imag), nothing, math.nan, math.nan, verdict,
                      advice, ended)  # fmt: skip
    columns = log.columns()
    angles = columns["pitch"] + 1j * columns["roll"]
    seen, noise = _response(angles, stands)
    position = columns[f"motor_position_{motor}"]
    up, down = stands[1], stands[3]
    turned = float(position[up].mean() - position[down].mean())
    verdict, advice = judge(seen, noise, expected, tendon_angles, motor)
    if verdict == "no movement" and turned < amplitude:
        advice = f"The motor itself turned by {turned:.2f} of {2.0 * amplitude:g} rad: is it blocked? {advice}"
    return JogResult(motor, node, amplitude, (expected.real, expected.imag), (seen.real, seen.imag), noise, turned,
                  verdict, advice, ended)  # fmt: skip


def jog_pilot(motor: int, amplitude: float) -> SignalPilot:
    """Return what moves one motor up and down by `amplitude` [rad]."""
    path, _ = _path(amplitude)
    set_points = np.zeros((len(path), 3))
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


def _path(amplitude: float) -> tuple[Vector, tuple[slice, ...]]:
    """Return rest, up, rest, down, rest as set-points of the motor, and over which samples angles are averaged."""
    way, stand, mean = (round(value / SAMPLE_TIME) for value in (_WAY, _STAND, _MEAN))
    levels = (0.0, amplitude, 0.0, -amplitude, 0.0)
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
    seen: complex, noise: float, expected: complex, tendon_angles: tuple[float, float, float], motor: int
) -> tuple[str, str]:
    """Return verdict and advice for a tilt `seen` (pitch + i roll, for the way up) where `expected` should be.

    The nearest of six directions (each tendon pulled, or let out) says which tendon moved, and which way.
    """
    size = abs(seen)
    if not math.isfinite(size):
        return "unclear", "The inclinometer gave no angles."
    if noise > _NOISE * max(size, abs(expected)):
        return "unclear", (
            f"The inclinometer is noisier ({math.degrees(noise):.1f} deg) than what is to be seen "
            f"({math.degrees(abs(expected)):.1f} deg); look at it, or raise --amplitude."
        )
    if size < _MOVED * abs(expected):
        return "no movement", "Is its tendon attached and tight (`softneck drives zero`)? Is the inclinometer fixed?"
    ways = {(number, sign): cmath.exp(1j * angle) * sign
            for number, angle in enumerate(tendon_angles, start=1) for sign in (1, -1)}  # fmt: skip
    gaps = {key: abs(cmath.phase(seen / (abs(seen) * way))) for key, way in ways.items()}
    number, sign = min(gaps, key=lambda key: gaps[key])
    direction = f"it tilts towards {math.degrees(cmath.phase(seen)) % 360.0:.0f} deg"
    if gaps[motor, 1] <= _WIDTH:
        return "ok", ""
    if number == motor:
        return "wrong sign", (
            f"A positive move lets the tendon out: {direction}. Change `reversed` of this drive; where all three "
            "motors show this, the inclinometer is mounted turned."
        )
    turned = "" if sign > 0 else ", turning the wrong way"
    return "other motor?", (
        f"It moves the neck as motor {number} would{turned}: {direction}. Exchange the node numbers in the drives "
        "file; where all three motors are off by the same angle, the inclinometer is mounted turned."
    )
