"""Run a controller's own runtime with many linear plants, one after the other, in sequential order.

Set-points act on the plant one sample after the angle they were computed from, plus its delay. Motors follow their
set-points at once.
"""

import numpy as np

from softneck.runtime._layout import Arrays, array
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.runtime._products_runtime import product
from softneck.verification._linear_plant_runtime import axis_advance


class SweepArrays(Arrays):
    """Arrays between controller and plants; the arrays of the controller follow."""

    T = array("references, motors", "of Eq. 9-11: motors to redefined inputs")


def sweep_run(
    p: SweepArrays,
    parameters: np.ndarray,
    start: np.ndarray,
    places: np.ndarray,
    outputs_at: np.ndarray,
    numerator: np.ndarray,
    denominator: np.ndarray,
    delay: np.ndarray,
    mixed: np.ndarray,
    signals: np.ndarray,
    angles: np.ndarray,
    motors: np.ndarray,
) -> None:
    """Run every plant; fill `angles` (n, time, axes) and `motors` (n, time, motors).

    start: default values of the controller's inputs.
    places: index there of the references, angles, motors, healthy, enabled; -1 for none.
    outputs_at: (motors + 1,) index of the set-points in its outputs, then the number of all outputs.
    numerator, denominator (n, axes, q), delay (n, axes), mixed (n, axes, axes): of the plants.
    signals: (time, 3 axes + 1) references, the last of co-contraction, noise of all angles, load on all inputs.
    """
    n, m, q = numerator.shape[0], numerator.shape[1], numerator.shape[2]
    rows, count = signals.shape[0], outputs_at.shape[0] - 1
    state = np.empty(member_size(p, 0))
    inputs = start.copy()
    outputs = np.zeros(outputs_at[count])
    values = np.empty(places.shape[0])
    held = np.zeros(count)
    for i in range(n):
        member_initialise(p, 0, parameters, state, outputs)
        x = np.zeros((m, q))
        u = np.zeros((rows, m))  # inputs v of all rows: a delay is an index back
        held[:] = 0.0
        for k in range(rows):
            values[: m + 1] = signals[k, : m + 1]
            for axis in range(m):
                # Sequential: the controller sees the angle of t_k before its set-points move the plant on to t_k+1.
                angles[i, k, axis] = x[axis, 0]
                values[m + 1 + axis] = x[axis, 0] + signals[k, m + 1 + axis]
            values[2 * m + 1 : 2 * m + 1 + count] = held
            # Healthy and enabled.
            values[2 * m + 1 + count :] = 1.0
            for j in range(places.shape[0]):
                if places[j] >= 0:
                    inputs[places[j]] = values[j]
            member_step(p, 0, parameters, state, inputs, outputs)
            for j in range(count):
                held[j] = outputs[outputs_at[j]]
                motors[i, k, j] = held[j]
            tilt = product(p.T, held)
            for axis in range(m):
                total = tilt[axis]
                for other in range(m):
                    if other != axis:
                        total += mixed[i, axis, other] * tilt[other]
                u[k, axis] = total + signals[k, 2 * m + 1 + axis]
            for axis in range(m):
                row = k - delay[i, axis]  # before the run the plant was at rest
                axis_advance(x[axis], numerator[i, axis], denominator[i, axis], u[row, axis] if row >= 0 else 0.0)
