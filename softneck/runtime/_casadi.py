"""A runtime's `step` as a CasADi function, from the text that numba compiles and C is made of."""

from __future__ import annotations

from typing import Any

import numpy as np

from softneck.core import Vector

from ._block import Block
from ._bundle import bundle
from ._casadi_values import boxed, filled
from ._casadi_walk import Text, Walk


def step_function(block: Block, parameters: Vector, inputs: int) -> Any:
    """Return `casadi.Function` x, u -> x_next, y: one `step` of `block`.

    Args:
        block: whose runtime is walked.
        parameters: numbers, in the block's order.
        inputs: that many are symbols u, the others are not given (NaN).

    Raises:
        SettingsError: the text does what a function of symbols cannot; the message names function and line.
    """
    import casadi as ca

    size = block.initial_state().values.size
    x, u = ca.SX.sym("x", size), ca.SX.sym("u", inputs)
    state = filled(np.empty(size, dtype=object), [x[i] for i in range(size)])
    given = [u[i] for i in range(inputs)] + [np.nan] * (len(block.inputs) - inputs)
    outputs = np.zeros(len(block.outputs)).astype(object)
    arrays = tuple(_fixed(array) for array in block.arrays)
    text = Text(bundle(block.runtime, loops=False))
    Walk(text).call("step", [arrays, _fixed(parameters), state, boxed(np.array(given, dtype=object)), outputs])
    return ca.Function(block.kind, [x, u], [ca.vertcat(*state), ca.vertcat(*outputs)], ["x", "u"], ["x_next", "y"])


def _fixed(array: np.ndarray) -> np.ndarray:
    view = np.asarray(array, dtype=np.float64).view()
    view.flags.writeable = False
    return view
