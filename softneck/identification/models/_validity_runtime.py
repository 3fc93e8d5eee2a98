"""The output `validity`: the probability that the error of a simulation stays within a tolerance.

    outside = max(|D z - o|^2 - 1, 0),    doubt = max over the outputs of v + slope outside + agreement s^2
    validity = 1 / (1 + doubt)

z are the motors, and the motors after a low-pass of a second of a neck: a training with quick moves only does not cover
a slow one through the same positions. o and D (`ground`) describe the region of z in training, s is the spread of
members; v, slope and agreement (`doubt`) are variances over the tolerance squared. The probability is that of an error
with heavy tails, P(|e| < t) = t^2 / (t^2 + var), as errors far from the training are not Gaussian.
"""

import numpy as np

from softneck.runtime._layout import Arrays, array, value
from softneck.runtime._rest_runtime import REST

# Low-pass of the motors: a time constant of 50 samples, 1 s of a neck.
GROUND_RATE = 0.02


def ground_motors(ground: np.ndarray) -> int:
    """Return the number of motors."""
    return (ground.shape[1] - 1) // 2


class GroundArrays(Arrays):
    """The first arrays of every identified plant."""

    ground = array("ways, parts", "o, then D, which is lower triangular; no rows: it is not known")
    doubt = array("outputs, 3", "v, slope and agreement of each output")
    motors = value("ground", function=ground_motors, written=True)


def ground_outside(p: GroundArrays, motors: np.ndarray, slow: np.ndarray) -> float:
    """Update `slow`, the low-passed motors (motors,), and return `outside`."""
    for j in range(p.motors):
        slow[j] = (slow[j] + GROUND_RATE * (motors[j] - slow[j]) + REST) - REST
    squared = 0.0
    for i in range(p.motors):
        along = -p.ground[i, 0]
        for j in range(i + 1):
            along += p.ground[i, 1 + j] * motors[j]
        squared += along * along
    for i in range(p.motors):
        along = -p.ground[p.motors + i, 0]
        for j in range(p.motors):
            along += p.ground[p.motors + i, 1 + j] * motors[j]
        for j in range(i + 1):
            along += p.ground[p.motors + i, 1 + p.motors + j] * slow[j]
        squared += along * along
    return max(squared - 1.0, 0.0)
