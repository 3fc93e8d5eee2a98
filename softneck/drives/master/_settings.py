"""Settings of the master: limits, sensor, watches, ramps. `drives.toml` fills them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from softneck.core import ReprMixin, require_between, require_whole

from ..supervision._baseline import Baseline
from ._fieldbus import BusSettings


def setting(key: str, default: float, least: float, most: float) -> Any:
    """Return the dataclass field of a number with name `key` in the drives file; default and range are in SI."""
    return field(default=default, metadata={"key": key, "range": (least, most)})


def factor_of(key: str) -> float:
    """Return the factor from a number in the drives file to SI."""
    return math.radians(1.0) if key.endswith("_deg") else 1.0


class Ranged:
    """Base of settings that checks the ranges of their numbers."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for item in fields(self):  # pyright: ignore[reportArgumentType]
            if "range" in item.metadata:
                key, unit = item.metadata["key"], factor_of(item.metadata["key"])
                least, most = item.metadata["range"]
                require_between(key, getattr(self, item.name) / unit, least / unit, most / unit)


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitSettings(Ranged):
    """Limits of set-points, beyond which they are clamped.

    Attributes:
        position: |P| of each motor [rad].
        speed: [rad/s].
        acceleration: [rad/s^2].
        tension: of a tendon, estimated from the motor's current [N]; above 80 % of it the tendon may not be pulled
            further, above it for 150 ms the run stops.
        slack: tension below which a tendon is slack [N].
        slack_unwind: how far a slack tendon may still be let out, in addition to the motion of the outputs [rad].
    """

    position: float = setting("position_rad", 6.0, 0.01, 100.0)
    speed: float = setting("speed_rad_s", 15.6, 0.01, 100.0)
    acceleration: float = setting("acceleration_rad_s2", 1000.0, 0.1, 1e5)
    tension: float = setting("tension_N", 12.0, 0.1, 200.0)
    slack: float = setting("slack_N", 0.2, 0.0, 50.0)
    slack_unwind: float = setting("slack_unwind_rad", 3.0, 0.0, 20.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchSettings(Ranged):
    """Tolerances between model and measurement; beyond one for 150 ms the run stops.

    Attributes:
        following: motor against set-point [rad].
        tilt: measured angle against the one computed from the motors' positions [rad].
        gain: static tilt for one radian of theta_i or phi_i (Eq. 31: 0.483/5.293).
        pole: of that first-order model [1/s] (Eq. 31).
        pushed: pushing force of a tendon during the ramp in, above which its motor has the wrong sign [N]; friction of
            gear and sheaths does not reach it at the ramp's speed.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    following: float = setting("following_rad", 1.5, 0.01, 20.0)
    tilt: float = setting("tilt_deg", math.radians(12.0), 0.01, 1.6)
    gain: float = setting("gain", 0.483 / 5.293, 0.001, 2.0)
    pole: float = setting("pole_per_s", 5.293, 0.1, 100.0)
    pushed: float = setting("pushed_N", 0.5, 0.05, 200.0)
    tendon_angles: tuple[float, float, float] = (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)

    @property
    def weights(self) -> tuple[tuple[float, ...], ...]:
        """The neck's directions, pitch and roll by its tendons (2, motors)."""
        angles = self.tendon_angles
        return tuple(math.cos(angle) for angle in angles), tuple(math.sin(angle) for angle in angles)


@dataclass(frozen=True, slots=True, kw_only=True)
class RampSettings(Ranged):
    """Settings of the ramps at the start and the end of a run.

    `speed`: of ramps [rad/s]. `settle`: waiting time at the end of a ramp [s]. `tolerance`: of the motors to their rest
    there [rad].
    """

    speed: float = setting("speed_rad_s", 1.0, 0.01, 10.0)
    settle: float = setting("settle_s", 1.0, 0.0, 60.0)
    tolerance: float = setting("tolerance_rad", 0.05, 1e-3, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelSettings:
    """Properties of the robot for the master.

    `outputs`: names of the measured outputs. `weights`: (outputs, motors), each output's direction; () if still to be
    identified, in which case motors and outputs are not compared; None: those of the neck, by its tendons' angles.
    `ranges`: of each motor: lowest and highest set-point [rad], largest speed [rad/s].
    """

    outputs: tuple[str, ...]
    weights: tuple[tuple[float, ...], ...] | None
    ranges: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MasterSettings(ReprMixin):
    """All settings of the master: bus, limits, inclinometer, watches, ramps.

    Attributes:
        counts_per_radian: of each winch, with sign.
        zero_counts: counts at the zero of P, of all motors or of each (1: the mark of a homed drive, see `softneck
            drives commission --only zero`).
        newton_per_unit: tension for one unit of each drive's current, with sign.
        sample_cycles: bus cycles for one sample of the controller.
        angle: largest plausible measurement [rad].
        bus, limits, watch, ramps: see their classes.
        channels: of the robot; None: the neck, with no limits but `limits`.
        baseline: of undisturbed motion, for the plausibility checks; None: no such checks.
    """

    counts_per_radian: tuple[float, ...]
    newton_per_unit: tuple[float, ...] = (0.0, 0.0, 0.0)
    zero_counts: int | tuple[int, ...] = 1
    sample_cycles: int = 2
    angle: float = 1.2
    bus: BusSettings = field(default_factory=BusSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    watch: WatchSettings = field(default_factory=WatchSettings)
    ramps: RampSettings = field(default_factory=RampSettings)
    channels: ChannelSettings | None = None
    baseline: Baseline | None = None

    def __post_init__(self) -> None:
        require_whole("sample_cycles", self.sample_cycles, 1, 20)
        require_between("angle", self.angle, 0.1, 1.6, "rad")

    @property
    def zeros(self) -> tuple[int, ...]:
        """Counts at the zero of P, one for each motor."""
        zero = self.zero_counts
        return (zero,) * len(self.counts_per_radian) if isinstance(zero, int) else zero

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the measured outputs."""
        return ("pitch", "roll") if self.channels is None else self.channels.outputs
