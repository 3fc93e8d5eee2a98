# ruff: noqa: ARG002
"""Parts for studies in other processes: a lag that can sleep, fail, or kill its process. Copied beside loop files."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from softneck.core import DataError
from softneck.runtime import Port

SETPOINTS = tuple(Port(name=f"motor_setpoint_{j}", unit="rad") for j in (1, 2, 3))


class Lag:
    """Pitch follows motor 1 by y+ = pole y + gain u."""

    role, sample_time = "plant", 0.02
    inputs = SETPOINTS
    outputs = tuple(Port(name=name, unit="rad") for name in ("pitch", "roll"))
    parameters = tuple(Port(name=name) for name in ("pole", "gain", "sleep", "fails", "deadly", "once"))

    def start(self, time_s, parameters):
        p = {"pole": 0.9, "gain": 0.05, **parameters}
        time.sleep(p.get("sleep", 0.0))
        if p.get("fails", 0.0) > 0.5:
            raise DataError("the lag was told\nto fail")
        marker = Path(__file__).with_name("died")
        if p.get("deadly", 0.0) > 0.5 or (p.get("once", 0.0) > 0.5 and not marker.exists()):
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        self.pole, self.gain, self.y = p["pole"], p["gain"], 0.0
        return np.zeros(2)

    def advance(self, time_s, inputs):
        self.y = self.pole * self.y + self.gain * float(inputs[0])
        return np.array([self.y, 0.0])

    def close(self):
        pass


class Gain:
    """Motor 1 = gain times the error of pitch."""

    role, sample_time = "controller", 0.02
    inputs = tuple(Port(name=name, unit="rad") for name in ("pitch_reference", "pitch"))
    outputs = SETPOINTS
    parameters = (Port(name="gain"),)

    def start(self, time_s, parameters):
        self.gain = parameters.get("gain", 4.0)
        return np.zeros(3)

    def advance(self, time_s, inputs):
        return np.array([self.gain * float(inputs[0] - inputs[1]), 0.0, 0.0])

    def close(self):
        pass
