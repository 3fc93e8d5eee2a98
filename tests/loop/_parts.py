"""Small parts that the loop tests connect: written out by hand, no runtime module behind them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.runtime import Port

SETPOINTS = tuple(Port(name=f"motor_setpoint_{j}", unit="rad") for j in (1, 2, 3))
POSITIONS = tuple(Port(name=f"motor_position_{j}", unit="rad") for j in (1, 2, 3))


def ports(*names: str, missing: bool = False) -> tuple[Port, ...]:
    return tuple(Port(name=name, unit="rad", missing=missing) for name in names)


class FunctionPart:
    """A part out of a function (state, inputs) -> outputs; `state` is a list it may change."""

    def __init__(
        self,
        role: str,
        inputs: tuple[Port, ...],
        outputs: tuple[Port, ...],
        function: Callable[[list[float], Vector], list[float]],
        sample_time: float = 0.02,
    ) -> None:
        self.role, self.inputs, self.outputs, self.sample_time = role, inputs, outputs, sample_time
        self._function = function
        self._state: list[float] = []
        self.calls: list[tuple[float, Vector]] = []
        self.closed = 0

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:  # noqa: ARG002
        if parameters:
            raise SettingsError(f"`{next(iter(parameters))}` is not a parameter of {self.role}.")
        self._state, self.calls = [], []
        return np.zeros(len(self.outputs))

    def advance(self, time: float, inputs: Vector) -> Vector:
        self.calls.append((time, inputs.copy()))
        return np.array(self._function(self._state, inputs))

    def close(self) -> None:
        self.closed += 1


def lag_plant(
    *, a: float = 0.9, b: float = 0.05, sample_time: float = 0.02, extra: tuple[Port, ...] = ()
) -> FunctionPart:
    """Pitch follows motor 1, roll motor 2, each by y+ = a y + b u; motors follow at once."""

    def advance(state: list[float], u: Vector) -> list[float]:
        if not state:
            state.extend([0.0, 0.0])
        state[0] = a * state[0] + b * float(u[0])
        state[1] = a * state[1] + b * float(u[1])
        return [state[0], state[1], *map(float, u[:3])]

    return FunctionPart("plant", SETPOINTS + extra, ports("pitch", "roll") + POSITIONS, advance, sample_time)


def p_controller(*, gain: float = 1.0, sample_time: float = 0.02) -> FunctionPart:
    """Motor 1 = gain x pitch error, motor 2 = gain x roll error."""

    def advance(state: list[float], u: Vector) -> list[float]:
        return [gain * float(u[0] - u[2]), gain * float(u[1] - u[3]), 0.0]

    inputs = ports("pitch_reference", "roll_reference", "pitch", "roll")
    return FunctionPart("controller", inputs, SETPOINTS, advance, sample_time)


def relay_observer(*, sample_time: float = 0.02) -> FunctionPart:
    """Pass the measured angles on, and remember what set-points came."""

    def advance(state: list[float], u: Vector) -> list[float]:
        return [float(u[3]), float(u[4]), 1.0]

    inputs = SETPOINTS + ports("pitch_measured", "roll_measured", missing=True)
    outputs = (*ports("pitch", "roll"), Port(name="healthy", boolean=True))
    return FunctionPart("observer", inputs, outputs, advance, sample_time)
