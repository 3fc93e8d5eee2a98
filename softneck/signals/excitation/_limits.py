"""What a drive and a winch allow: limits on set-points, and ramps from rest and back."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector

from ._signals import Excitation

# Rounding of sums of steps of a few rad: what differs by less obeys.
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPointLimits:
    """Bounds on every motor's set-point; infinite: none.

    Attributes:
        position: largest size of a set-point [rad]; 6 in the paper (section 3.1).
        speed: largest change between samples by the sample time [rad/s].
        slack: how far a winch may pay out below rest, the size of the lowest set-point [rad]: a tendon that is paid
            out further than the neck's motion takes up goes slack and may leave its winch.
    """

    position: float = 6.0
    speed: float = math.inf
    slack: float = math.inf

    def __post_init__(self) -> None:
        _require_bound("position", self.position, "rad", zero=False)
        _require_bound("speed", self.speed, "rad/s", zero=False)
        _require_bound("slack", self.slack, "rad", zero=True)

    @property
    def lowest(self) -> float:
        """Return the lowest set-point allowed [rad]."""
        return -min(self.position, self.slack)


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """Shares of the samples (of all three motors, 0 to 1) that `prepare` changed, by the rule that did it.

    Attributes:
        ramp: faded in or out.
        position: clipped at the largest size.
        slack: clipped at the largest pay-out.
        speed: moved because the motor would have been too fast.
    """

    ramp: float = 0.0
    position: float = 0.0
    slack: float = 0.0
    speed: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds, in %."""
        return {
            "ramped_pct": 100 * self.ramp,
            "position_clipped_pct": 100 * self.position,
            "slack_clipped_pct": 100 * self.slack,
            "rate_limited_pct": 100 * self.speed,
        }

    def __str__(self) -> str:
        said = {"ramped": self.ramp, "clipped in position": self.position, "clipped in slack": self.slack,
                "limited in speed": self.speed}  # fmt: skip
        # Two digits, and a hundred as one.
        parts = [f"{float(f'{100 * share:.2g}'):g} % {what}" for what, share in said.items() if share > 0]
        return ", ".join(parts) or "unchanged"


def prepare(
    excitation: Excitation, limits: SetPointLimits | None = None, *, ramp_s: float = 0.0
) -> tuple[Excitation, Changes]:
    """Return an excitation that drives may play, and what was changed; a pure function.

    In this order:

    1. *Ramp*: a signal that does not start at rest (P = 0) is multiplied by `(1 - cos(pi t / ramp_s)) / 2` over its
       first `ramp_s`; one that does not end at rest by the same, mirrored, over its last.
    2. *Position and slack*: set-points are clipped to `[-min(position, slack), position]`.
    3. *Speed*: from the first sample on, each set-point moves towards the wanted one by at most `speed * T`
       (a slew-rate limiter). With a ramp the end is rest, so that from where it is needed on, set-points stay below
       what can still return at that speed.

    Samples that obey come back bit for bit; preparing twice changes nothing more.

    Args:
        excitation: to prepare.
        limits: None for none.
        ramp_s: time from and to rest [s]; 0 for no ramps.

    Raises:
        SettingsError: a ramp that is negative or longer than half of the signal.
    """
    wanted = np.asarray(excitation.set_points, dtype=np.float64)
    if wanted.size == 0:
        return excitation, Changes()
    ramped = _ramp(wanted, excitation.sample_time, ramp_s)
    clipped, P = ramped, ramped
    shares = {"ramp": _share(ramped, wanted)}
    if limits is not None:
        clipped = np.clip(ramped, limits.lowest, limits.position)
        shares |= {
            "position": float(np.mean(np.abs(ramped) > limits.position)),
            # Where both bounds cut, the tighter one counts.
            "slack": float(np.mean(ramped < -limits.slack)) if limits.slack < limits.position else 0.0,
        }
        if limits.slack < limits.position:
            shares["position"] = float(np.mean(ramped > limits.position))
        P = _slew(clipped, limits.speed * excitation.sample_time, to_rest=ramp_s > 0)
        shares["speed"] = _share(P, clipped)
    return replace(excitation, set_points=P), Changes(**shares)


def _ramp(P: Matrix, sample_time: float, ramp_s: float) -> Matrix:
    """Return set-points (time, 3) that start and end at rest."""
    if not (math.isfinite(ramp_s) and ramp_s >= 0.0):
        raise SettingsError(f"`ramp_s` must be 0 or positive [s]; got {ramp_s:g}.")
    rows = math.ceil(ramp_s / sample_time - 1e-9)
    if rows == 0 or not (P[0].any() or P[-1].any()):
        return P
    if 2 * rows > len(P):
        raise SettingsError(
            f"a ramp of {ramp_s:g} s in and out needs a signal of {2 * ramp_s:g} s; this one has "
            f"{len(P) * sample_time:g} s. Shorten the ramp or lengthen the signal."
        )
    rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(rows) / rows)
    ramped = P.copy()
    if P[0].any():
        ramped[:rows] *= rise[:, None]
    if P[-1].any():
        ramped[len(P) - rows :] *= rise[::-1, None]
    return ramped


def _slew(P: Matrix, step: float, *, to_rest: bool) -> Matrix:
    """Return set-points (time, 3) that move by at most `step` [rad] a sample, and end at rest if asked to."""
    limited = np.column_stack([_slew_one(P[:, j], step) for j in range(P.shape[1])])
    if not to_rest or not np.isfinite(step):
        return limited
    # Steps summed backwards from rest: min and max of signals that obey obey too.
    reach = np.concatenate([np.cumsum(np.full(len(P) - 1, step))[::-1], [0.0]])[:, None]
    return np.clip(limited, -reach, reach)


def _slew_one(wanted: Vector, step: float) -> Vector:
    if wanted.size < 2 or np.abs(np.diff(wanted)).max() <= step + _ROUNDING:
        return wanted
    values = wanted.tolist()
    for k in range(1, len(values)):
        move = values[k] - values[k - 1]
        if abs(move) > step + _ROUNDING:
            values[k] = values[k - 1] + math.copysign(step, move)
    return np.array(values)


def _share(changed: Matrix, before: Matrix) -> float:
    return float(np.mean(changed != before))


def _require_bound(name: str, value: float, unit: str, *, zero: bool) -> None:
    if math.isnan(value) or value < 0 or (value == 0 and not zero):
        rule = "0 or positive" if zero else "positive"
        raise SettingsError(f"`{name}` must be {rule} [{unit}]; got {value:g}.")
