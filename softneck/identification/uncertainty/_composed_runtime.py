"""What kinds that hold models of any robot share: their sizes, and the median of their members."""

import numpy as np

from softneck.identification.models._validity_runtime import GroundArrays, ground_outside
from softneck.runtime._layout import array, value


def composed_outputs(history: np.ndarray) -> int:
    """Return the number of outputs: the neck's two where none is said."""
    return int(history[1]) if history.shape[0] > 1 else 2


def composed_motors(history: np.ndarray) -> int:
    """Return the number of motors: the neck's three where none is said."""
    return int(history[2]) if history.shape[0] > 2 else 3


class ComposedArrays(GroundArrays):
    """The first arrays of a kind that holds others; those of the members are the last."""

    history = array("sizes", "H: how many samples of each signal are kept; and outputs and motors, if not a neck's")
    memory = array("1", "samples after which a held start has settled")
    outputs = value("history", function=composed_outputs, written=True)
    motors = value("history", function=composed_motors, written=True)


def composed_median(inorder: np.ndarray) -> float:
    """Return the median of numbers in order; of an even number of them the mean of the middle two."""
    count = inorder.shape[0]
    return float(0.5 * (inorder[(count - 1) // 2] + inorder[count // 2]))


def composed_validity(p: GroundArrays, motors: np.ndarray, slow: np.ndarray, spread: np.ndarray) -> float:
    """Return the validity of outputs whose members are apart by `spread` (outputs,); 0 where it is not known."""
    if p.ground.shape[0] == 0:
        return 0.0
    outside = ground_outside(p, motors, slow)
    worst = 0.0
    for axis in range(spread.shape[0]):
        apart = spread[axis]
        worst = max(worst, p.doubt[axis, 0] + p.doubt[axis, 1] * outside + p.doubt[axis, 2] * apart * apart)
    return 1.0 / (1.0 + worst)
