"""Simulated drives on the virtual neck, or on a robot built like it, with its inclinometer."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot
from softneck.runtime import load_functions, sized_name

from ._drives import Sample, SimulatedDrives, SimulatedSettings
from ._servo_runtime import SERVO_GEARING


class SimulatedNeck(SimulatedDrives):
    """The virtual neck with its drives.

    Attributes:
        outputs: the neck's outputs at the inclinometer's last sample, in the order of its block; of a neck (14,).
        disturbance: payload [kg], pushes [N], tilt of the base [rad]; of a neck (5,).
    """

    def __init__(self, parameters: NeckParameters, settings: SimulatedSettings, robot: Robot | None = None) -> None:
        """Put the neck, or `robot`, at rest; its drives are without power, and `homed` ones have their zero."""
        super().__init__(settings, current_limit=parameters.current_limit, latency=parameters.drive_latency)
        self.parameters = parameters
        robot = Robot.preset() if robot is None else robot
        neck = VirtualNeck(parameters, robot)
        block = neck.block(noise_seed=settings.seed, sample_time=settings.sample_time)
        motors, self._angles = len(robot.motors.names), len(robot.outputs.names)
        self._names = tuple(port.name for port in block.outputs)
        self._disturbances = tuple(port.name for port in block.inputs[motors:])
        start = block.initial_state()
        self._arrays, self._q, self._x = block.arrays, start.parameters, start.values.copy()
        self.outputs: Vector = start.outputs.copy()
        self.disturbance: Vector = np.zeros(len(self._disturbances))
        # A drive with another gear than the neck's pulls with that gear; the inertia stays the neck's.
        self.motion[:, SERVO_GEARING] = np.array(settings.gear) / parameters.gear_ratio
        self._functions: ModuleType = load_functions(
            sized_name("softneck.drives.simulated._servo_runtime", motors, self._angles)
        )
        self._samples = 0
        self.newest = self._last = Sample(0.0, *self._sensor_outputs(), valid=True)

    def set(self, **disturbance: float) -> None:
        """Set payload [kg], push_x, push_y [N], base_tilt_pitch or base_tilt_roll [rad], as far as the neck has them.

        Raises:
            SettingsError: another name.
        """
        for name, value in disturbance.items():
            if name not in self._disturbances:
                raise SettingsError(f"`{name}` is not a disturbance; the neck has {', '.join(self._disturbances)}.")
            self.disturbance[self._disturbances.index(name)] = value

    def move(self) -> None:
        """Advance drives and neck by one bus cycle."""
        self._functions.servo_ticks(self._q, self._x, self.disturbance, self.motion, self.ring, self.ticks, self.h)

    def _sensor_outputs(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the angles of the inclinometer and the rates of its gyro; in `outputs` after the true angles."""
        m = self._angles
        return tuple(self.outputs[m : 2 * m].tolist()), tuple(self.outputs[2 * m : 3 * m].tolist())

    def _measure(self) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
        if self._samples:
            self._functions.winch_sense(self._arrays, self._q, self._x, self.disturbance, self.outputs)
        self._samples += 1
        return *self._sensor_outputs(), bool(self.outputs[3 * self._angles] > 0.5)

    def truth(self) -> Mapping[str, float]:
        """Return the neck's outputs at the last sample by name: true angles, tensions, compression."""
        return dict(zip(self._names, (float(value) for value in self.outputs), strict=True))
