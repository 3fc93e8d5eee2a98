"""Rest of a plant that remembers histories only (see `_histories_runtime`)."""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState, narx_rest


def initialise(p: NarxArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(p, parameters, x, outputs)
