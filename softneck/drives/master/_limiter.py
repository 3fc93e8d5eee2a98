"""Limits of set-points: position, speed, acceleration and tension of the tendons."""

from __future__ import annotations

import math

from ._settings import LimitSettings

# Differences below this are rounding [rad].
_ROUNDING_RAD = 1e-9
# Share of the tension limit above which the set-point may not pull further.
_NEAR_LIMIT_SHARE = 0.8


class Limiter:
    """Limiter of the set-point of one motor.

    `value`: set-point [rad]. `speed`: of the set-point [rad/s]. `clamped`: the limit that was active in the last step;
    "" if none.
    """

    __slots__ = ("_aim", "_cycle", "_limits", "_range", "_slack_at", "clamped", "speed", "value")

    def __init__(self, limits: LimitSettings, cycle: float, own: tuple[float, float, float] | None = None) -> None:
        """Start at zero and at rest.

        `limits`: of all motors. `cycle`: of the bus [s]. `own`: limits of this motor: lowest and highest set-point
        [rad], largest speed [rad/s].
        """
        self._limits, self._cycle = limits, cycle
        self._range = own or (-limits.position, limits.position, limits.speed)
        self.value = self.speed = self._aim = 0.0
        self.clamped = ""
        self._slack_at: float | None = None

    def reset(self, value: float) -> None:
        """Set the set-point to `value` [rad], at rest."""
        self.value, self.speed, self.clamped, self._slack_at, self._aim = value, 0.0, "", None, value

    def step(self, wanted: float, tension: float, led: float = 0.0) -> float:
        """Return the set-point of this cycle [rad] on the way to `wanted`; `tension` [N] is estimated.

        If the outputs lean away from a slack tendon, it must be let out as far as they moved: `led` [rad] is the motor
        position that fits the measured outputs.
        """
        limits, T = self._limits, self._cycle
        low, high, fastest = self._range
        # A winch that unwound beyond its range without power returns gradually, without a jump to the limit.
        if self.value < low:
            low = self.value
        elif self.value > high:
            high = self.value
        why = ""
        goal = wanted
        if not low <= goal <= high:
            goal, why = min(max(goal, low), high), "position"
        if tension > _NEAR_LIMIT_SHARE * limits.tension and goal > self.value:
            goal, why = self.value, "tension"
        if tension >= limits.slack:
            self._slack_at = None
        else:
            if self._slack_at is None:
                self._slack_at = self.value - led
            # The limit never pulls beyond the request: if the outputs lean back, letting out ends there.
            floor = min(self._slack_at + led - limits.slack_unwind, self._aim)
            if goal < floor:
                goal, why = floor, "slack"
        self._aim = goal
        way = goal - self.value
        speed = way / T
        # At most the allowed speed, and the speed that can still stop at the goal: v^2 / (2 a) + v T / 2 = way.
        a = limits.acceleration
        most = min(fastest, a * (math.sqrt(0.25 * T * T + 2.0 * abs(way) / a) - 0.5 * T))
        if abs(speed) > most:
            if abs(speed) > fastest * (1.0 + _ROUNDING_RAD):
                why = why or "speed"
            speed = math.copysign(most, speed)
        change = a * T
        if abs(speed - self.speed) > change:
            # Only a request beyond the possible acceleration counts as clamped, not the deceleration to rest at the
            # goal.
            why = why or "acceleration"
            speed = self.speed + math.copysign(change, speed - self.speed)
        self.speed = speed
        self.value = min(max(self.value + T * speed, low), high)
        self.clamped = why if abs(self.value - wanted) > _ROUNDING_RAD else ""
        return self.value
