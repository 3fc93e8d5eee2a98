"""What linear state spaces share: their arrays, and what they take in.

States stand where other kinds keep their histories of outputs (n <= outputs H).
"""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState, narx_known, narx_push
from softneck.runtime._layout import array


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
