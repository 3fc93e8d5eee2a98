"""One linear difference equation (Eq. 23) over the histories of `_histories_runtime`, and its arrays."""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState
from softneck.runtime._layout import array


class ArxArrays(NarxArrays):
    """Eq. 23 of each output."""

    redefinition = array("c, motors", "T of Eq. 9-11: motors to redefined inputs")
    a = array("outputs, na", "of the outputs, newest first")
    b = array("outputs, nb", "of the redefined inputs, newest first")
    delay = array("outputs", "dead time of each axis [samples]")


def arx_output(
    p: NarxArrays, redefinition: np.ndarray, a: np.ndarray, b: np.ndarray, delay: int, x: NarxState, axis: int
) -> float:
    """Return y(k+1) = -a y(k+1-i) + b u(k+1-delay-j) of one axis; `a` (na,) and `b` (nb,) may be empty.

    Motor positions are stored H samples after the set-points: a delay of H more reads positions.
    """
    y = 0.0
    for i in range(a.shape[0]):
        y -= a[i] * x.y[i, axis]  # Eq. 23 has its a with a minus
    for j in range(b.shape[0]):
        # Eq. 9 or 10 of u(k+1-delay-j).
        redefined = 0.0
        for motor in range(p.motors):
            redefined += redefinition[axis, motor] * x.u[delay + j, motor]
        y += b[j] * redefined
    return y
