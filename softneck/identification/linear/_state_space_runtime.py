"""A linear state space with an observer gain, around where its robot rests.

    x(k+1) = A x(k) + B u(k - delay) + K (y(k) - offset - C x(k)),    y = C x + offset,    C x = the first states

The first states are the outputs minus the offset. States take the place of the histories of outputs of other kinds
(n <= outputs H).
"""

import numpy as np

from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_forward,
    narx_known,
    narx_push,
    narx_rest,
)
from softneck.runtime._layout import array
from softneck.runtime._rest_runtime import REST


class StateSpaceArrays(NarxArrays):
    """Matrices over motors as they are, without redefinition."""

    A = array("n, n", "")
    B = array("n, motors", "of the motors")
    K = array("n, outputs", "of what measurements are above the first states")
    delay = array("2", "dead time [samples], and source: 1 takes motor positions for u, 0 set-points")
    offset = array("outputs", "outputs where states and inputs are zero; none in the file of a robot that rests there")


def initialise(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(p, parameters, x, outputs)
    for j in range(p.H):
        for axis in range(p.outputs):
            x.y[j, axis] -= p.offset[axis]


def step(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    # Not `narx_observe`: `x.y` holds the states here, and no output is pushed into it.
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[: p.motors])
    narx_push(x.m, x.motors)
    states = x.y
    # Zero in a simulation, where the present outputs are the first states.
    e = np.empty(p.outputs)
    for axis in range(p.outputs):
        e[axis] = x.angles[axis] - p.offset[axis] - states[axis]
    # A new array, as every row needs all old states.
    ahead = np.zeros(p.n)
    # Motor positions are stored H samples after the set-points.
    back = int(p.delay[0]) + p.H * int(p.delay[1])
    for i in range(p.n):
        value = 0.0
        for axis in range(p.outputs):
            value += p.K[i, axis] * e[axis]
        for j in range(p.n):
            value += p.A[i, j] * states[j]
        for j in range(p.motors):
            value += p.B[i, j] * x.u[back, j]
        ahead[i] = (value + REST) - REST
    states[: p.n] = ahead
    for axis in range(p.outputs):
        ahead[axis] += p.offset[axis]
    narx_forward(p, parameters, x, ahead, outputs)
