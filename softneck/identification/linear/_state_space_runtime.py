"""A linear state space with an observer gain.

    x(k+1) = A x(k) + B u(k - delay) + K (y(k) - x(k)[:2])

The first two states are pitch and roll. They stand where other kinds keep their histories of outputs (n <= 2H).
"""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState, narx_advance, narx_known, narx_push
from softneck.identification.models._narx_runtime import initialise as initialise
from softneck.runtime._layout import array
from softneck.runtime._rest_runtime import REST


class StateSpaceArrays(NarxArrays):
    """Matrices over motors as they are, without redefinition."""

    A = array("n, n", "")
    B = array("n, 3", "of the three motors")
    K = array("n, 2", "of what measurements are above the first two states")
    delay = array("2", "dead time [samples], and source: 1 takes motor positions for u, 0 set-points")


def lss_observe(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray) -> None:
    """Take in what is known at t_k: outputs and motors, measured where they are, and the histories of u and m."""
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[:3])
    narx_push(x.m, x.motors)


def step(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    # Not `narx_observe`: `x.y` holds the states here, and no output is pushed into it.
    lss_observe(p, parameters, x, inputs)
    states = x.y
    # Motor positions stand H samples of three behind set-points.
    back = int(p.delay[0]) + p.H * int(p.delay[1])
    # Zero in free run: then the angles of now are the first two states.
    e0 = x.angles[0] - states[0]
    e1 = x.angles[1] - states[1]
    # Beside the states, as every row needs all the old ones.
    ahead = np.zeros(p.n)
    for i in range(p.n):
        value = p.K[i, 0] * e0 + p.K[i, 1] * e1
        for j in range(p.n):
            value += p.A[i, j] * states[j]
        for j in range(3):
            value += p.B[i, j] * x.u[back, j]
        ahead[i] = (value + REST) - REST
    states[: p.n] = ahead
    narx_advance(p, parameters, x, ahead[0], ahead[1], outputs)
