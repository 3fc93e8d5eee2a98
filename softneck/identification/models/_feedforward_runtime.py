"""Parts of kinds without output feedback: the noise model (array `echo`), and drives that stall under load, or valves.

The histories (see `_histories_runtime`) hold the outputs minus the kind's own part f, which is never fed back:
y(k+1) = f(k+1) + sum_i echo_i (y - f)(k+1-i). In a simulation the sum decays.
"""

import numpy as np

from softneck.identification.models._bank_runtime import drive_advance, drive_limit, valve_advance
from softneck.identification.models._histories_runtime import NarxArrays, NarxState


def echo_rest(p: NarxArrays, x: NarxState, axis: int, f: float) -> None:
    """Fill the history with the start minus `f`, as if measured at rest."""
    x.added[axis] = f
    for j in range(p.H):
        x.y[j, axis] -= f


def echo_added(p: NarxArrays, echo: np.ndarray, x: NarxState, axis: int, f: float) -> float:
    """Return y(k+1) of one axis and store `f`; echo (outputs, p)."""
    total = 0.0
    for i in range(echo.shape[1]):
        total += echo[axis, i] * x.y[i, axis]  # y - f of i + 1 samples before, as `narx_observe` left it
    x.added[axis] = f
    return f + total


def stalling_drives(p: NarxArrays, load: np.ndarray, q: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Advance the motors from the newest of the histories, limited by their load."""
    mean = 0.0
    for j in range(p.motors):
        mean += q[j]
    mean /= p.motors
    for j in range(p.motors):
        d = int(p.drive[j, 1])
        if d > 0:
            # In place of the lag of `narx_forward`, which knows no load and has moved `x.motors` on already.
            if load.shape[0] > 4:
                x.motors[j] = valve_advance(load, x.u[d - 1, j], x.m[0, j])
            else:
                x.motors[j] = drive_advance(p.drive[j, 0], x.u[d - 1, j], x.m[0, j], drive_limit(load, q[j], mean))
            outputs[p.outputs + j] = x.motors[j]
