"""A controller with a model of its drives, for simulators that do not connect motor positions.

Member 0 is the controller. It limits the distance of its set-points u from the motor positions, and its anti-windup
uses this limit, so it needs the motor positions. If the last parameter does not select the inputs, each position is
modelled by

    m(k+1) = a m(k) + (1 - a) u(k+1-d):

the position loop and the latency of a drive without load.
"""

import numpy as np

from softneck.identification.models._histories_runtime import narx_push
from softneck.runtime._layout import Arrays, StateVector, array, cells, rest, value
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.runtime._rest_runtime import REST


def drives_first(drive: np.ndarray) -> int:
    """Return the index of the first motor position among the inputs; 5, as for a neck, if not given."""
    return int(drive[2]) if drive.shape[0] > 2 else 5


def drives_motors(drive: np.ndarray) -> int:
    """Return the number of motors; 3, as for a neck, if not given."""
    return int(drive[3]) if drive.shape[0] > 2 else 3


class DrivesArrays(Arrays):
    """Parameters of the drives, equal for all; the arrays of the controller follow."""

    drive = array(
        "numbers", "a, d of m(k+1) = a m(k) + (1 - a) u(k+1-d), d at least 1; first input and motors, if not 5, 3"
    )
    d = value("drive", 1)
    first = value("drive", function=drives_first)
    motors = value("drive", function=drives_motors)


class DrivesState(StateVector):
    """State of the modelled drives; the controller's state follows."""

    started = cells("", "1 from the first step on")
    m = cells("motors", "modelled motor positions of now [rad]")
    u = cells("d, motors", "set-points, newest first [rad]")
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

    parameters: those of the controller, and whether to use the inputs as motor positions (0 or 1).
    """
    if x.started == 0.0:
        # Start at the connected positions; unconnected ones are 0, at rest.
        x.m[:] = inputs[p.first : p.first + p.motors]
        for i in range(p.d):
            x.u[i] = inputs[p.first : p.first + p.motors]
        x.started = 1.0
    own = parameters.shape[0] - 1
    given = inputs.copy()
    if parameters[own] <= 0.5:
        given[p.first : p.first + p.motors] = x.m
    member_step(p, 0, parameters[:own], x.controller, given, outputs)
    narx_push(x.u, outputs)
    for j in range(p.motors):
        x.m[j] = (p.drive[0] * x.m[j] + (1.0 - p.drive[0]) * x.u[p.d - 1, j] + REST) - REST
