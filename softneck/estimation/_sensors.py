"""Inclinometers and their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

from softneck.core import SettingsError


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """An inclinometer.

    Attributes:
        name: what users type.
        noise_std: standard deviation of pitch and of roll at rest [rad].
        gyro_noise_std: standard deviation of its rates from sample to sample [rad/s].
        source: where the numbers come from.
        delay: how late its angles are, with the lag of its filter [s]; None: not known, that of the robot's file holds.
    """

    name: str
    noise_std: float
    gyro_noise_std: float
    source: str
    delay: float | None = None


# Upper ends of what the recordings show on plateaus: a filter that trusts too little lags a little,
# one that trusts too much rejects good samples. Rates were not recorded: data sheet class.
SENSORS: dict[str, SensorNoise] = {
    sensor.name: sensor
    for sensor in (
        SensorNoise(
            "mpu9250",
            math.radians(0.29),
            math.radians(0.1),
            "Arduino with MPU-9250: 0.26 to 0.29 deg on plateaus of the recordings; rates: data sheet class",
        ),
        SensorNoise(
            "3dm-gx5-10",
            math.radians(0.04),
            math.radians(0.05),
            "3DM-GX5-10, 50 Hz: 0.02 to 0.04 deg on plateaus of the recordings; rates: data sheet class",
            delay=0.015,  # 10 ms behind a filter of 5 ms, as the virtual one has
        ),
        SensorNoise(
            "paper", math.radians(0.05), math.radians(0.1), "the virtual neck's inclinometer in the paper preset"
        ),
    )
}


def find_sensor(name: str) -> SensorNoise:
    """Return the sensor of that name; raise SettingsError with the known ones if there is none."""
    try:
        return SENSORS[name]
    except KeyError:
        raise SettingsError(f"unknown sensor `{name}`; use one of {', '.join(SENSORS)}.") from None
