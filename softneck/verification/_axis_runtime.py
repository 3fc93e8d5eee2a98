"""One axis of a linear plant, a transfer function as its observable form: in loops and in sweeps."""

import numpy as np


def axis_advance(x: np.ndarray, numerator: np.ndarray, denominator: np.ndarray, u: float) -> None:
    """Advance by one sample under the input `u`; x[0] is the angle, the last entry stays zero.

    numerator, denominator: as long as x, highest power of z first; they begin with 0 and 1.
    """
    y = x[0]
    # Observable form: x[j] is what past inputs and outputs still do to the angle j samples from now.
    for j in range(x.shape[0] - 1):
        x[j] = x[j + 1] - denominator[j + 1] * y + numerator[j + 1] * u
