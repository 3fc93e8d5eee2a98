"""A model in free run beside the loop, and cumulative sums over what it misses."""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import KALMAN_LAG
from softneck.estimation._nonlinear_parts_runtime import nonlinear_faster, nonlinear_move, nonlinear_settle
from softneck.estimation.changes._change_parts_runtime import ChangeArrays, ChangeCells, change_period, change_see
from softneck.runtime._layout import rest
from softneck.runtime._members_runtime import member_size


class ChangeState(ChangeCells):
    """As all detectors have it; the model's state follows."""

    model = rest("state of the model")


def state_size(p: ChangeArrays) -> int:
    """Return the length of the state vector."""
    return ChangeState.size(p) + member_size(p, 0)


def initialise(p: ChangeArrays, parameters: np.ndarray, x: ChangeState, outputs: np.ndarray) -> None:
    """Start where nothing is known; the first sample tells where the motors stand."""
    x[:] = 0.0
    outputs[:] = 0.0


def step(p: ChangeArrays, parameters: np.ndarray, x: ChangeState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Move the model on, score what it misses, and tell.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: changed, since_s, fit.
    """
    n, m = p.motors, p.outputs
    asked, measured = inputs[:n], inputs[n : n + m]
    if x.samples == 0.0:
        x.held[:] = asked
        nonlinear_settle(p, p.free, x.model, asked, x.angles)
    before = x.angles.copy()
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_move(p, p.free, x.model, x.held, x.angles)
    else:
        nonlinear_move(p, p.free, x.model, asked, x.angles)
    x.held[:] = asked
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    usable = float(inputs[n + m]) > 0.5
    for i in range(m):
        usable = usable and math.isfinite(measured[i])
    if usable:
        change_see(p, x, measured)
    change_period(p, x)
    outputs[0] = x.changed
    outputs[1] = x.since
    outputs[2] = x.fit
