"""Measurements of the small moves of a commissioning, and their limits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softneck.core import Matrix, Vector, require_between

# What a row was measured in: standing before the moves, on the way through the slack, on the slow way up and down under
# tension, in the quick wiggle, on the way back.
REST, FREE, SWEEP, WIGGLE, BACK = range(5)
# How the search for a tendon ended.
PULLED, HANGS, BLIND = "pulled", "hangs", "no tilt"
# Quick wiggles, and the time of one [s].
WIGGLES, PERIOD = 8, 1.0
# How fast the neck tilts in what is measured, and in the search [rad/s]: within the 0.3 s in which a tilt stops a
# motor, of a sensor that is 0.2 s late too, it is less than a degree also where a gear is half of what was believed.
_SLOW_TILT, _FREE_TILT = math.radians(0.8), math.radians(1.3)
# Of one index pulse [counts]: a quarter of a line to either side, and some for the drive's own delay.
_INDEX_TOLERANCE_COUNTS = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Guards:
    """Limits and lengths of the moves of a commissioning.

    Attributes:
        tilt: beyond this, from where the neck stood before, all drives are stopped [rad].
        target: a tendon is pulled until the neck tilts by this [rad].
        contact: it counts as taut from this on, or from what stands out of the sensor's noise [rad].
        travel: of a winch to either side of where it stood, in the drives file's own radians; tendons are tightened by
            hand before.
        time: for one motor [s].
        speed: of the search through the slack; slow: of all that is measured [rad/s].
        current: limit of the drives [A], by the drives file's scale; None: that of `zero`.
    """

    tilt: float = math.radians(2.2)
    target: float = math.radians(1.1)
    contact: float = math.radians(0.6)
    travel: float = 10.0
    time: float = 240.0
    speed: float = 0.25
    slow: float = 0.15
    current: float | None = None

    @classmethod
    def of(cls, gain: float, **changes: float) -> Guards:
        """Return guards for something that tilts by `gain` [rad/rad]: as slow as it takes to see it in time.

        Twice as fast, where gear or encoder are not those of the file, it must still be seen before it is too far.
        """
        slow, speed = (min(most, tilting / gain) for most, tilting in ((0.15, _SLOW_TILT), (0.25, _FREE_TILT)))
        return cls(**{"speed": speed, "slow": min(slow, speed), **changes})

    def __post_init__(self) -> None:
        require_between("tilt", math.degrees(self.tilt), 0.5, 3.0, "deg")
        require_between("target", math.degrees(self.target), 0.3, 0.8 * math.degrees(self.tilt), "deg")
        require_between("contact", math.degrees(self.contact), 0.1, math.degrees(self.target), "deg")
        require_between("--travel", self.travel, 1.0, 30.0, "rad")
        require_between("time", self.time, 10.0, 3600.0, "s")
        require_between("speed", self.speed, 0.05, 1.0, "rad/s")
        require_between("slow", self.slow, 0.02, self.speed, "rad/s")


@dataclass(frozen=True, slots=True, eq=False)
class MotorMoves:
    """Measurements of one motor's moves.

    Attributes:
        motor: from 1 on; node: of its drive.
        outcome: "pulled", "hangs" (no tendon within the travel), or "no tilt" (it pulls, and the sensor sees nothing).
        way: 1 where it pulls with the counts that the drives file calls positive, -1 against them, 0 not known.
        phase: (rows,) what each row was measured in.
        time: (rows,) [s].
        counts, current: (rows,) of the drive, in its own units.
        outputs: (rows, outputs) of the sensor, as the drives file has its axes [rad]; NaN where no sample came.
        captures: counts at the encoder's index pulses, in the order in which they came.
    """

    motor: int
    node: int
    outcome: str
    way: int
    phase: Vector
    time: Vector
    counts: Vector
    current: Vector
    outputs: Matrix
    captures: tuple[int, ...] = ()

    def rows(self, *phases: int) -> NDArray[np.bool_]:
        """Return which rows were measured in one of `phases`, (rows,) of bool."""
        return np.isin(self.phase, phases)


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """Measurements of all motors' moves.

    `motors`: each motor's. `stopped`: what ended them early, "" if nothing did.
    """

    motors: tuple[MotorMoves, ...]
    stopped: str = ""

    def of(self, motor: int) -> MotorMoves | None:
        """Return those of motor `motor`, from 1 on, if it was moved."""
        return next((moved for moved in self.motors if moved.motor == motor), None)


def counts_per_turn(captures: Sequence[int]) -> int:
    """Return the counts between two index pulses of an encoder, 0 where not two of them came.

    The edges of one pulse lie some counts apart, by the way in which it is passed: those are no turn.
    """
    steps = [abs(b - a) for a, b in itertools.pairwise(captures)]
    return min((step for step in steps if step > _INDEX_TOLERANCE_COUNTS), default=0)
