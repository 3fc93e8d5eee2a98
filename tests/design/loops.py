"""Margins of one loop of python-control, by the function that all designs and verifications use."""

from __future__ import annotations

import control
import numpy as np

from softneck.core import SettingsError, Vector
from softneck.design import Margins, margins_of_loops
from softneck.design.linear._margins import require_stable, sensitivity_of


def loop_margins(loop: control.TransferFunction | control.StateSpace) -> Margins:
    """Return the margins of a discrete scalar open loop, verified to be stable when closed with negative feedback.

    Each is exact to 0.1 %, however lightly damped the loop is. Raises SettingsError: the loop is not discrete and
    scalar, or not stable when closed.
    """
    if not isinstance(loop, control.StateSpace | control.TransferFunction) or (loop.ninputs, loop.noutputs) != (1, 1):
        raise SettingsError("a scalar control.TransferFunction or StateSpace is needed, the open loop.")
    if loop.dt is None or isinstance(loop.dt, bool) or not loop.dt > 0.0:
        raise SettingsError("the open loop must be discrete, with its sample time as dt; `control.c2d` makes it so.")
    if isinstance(loop, control.TransferFunction):
        above, below = (np.trim_zeros(np.asarray(part[0][0], dtype=float), "f") for part in (loop.num, loop.den))
        poles, size = np.roots(np.polyadd(below, above)), max(below.size, above.size) - 1
    else:
        A, B, C, D = (np.asarray(matrix, dtype=float) for matrix in (loop.A, loop.B, loop.C, loop.D))
        poles, size = np.linalg.eigvals(A - B @ C / (1.0 + D[0, 0])), loop.nstates
    require_stable(poles)
    Ts = float(loop.dt)

    def evaluate(_: np.ndarray, w: Vector) -> tuple[np.ndarray, np.ndarray]:
        L = np.asarray(loop(np.exp(1j * w * Ts), squeeze=False))[0, 0]
        return sensitivity_of(L)[:, None], np.zeros((w.size, 0))

    return margins_of_loops(evaluate, poles[None], Ts, size).of(0)
