"""A controller's own runtime against many linear plants, one after the other, as in a loop of sequential order.

Set-points act on the plant's input one sample later than the angle that they were computed from was read, plus its
delay; motors are where they were told to be.
"""

import numpy as np

from softneck.runtime._layout import Arrays, array
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.verification._axis_runtime import axis_advance


class SweepArrays(Arrays):
    """What stands between controller and plants; the arrays of the controller follow."""

    T = array("3, 3", "of Eq. 9-11: motors to redefined inputs")


def sweep_run(
    p: SweepArrays,
    parameters: np.ndarray,
    start: np.ndarray,
    places: np.ndarray,
    outputs_at: np.ndarray,
    numerator: np.ndarray,
    denominator: np.ndarray,
    delay: np.ndarray,
    cross: np.ndarray,
    signals: np.ndarray,
    angles: np.ndarray,
    motors: np.ndarray,
) -> None:
    """Run every plant; fill `angles` (n, time, 2) and `motors` (n, time, 3).

    start: the controller's inputs where nobody sets them.
    places: (10,) where in them stand the three references, both angles, three motors, healthy, enabled; -1: nowhere.
    outputs_at: (3,) where the set-points stand in its outputs, and their number behind them.
    numerator, denominator (n, 2, q), delay (n, 2), cross (n, 2): of the plants.
    signals: (time, 7) pitch, roll and co-contraction reference, noise of both angles, load on both plants' inputs.
    """
    n, rows, q = numerator.shape[0], signals.shape[0], numerator.shape[2]
    state = np.empty(member_size(p, 0))
    inputs = start.copy()
    outputs = np.zeros(outputs_at[3])
    values = np.empty(10)
    held = np.zeros(3)
    for i in range(n):
        member_initialise(p, 0, parameters, state, outputs)
        x = np.zeros((2, q))
        u = np.zeros((rows, 2))  # inputs v of all rows: a delay is an index back
        held[:] = 0.0
        for k in range(rows):
            values[:3] = signals[k, :3]
            for axis in range(2):
                # Sequential: the controller sees the angle of t_k before its set-points move the plant on to t_k+1.
                angles[i, k, axis] = x[axis, 0]
                values[3 + axis] = x[axis, 0] + signals[k, 3 + axis]
            values[5:8] = held
            # Healthy and enabled.
            values[8:] = 1.0
            for j in range(10):
                if places[j] >= 0:
                    inputs[places[j]] = values[j]
            member_step(p, 0, parameters, state, inputs, outputs)
            for j in range(3):
                held[j] = outputs[outputs_at[j]]
                motors[i, k, j] = held[j]
            tilt = np.dot(p.T, held)
            u[k, 0] = tilt[0] + cross[i, 0] * tilt[1] + signals[k, 5]
            u[k, 1] = tilt[1] + cross[i, 1] * tilt[0] + signals[k, 6]
            for axis in range(2):
                row = k - delay[i, axis]  # before the run the plant was at rest
                axis_advance(x[axis], numerator[i, axis], denominator[i, axis], u[row, axis] if row >= 0 else 0.0)
