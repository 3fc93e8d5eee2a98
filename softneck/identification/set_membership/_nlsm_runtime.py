"""Set membership (Eq. 18-20, Algorithm 1), alone or on a linear base.

An empty base is the paper's Eq. 21, fed back what it puts out. With one, the histories hold the base's outputs: what
the set adds to them is never fed back, and what is measured moves the base alone.
"""

import numpy as np

from softneck.identification.linear._arx_runtime import arx_output
from softneck.identification.models._feedforward_runtime import echo_rest
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_observe, narx_regressor
from softneck.identification.set_membership._nlsm_parts_runtime import (
    NlsmArrays,
    nlsm_query,
    nlsm_rest,
)
from softneck.identification.set_membership._nlsm_parts_runtime import nlsm_query_slopes as nlsm_query_slopes


def initialise(p: NlsmArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    nlsm_rest(p, parameters, x, outputs)
    # Of another robot than a neck the base is zero at rest and the outputs need not be: the set adds where they are.
    if p.nb > 0 and p.c == p.outputs:
        for axis in range(p.outputs):
            total = 0.0
            for k in range(p.rows):
                total += p.values[axis, k]
            echo_rest(p, x, axis, total / p.rows)


def step(p: NlsmArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the bounds of the outputs follow the motor positions in `outputs`."""
    narx_observe(p, parameters, x, inputs)
    regressor = np.empty(p.n)
    ahead = np.empty(p.outputs)
    bounds = p.outputs + p.motors
    for axis in range(p.outputs):
        narx_regressor(p, p.table, x, axis, regressor)  # Eq. 21, or the lags asked for
        w = regressor * p.scale
        low, high = nlsm_query(p, axis, p.bounds[axis, 1], w)
        # Without a base a and b are empty and this is zero.
        base = arx_output(p, p.redefinition, p.a[axis], p.b[axis], int(p.delay[axis]), x, axis)
        # The central estimate (Eq. 18).
        middle = 0.5 * (low + high)
        ahead[axis] = base + middle
        outputs[bounds + 2 * axis] = base + low
        outputs[bounds + 2 * axis + 1] = base + high
        # `narx_observe` takes this off again: with a base the histories hold the base alone.
        if p.nb > 0:
            x.added[axis] = middle
    narx_forward(p, parameters, x, ahead, outputs)
