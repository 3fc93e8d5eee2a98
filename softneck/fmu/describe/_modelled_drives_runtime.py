"""A controller beside a model of its drives, for simulators that do not connect motor positions.

Member 0 is the controller. It limits how far its set-points u are ahead of the motors, and its anti-windup follows
from what that takes away; so it must know where the motors are. Unless the last parameter says that the inputs tell
it, each is

    m(k+1) = a m(k) + (1 - a) u(k+1-d):

the position loop and the latency of a drive that carries nothing.
"""

import numpy as np

from softneck.identification.models._histories_runtime import narx_push
from softneck.runtime._layout import Arrays, StateVector, array, cells, rest, value
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.runtime._rest_runtime import REST


class DrivesArrays(Arrays):
    """The drives, all alike; the arrays of the controller follow."""

    drive = array("2", "a and d of m(k+1) = a m(k) + (1 - a) u(k+1-d), d at least 1")
    d = value("drive", 1)


class DrivesState(StateVector):
    """Where the modelled motors are; the controller's state follows."""

    started = cells("", "1 from the first step on")
    motors = cells("3", "modelled motor positions of now [rad]")
    u = cells("d, 3", "set-points, newest first [rad]")
    controller = rest("state of the controller")


def state_size(p: DrivesArrays) -> int:
    """Return the length of the state vector."""
    return DrivesState.size(p) + member_size(p, 0)


def initialise(p: DrivesArrays, parameters: np.ndarray, x: DrivesState, outputs: np.ndarray) -> None:
    """Start as the controller does."""
    x[:] = 0.0
    own = parameters.shape[0] - 1
    member_initialise(p, 0, parameters[:own], x.controller, outputs)


def step(p: DrivesArrays, parameters: np.ndarray, x: DrivesState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Step the controller, then the drives; ports as of the controller.

    parameters: those of the controller, and whether its motor positions are the inputs (0 or 1).
    """
    if x.started == 0.0:
        # Connected positions say where the motors begin; without them it is at rest, 0.
        x.motors[:] = inputs[5:8]
        for i in range(p.d):
            x.u[i] = inputs[5:8]
        x.started = 1.0
    own = parameters.shape[0] - 1
    given = inputs.copy()
    if parameters[own] <= 0.5:
        given[5:8] = x.motors
    member_step(p, 0, parameters[:own], x.controller, given, outputs)
    narx_push(x.u, outputs)
    for j in range(3):
        x.motors[j] = (p.drive[0] * x.motors[j] + (1.0 - p.drive[0]) * x.u[p.d - 1, j] + REST) - REST
