"""Arrays, start and equation of a linear state space with an observer gain, around where its robot rests.

    x(k+1) = A x(k) + B u(k - delay) + K (y(k) - offset - C x(k)),    y = C x + offset,    C x = the first states

The first states are the outputs minus the offset. States take the place of the histories of outputs of other kinds
(n <= outputs H).
"""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState, narx_rest
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


def state_space_ahead(p: StateSpaceArrays, x: NarxState, states: np.ndarray, e: np.ndarray, delay: int) -> np.ndarray:
    """Return the next states (n,) from `states` (n,), the errors `e` (outputs,) and inputs `delay` samples old."""
    # A new array, as every row needs all old states.
    ahead = np.zeros(p.n)
    # Motor positions are stored H samples after the set-points.
    back = delay + p.H * int(p.delay[1])
    for i in range(p.n):
        value = 0.0
        for axis in range(p.outputs):
            value += p.K[i, axis] * e[axis]
        for j in range(p.n):
            value += p.A[i, j] * states[j]
        for j in range(p.motors):
            value += p.B[i, j] * x.u[back, j]
        ahead[i] = (value + REST) - REST
    return ahead
