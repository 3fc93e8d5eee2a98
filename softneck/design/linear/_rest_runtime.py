"""How a controller starts that keeps no numbers of its plant in its state."""

import numpy as np


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Start with motors at rest; the first step takes over where they really are."""
    state[:] = 0.0
    outputs[:] = 0.0
