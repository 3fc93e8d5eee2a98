"""Set-points within position, speed, acceleration, and within what the tendons bear."""

from __future__ import annotations

import math

from ._settings import LimitSettings

# Differences below this are rounding [rad].
_SAME = 1e-9
# Pulling is refused from this part of the tension limit on.
_NEAR = 0.8


class Limiter:
    """The set-point of one motor on its way to what is wanted.

    Attributes:
        value: set-point [rad].
        speed: of the set-point [rad/s].
        clamped: whether the last step was limited, and by what ("" if not).
    """

    __slots__ = ("_aim", "_cycle", "_limits", "_range", "_slack_at", "clamped", "speed", "value")

    def __init__(self, limits: LimitSettings, cycle: float, own: tuple[float, float, float] | None = None) -> None:
        """Begin at zero, at rest.

        Args:
            limits: of all motors.
            cycle: of the bus [s].
            own: of this motor: lowest and highest set-point [rad], largest speed [rad/s].
        """
        self._limits, self._cycle = limits, cycle
        self._range = own or (-limits.position, limits.position, limits.speed)
        self.value = self.speed = self._aim = 0.0
        self.clamped = ""
        self._slack_at: float | None = None

    def reset(self, value: float) -> None:
        """Stand still at `value` [rad]."""
        self.value, self.speed, self.clamped, self._slack_at, self._aim = value, 0.0, "", None, value

    def step(self, wanted: float, tension: float, led: float = 0.0) -> float:
        """Return the set-point of this cycle [rad] on the way to `wanted`; `tension` [N] is estimated.

        A tendon that hangs while the outputs lean away from it has to be let out as far as they went: `led` [rad] is
        where they put its motor.
        """
        limits, T = self._limits, self._cycle
        low, high, fastest = self._range
        # A winch that unwound beyond its range without power comes back as it is led: no jump to the edge.
        if self.value < low:
            low = self.value
        elif self.value > high:
            high = self.value
        why = ""
        goal = wanted
        if not low <= goal <= high:
            goal, why = min(max(goal, low), high), "position"
        if tension > _NEAR * limits.tension and goal > self.value:
            goal, why = self.value, "tension"
        if tension >= limits.slack:
            self._slack_at = None
        else:
            if self._slack_at is None:
                self._slack_at = self.value - led
            # Nothing is pulled that nobody asked for: outputs that lean back end the way out where it is.
            floor = min(self._slack_at + led - limits.slack_unwind, self._aim)
            if goal < floor:
                goal, why = floor, "slack"
        self._aim = goal
        way = goal - self.value
        speed = way / T
        # Not faster than allowed, nor than what still stops at the goal: v^2 / (2 a) + v T / 2 = way, in steps of T.
        a = limits.acceleration
        most = min(fastest, a * (math.sqrt(0.25 * T * T + 2.0 * abs(way) / a) - 0.5 * T))
        if abs(speed) > most:
            if abs(speed) > fastest * (1.0 + _SAME):
                why = why or "speed"
            speed = math.copysign(most, speed)
        change = a * T
        if abs(speed - self.speed) > change:
            # Coming to rest at the goal may need no more than it has: only what asks for more is told.
            why = why or "acceleration"
            speed = self.speed + math.copysign(change, speed - self.speed)
        self.speed = speed
        self.value = min(max(self.value + T * speed, low), high)
        self.clamped = why if abs(self.value - wanted) > _SAME else ""
        return self.value
