"""What the tests of predictive control share: necks and sizes."""

from __future__ import annotations

import math

import control
import numpy as np

from softneck.design import MpcController
from softneck.design.predictive._mpc_state_runtime import MpcArrays
from softneck.estimation import LinearNeck
from softneck.runtime import load_runtime

from ..oracles.bake_off import bake_off_samples

TS = 0.02
GAIN = math.radians(27.691) / 5.293
POLE = math.exp(-5.293 * TS)
# The block's solver ends at 1e-10 rad; a loop adds up to 1e3 of its roundings.
SOLVED = 1e-7


class Samples(LinearNeck):
    """A neck with samples, as a family has them."""

    def samples(self, output: str) -> list[control.TransferFunction]:
        return bake_off_samples()[output]


class Neck:
    """Two first-order axes with dead time behind motors that follow at once."""

    def __init__(self, controller: MpcController, *, gain: float = 1.0, load: float = 0.0, **parameters: float) -> None:
        self.controller, self.gain, self.load = controller, gain, load
        self.block = controller.block()
        self.state = self.block.initial_state(**parameters)
        self.y, self.motors, self.line = np.zeros(2), np.zeros(3), [np.zeros(2)] * 5
        self.inputs = np.array([port.start for port in self.block.inputs])

    def step(self, pitch: float, roll: float = 0.0, **others: float) -> np.ndarray:
        names = [port.name for port in self.block.inputs]
        self.inputs[:2], self.inputs[3:5], self.inputs[5:8] = (pitch, roll), self.y, self.motors
        for name, value in others.items():
            self.inputs[names.index(name)] = value
        # As a loop does it: a block does not look at what comes.
        values, out = self.state.values.copy(), np.zeros(3)
        load_runtime(self.block.runtime).step(self.block.arrays, self.state.parameters, values, self.inputs, out)
        self.state = type(self.state)(values, self.state.parameters, out)
        v = (MpcArrays(self.controller.arrays).T @ out)[:2] + self.load
        self.line = [*self.line[1:], v]
        self.y = POLE * self.y + (1.0 - POLE) * self.gain * GAIN * self.line[0]
        self.motors = out
        return out
