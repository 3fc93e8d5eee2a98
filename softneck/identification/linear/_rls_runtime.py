"""ARX over the redefined inputs, one axis beside the other (Eq. 23)."""

import numpy as np

from softneck.identification.linear._arx_runtime import ArxArrays, arx_output
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_observe
from softneck.identification.models._narx_runtime import initialise as initialise


def step(p: ArxArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):  # SISO models: Eq. 9-11 leave each axis its own input
        ahead[axis] = arx_output(p, p.redefinition, p.a[axis], p.b[axis], int(p.delay[axis]), x, axis)
    narx_forward(p, parameters, x, ahead, outputs)
