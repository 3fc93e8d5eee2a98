"""State and rest of a plant that remembers histories only (see `_histories_runtime`)."""

import numpy as np

from softneck.identification.models._histories_runtime import narx_advance as narx_advance
from softneck.identification.models._histories_runtime import narx_observe as narx_observe
from softneck.identification.models._histories_runtime import narx_regressor as narx_regressor
from softneck.identification.models._histories_runtime import narx_rest, narx_size


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return narx_size(arrays)


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(arrays, parameters, state, outputs)
