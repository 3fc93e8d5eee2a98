"""What linear state spaces share: their arrays, what they take in, and their next states.

States stand where other kinds keep their histories of outputs (n <= outputs H).
"""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState, narx_known, narx_push
from softneck.runtime._layout import array
from softneck.runtime._rest_runtime import REST


class StateSpaceArrays(NarxArrays):
    """Matrices over motors as they are, without redefinition."""

    A = array("n, n", "")
    B = array("n, motors", "of the motors")
    K = array("n, outputs", "of what measurements are above the first states")
    delay = array("2", "dead time [samples], and source: 1 takes motor positions for u, 0 set-points")


def lss_observe(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray) -> None:
    """Take in what is known at t_k: outputs and motors, measured where they are, and the histories of u and m."""
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[: p.motors])
    narx_push(x.m, x.motors)


def lss_next(p: StateSpaceArrays, x: NarxState, e: np.ndarray, ahead: np.ndarray) -> None:
    """Fill `ahead` (n,) with the next states; e (outputs,) is what measurements are above the first of them."""
    states = x.y
    # Motor positions stand H samples of all motors behind set-points.
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
