"""ARX over the redefined inputs, one axis beside the other (Eq. 23)."""

import numpy as np

from softneck.identification.linear._arx_runtime import ArxArrays, arx_output
from softneck.identification.models._histories_runtime import NarxState, narx_advance, narx_observe
from softneck.identification.models._narx_runtime import initialise as initialise


def step(p: ArxArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    # Two SISO models: Eq. 9-11 leave each axis its own input.
    pitch = arx_output(p, p.redefinition, p.a[0], p.b[0], int(p.delay[0]), x, 0)
    roll = arx_output(p, p.redefinition, p.a[1], p.b[1], int(p.delay[1]), x, 1)
    narx_advance(p, parameters, x, pitch, roll, outputs)
