"""Transfer functions over the redefined inputs; a simulation feeds their own outputs back."""

import numpy as np

from softneck.identification.linear._arx_runtime import ArxArrays, arx_output
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_observe
from softneck.identification.models._narx_runtime import initialise as initialise
from softneck.runtime._layout import array


class OeArrays(ArxArrays):
    """Arrays of Eq. 23, and the source of u."""

    source = array("1", "1 takes motor positions for u, 0 set-points")


def step(p: OeArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        # Motor positions are stored H samples after the set-points, so source 1 reads them by a longer delay.
        delay = int(p.delay[axis]) + p.H * int(p.source[0])
        ahead[axis] = arx_output(p, p.redefinition, p.a[axis], p.b[axis], delay, x, axis)
    narx_forward(p, parameters, x, ahead, outputs)
