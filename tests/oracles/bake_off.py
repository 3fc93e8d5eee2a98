"""The bake-off: one axis, a step and a load on every plant of an uncertain family, for controllers of any kind."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import control
import numpy as np

from softneck.core import DataError, SettingsError, Vector, require_one_of
from softneck.design.plants._uncertain import (
    ModelUncertainty,
    StepAndLoad,
    StepAndLoadResult,
    UncertainPlant,
    judge,
    uncertain_plant,
)
from softneck.estimation import AxisPlant, LinearNeck
from softneck.estimation._axis import AXES
from softneck.robot import Robot
from softneck.runtime import Block
from softneck.signals import TENDON_ANGLES, redefinition_matrix

# Reference and angle [rad] in, redefined input theta_i [rad] out; called once a sample.
Step = Callable[[float, float], float]
# A controller at rest, new for every plant.
StepFactory = Callable[[], Step]

_NUMERATOR = math.radians(27.691)  # Eq. 31 [rad/s per rad]
_POLE = 5.293  # Eq. 31 [1/s]
_SCALES = (0.6, 0.8, 1.0, 1.2, 1.4)
_DELAYS = (3, 4, 5)


def bake_off_plant(
    numerator: float = 1.0, pole: float = 1.0, delay: int = 4, *, sample_time: float = 0.02
) -> AxisPlant:
    """Return Eq. 31's pitch, `exp(-0.08 s) 27.691/(s + 5.293)` deg/rad, with factors on its numerator and pole.

    Args:
        numerator, pole: factors.
        delay: whole samples, besides the one that the held input costs.
        sample_time: [s].
    """
    p = pole * _POLE
    a = math.exp(-p * sample_time)
    return AxisPlant(np.array([numerator * _NUMERATOR / p * (1.0 - a)]), np.array([1.0, -a]), delay, sample_time)


def bake_off_plants() -> tuple[AxisPlant, ...]:
    """Return the 75 plants: numerator and pole x {0.6 .. 1.4}, delay {3, 4, 5} samples; the 38th is nominal."""
    return tuple(bake_off_plant(k, p, d) for d in _DELAYS for k in _SCALES for p in _SCALES)


def bake_off_samples() -> dict[str, list[control.TransferFunction]]:
    """Return those plants as samples of both axes, the nominal one first: what a design takes."""
    plants = bake_off_plants()
    ordered = [plants[len(plants) // 2], *plants[: len(plants) // 2], *plants[len(plants) // 2 + 1 :]]
    return {axis: [plant.tf() for plant in ordered] for axis in ("pitch", "roll")}


def bake_off_neck() -> LinearNeck:
    """Return the nominal plant as both axes of a neck."""
    nominal = bake_off_plant().tf()
    return LinearNeck(pitch=nominal, roll=nominal)


def exact(source: Any, *, robot: Robot | None = None, spread: float = 0.2) -> UncertainPlant:
    """Return a plant as it is: no dead time and no pole of the paper's neck are allowed for besides."""
    return replace(uncertain_plant(source, robot), uncertainty=ModelUncertainty(0.0, 0.0, spread))


def neck_within(position: float = 6.0, slew: float = 12.5, *, lowest: float = -6.0) -> Robot:
    """Return a neck whose file says so of its motors [rad, rad/s]."""
    neck = Robot.preset("neck")
    motors = replace(neck.motors, setpoint_min=(lowest,) * 3, setpoint_max=(position,) * 3, rate_limit=(slew,) * 3)
    return replace(neck, motors=motors)


def run_bake_off(
    factory: StepFactory, plants: Sequence[AxisPlant] | None = None, test: StepAndLoad | None = None
) -> StepAndLoadResult:
    """Run a controller on every plant, from rest; the true angle is fed back without noise or further delay.

    Args:
        factory: returns a controller at rest, `step(reference, angle) -> theta_i`.
        plants: of the test's sample time; by default the 75.
        test: by default a step of 10 deg.
    """
    asked = test or StepAndLoad()
    chosen = tuple(plants) if plants is not None else bake_off_plants()
    if not chosen:
        raise DataError("the bake-off needs at least one plant.")
    runs = [_run(factory(), plant, asked) for plant in chosen]
    angles, inputs = (np.array(part) for part in zip(*runs, strict=True))
    return judge(angles, inputs, asked, len(chosen) // 2 if plants is None else 0)


def block_stepper(block: Block, test: StepAndLoad | None = None, *, axis: str = "pitch") -> StepFactory:
    """Return how the bake-off steps a controller's block: its motors follow at once, its limits are the test's.

    A controller limits its motors; the redefined input is limited alike where the motor that moves most reaches its
    own limit: 2/3 of theta_i, 0.577 of phi_i (Eq. 9 and 10). Blocks whose limits are no parameters keep theirs.
    """
    asked = test or StepAndLoad()
    T = redefinition_matrix(TENDON_ANGLES)
    require_one_of("axis", axis, AXES)
    i = AXES.index(axis)
    share = float(np.abs(np.linalg.inv(T)[:, i]).max())
    names = [port.name for port in block.inputs]
    limits = {
        "position_limit": share * asked.position_limit,
        "slew_limit": share * asked.slew_limit / asked.sample_time,
    }
    if not math.isclose(block.sample_time, asked.sample_time, rel_tol=1e-9):
        raise SettingsError(
            f"the controller runs every {block.sample_time:g} s, the bake-off every {asked.sample_time:g} s; "
            "design it on a model of that sample time."
        )
    known = {port.name for port in block.parameters}
    i_reference, i_angle = names.index(f"{axis}_reference"), names.index(axis)
    i_motor = names.index("motor_position_1")

    def factory() -> Step:
        state = block.initial_state(**{key: value for key, value in limits.items() if key in known})
        inputs = np.array([port.start for port in block.inputs])

        def step(reference: float, angle: float) -> float:
            nonlocal state
            inputs[i_reference], inputs[i_angle] = reference, angle
            state, motors = block.step(state, inputs)
            inputs[i_motor : i_motor + 3] = motors
            return float(T[i] @ motors)

        return step

    return factory


def _run(step: Step, plant: AxisPlant, test: StepAndLoad) -> tuple[Vector, Vector]:
    """Return angles and limited inputs (time,) of one run."""
    if not math.isclose(plant.sample_time, test.sample_time, rel_tol=1e-9):
        raise SettingsError(f"a plant's sample time is {plant.sample_time:g} s; the test's is {test.sample_time:g} s.")
    A, B, _ = plant.observable_form()
    first = plant.order == 1
    a, b = float(A[0, 0]), float(B[0])
    x, line = np.zeros(plant.order), deque([0.0] * plant.delay)
    angles, inputs = np.zeros(test.rows), np.zeros(test.rows)
    y, held = 0.0, 0.0
    for k in range(test.rows):
        wanted = min(max(step(test.reference, y), held - test.slew_limit), held + test.slew_limit)
        held = min(max(wanted, -test.position_limit), test.position_limit)
        angles[k], inputs[k] = y, held
        line.append(held + (test.load if k >= test.load_row else 0.0))
        if first:
            y = a * y + b * line.popleft()
        else:
            x = A @ x + B * line.popleft()
            y = float(x[0])
    return angles, inputs
