"""How many outputs and motors a plant that holds others has."""

import numpy as np


def composed_outputs(history: np.ndarray) -> int:
    """Return the number of outputs: the neck's two where none is said."""
    return int(history[1]) if history.shape[0] > 1 else 2


def composed_motors(history: np.ndarray) -> int:
    """Return the number of motors: the neck's three where none is said."""
    return int(history[2]) if history.shape[0] > 2 else 3
