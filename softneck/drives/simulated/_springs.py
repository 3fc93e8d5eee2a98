"""A simple plant for robots without a virtual plant: motors on springs, outputs by the robot's directions.

It tests drives, master and sensor in every fault, and is no model of the robot's own dynamics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_positive
from softneck.plant import NeckParameters
from softneck.plant._index_runtime import (
    NECK_CURRENT_LIMIT,
    NECK_GEAR_EFFICIENCY,
    NECK_GEAR_RATIO,
    NECK_TORQUE_CONSTANT,
)
from softneck.plant._mechanics_runtime import neck_drive
from softneck.runtime import load_functions

from ._drives import Sample, SimulatedDrives, SimulatedSettings
from ._servo_runtime import SERVO_POSITION, SERVO_SCALE, SERVO_ZERO
from ._springs_runtime import SPRING_DRIVE, SPRING_PER_AMPERE, SPRING_REST, SPRING_SIZE, SPRING_STIFFNESS

# Increase of a tendon's pull from rest to the end of its range, relative to rest; and share of the spare motor torque
# that it may use.
_MORE, _SPARE = 0.4, 0.8
# Slack of the winches before `drives commission --only zero` [rad].
_SLACK_RAD = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SpringSettings:
    """Settings of the springs and of the measured outputs.

    Attributes:
        outputs: names of the measured outputs.
        weights: (outputs, motors), static gains from motors to outputs [rad/rad].
        pole: of the outputs' first-order lag [1/s].
        reach: largest size of each motor's set-point [rad].
        torque_constant, efficiency: of motors and gears [N m/A].
        current_limit: of each motor [A].
        winch_radius: [m].
        pretension_current: which holds a tendon at P = 0 [A].
        noise_std: of the sensor [rad]; without noise it would count as frozen.
    """

    outputs: tuple[str, ...]
    weights: Matrix
    reach: tuple[float, ...]
    current_limit: tuple[float, ...]
    pole: float
    torque_constant: float
    efficiency: float
    winch_radius: float
    pretension_current: float
    noise_std: float

    def __post_init__(self) -> None:
        if self.weights.shape != (len(self.outputs), len(self.reach)):
            raise SettingsError(f"`weights` must be outputs x motors; got shape {self.weights.shape}.")
        require_positive("noise_std", self.noise_std, "rad")


class SimulatedSprings(SimulatedDrives):
    """Springs with their drives and sensor, in place of a `SimulatedNeck`.

    Attributes:
        outputs: (2, outputs) true values [rad] and rates [rad/s].
    """

    def __init__(self, springs: SpringSettings, settings: SimulatedSettings) -> None:
        """Start at rest; drives are without power, and tendons are slack unless homed."""
        latency = NeckParameters.paper().drive_latency
        super().__init__(settings, current_limit=springs.current_limit[0], latency=latency)
        self._springs = springs
        count = len(settings.nodes)
        self._winches: Matrix = np.zeros((4, count))
        self._winches[3] = 1.0
        if not settings.homed:
            self._winches[0], self._winches[3] = -_SLACK_RAD, 0.0
            # Encoders start at zero at power-on.
            self.motion[:, SERVO_ZERO] = self.motion[:, SERVO_SCALE] * _SLACK_RAD
            self.motion[:, SERVO_POSITION] = 0.0
        self._table = np.array([_spring(springs, settings.gear[row], row) for row in range(count)])
        self.outputs: Matrix = np.zeros((2, len(springs.outputs)))
        self._functions: ModuleType = load_functions("softneck.drives.simulated._springs_runtime")
        self._share = 1.0 - math.exp(-springs.pole * self.h)
        self._noise = np.random.default_rng(settings.seed)
        nothing = (0.0,) * len(springs.outputs)
        self.newest = self._last = Sample(0.0, nothing, nothing, valid=True)

    def set(self, **disturbance: float) -> None:
        """Refuse disturbances, as springs take no load. Raises SettingsError: a disturbance that is not zero."""
        for name, value in disturbance.items():
            if value:
                raise SettingsError(f"`{name}`: simulated drives that turn springs take no load; leave it out.")

    def move(self) -> None:
        """Advance by one bus cycle."""
        self._functions.springs_ticks(
            self._table, self._springs.weights, self._share, self._winches, self.outputs, self.motion, self.ring,
            self.ticks, self.h,
        )  # fmt: skip

    def _measure(self) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
        noise: Vector = self._noise.normal(0.0, self._springs.noise_std, len(self._springs.outputs))
        return tuple((self.outputs[0] + noise).tolist()), tuple(self.outputs[1].tolist()), True

    def truth(self) -> Mapping[str, float]:
        """Return outputs [rad] and tensions [N] by name."""
        tensions = (self._winches[2] / self._springs.winch_radius).tolist()
        values = dict(zip(self._springs.outputs, self.outputs[0].tolist(), strict=True))
        return values | {f"tension_{j}": value for j, value in enumerate(tensions, start=1)}


def _spring(springs: SpringSettings, gear: float, row: int) -> Vector:
    """Return the row of the table for one motor; values that are not given are the paper's."""
    motor = NeckParameters.paper().vector()
    motor[NECK_GEAR_RATIO], motor[NECK_CURRENT_LIMIT] = gear, springs.current_limit[row]
    motor[NECK_TORQUE_CONSTANT], motor[NECK_GEAR_EFFICIENCY] = springs.torque_constant, springs.efficiency
    values = np.zeros(SPRING_SIZE)
    per_ampere = springs.torque_constant * gear * springs.efficiency
    rest, most = per_ampere * springs.pretension_current, per_ampere * springs.current_limit[row]
    more = min(_MORE * rest, _SPARE * max(0.0, most - rest))
    values[SPRING_PER_AMPERE], values[SPRING_REST] = per_ampere, rest
    values[SPRING_STIFFNESS] = more / springs.reach[row]
    values[SPRING_DRIVE:] = neck_drive(motor)
    return values
