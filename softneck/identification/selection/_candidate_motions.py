"""Motions that could be recorded next, each from rest to rest within the limits of a robot's motors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.robot import Robot
from softneck.signals import Excitation, SetPointLimits, prepare, signal

# Of what each signal asks for: small motions show friction, large ones what bends.
_SIZES = (0.5, 0.75, 1.0)
# Of the signals' own pace; `rotation`, `aprbs` and `multisine` are as fast as the paper's at 1.
_SPEEDS = (0.5, 1.0, 2.0)
_PLAYED = ("eq22", "aprbs", "multisine", "rotation")
# Parts of `mixed` in which one motor moves at a time, and all alike: from which to which part of its length.
_OF_MIXED = {"single_tendon": (0.88, 0.95), "cocontraction": (0.95, 1.0)}
# How long that is [s]: each part of it is played again and again.
_MIXED = 120.0
# [s] from rest into each motion and back.
RAMP = 1.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Bounds:
    """What set-points may do, in SI.

    Attributes:
        lowest, highest: (motors,) set-points.
        speed: largest change by the time, of any motor.
    """

    lowest: Vector
    highest: Vector
    speed: float

    @classmethod
    def of(cls, robot: Robot, limits: SetPointLimits | None = None) -> Bounds:
        """Return the bounds of a robot, and `limits` within them.

        Raises:
            SettingsError: nothing is left between them.
        """
        motors, scale, inside = robot.motors, to_si(robot.motors.unit)[0], limits or SetPointLimits(position=math.inf)
        count = len(motors.names)
        low, high = (
            scale * np.array(given) if given is not None else np.full(count, side)
            for given, side in ((motors.setpoint_min, -math.inf), (motors.setpoint_max, math.inf))
        )
        speed = min(inside.speed, scale * min(motors.rate_limit) if motors.rate_limit else math.inf)
        low, high = np.maximum(low, inside.lowest), np.minimum(high, inside.position)
        if (low >= high).any():
            j = int(np.argmax(low >= high))
            raise SettingsError(f"motor {j + 1} may move from {low[j]:g} to {high[j]:g} only; widen its limits.")
        return cls(lowest=low, highest=high, speed=speed)

    @property
    def rest(self) -> Vector:
        """Where motors begin and end (motors,): zero, or what is nearest to it."""
        return np.clip(0.0, self.lowest, self.highest)

    def within(self, P: Matrix, sample_time: float) -> Matrix:
        """Return set-points (time, motors) that begin and end at rest and keep the bounds."""
        moved = Excitation("", np.arange(len(P)) * sample_time, np.clip(P, self.lowest, self.highest) - self.rest,
                           sample_time)  # fmt: skip
        return (
            prepare(moved, SetPointLimits(position=math.inf, speed=self.speed), ramp_s=RAMP)[0].set_points + self.rest
        )


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """One motion: a signal, how large and how fast of what it is by itself, and its set-points (time, motors)."""

    signal: str
    size: float
    speed: float
    set_points: Matrix

    def __str__(self) -> str:
        return f"{self.signal}, {self.size:g} of its size at {self.speed:g} times its speed"


def motions(robot: Robot, sample_time: float, rows: int, bounds: Bounds, seed: int) -> list[Motion]:
    """Return motions of `rows` rows each: every signal in every size and speed."""
    found = []
    for name, speed, P in _signals(robot, sample_time, rows, seed):
        found += [Motion(name, size, speed, bounds.within(size * P, sample_time)) for size in _SIZES]
    return found


def _signals(robot: Robot, sample_time: float, rows: int, seed: int) -> Iterator[tuple[str, float, Matrix]]:
    """Yield name, speed and set-points (rows, motors)."""
    # At the sample time of the data, which a robot file need not give.
    robot = replace(robot, sample_time_s=sample_time)
    longest = (rows * max(_SPEEDS) + 1) * sample_time
    mixed = signal("mixed", duration=_MIXED, seed=seed, robot=robot).set_points
    for number, speed in enumerate(_SPEEDS):
        # Slower or faster: read at other instants.
        at = np.arange(rows) * speed
        for name in _PLAYED:
            # Other levels and phases at each speed.
            P = signal(name, duration=longest, seed=seed + number, robot=robot).set_points
            yield name, speed, np.column_stack([np.interp(at, np.arange(len(P)), column) for column in P.T])
        for name, share in _OF_MIXED.items():
            start, stop = (round(part * len(mixed)) for part in share)
            yield name, speed, mixed[start + (at.astype(int) % (stop - start))]
