"""Grey box of one payload, that of its recordings."""

import numpy as np

from softneck.identification.structured._neck_equations_runtime import (
    GreyBoxArrays,
    GreyBoxState,
    greybox_rest,
    greybox_step,
)


def initialise(p: GreyBoxArrays, parameters: np.ndarray, x: GreyBoxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the neck settled; the start's difference to the equations is kept as a measured error."""
    greybox_rest(p, p.neck, parameters, x, outputs)


def step(p: GreyBoxArrays, parameters: np.ndarray, x: GreyBoxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    greybox_step(p, p.neck, parameters, x, inputs, outputs)
