"""Loop gain and delay between sensor and controller: the output is the reference plus g times the error.

At rest on the reference nothing changes, so the loop keeps its operating point whatever its gain.
"""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, value


class LouderArrays(Arrays):
    """Channels: angles, and rates where they are measured."""

    axis = array("n", "of each channel: which gain and delay it gets")
    length = array("1", "samples that are kept: the longest delay and one")
    kept = value("length", 0)


class LouderState(StateVector):
    """Past errors of each channel."""

    error = cells("n, kept", "measured less reference, newest first")


def initialise(p: LouderArrays, parameters: np.ndarray, x: LouderState, outputs: np.ndarray) -> None:
    """Start with zero errors."""
    x[:] = 0.0
    outputs[:] = 0.0


def step(p: LouderArrays, parameters: np.ndarray, x: LouderState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample.

    inputs: what is measured, then the references. parameters: gain of each axis, then its delay [samples].
    """
    half = parameters.shape[0] // 2
    for c in range(p.n):
        axis = int(p.axis[c])
        held = x.error[c]
        for j in range(p.kept - 1, 0, -1):
            held[j] = held[j - 1]
        held[0] = inputs[c] - inputs[p.n + c]
        # Between two samples a straight line: at a tenth of the sampling rate that is 1.6 % short, and no later.
        whole = int(parameters[half + axis])
        part = parameters[half + axis] - whole
        late = held[whole]
        if part > 0.0:
            late += part * (held[whole + 1] - held[whole])
        outputs[c] = inputs[p.n + c] + parameters[axis] * late
