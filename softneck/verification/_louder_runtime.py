"""Loop gain, delay and disturbance between sensor and controller: the reference plus g times the error is passed on.

At rest on the reference nothing changes, so the loop keeps its operating point whatever its gain. The disturbance is
what motions leave over that a model does not explain: `d[k+1] = keep d[k] + share (y[k+1] - y[k]) n[k]`.
"""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._random_runtime import random_normal, random_seed


class LouderArrays(Arrays):
    """Channels: angles, and rates where they are measured."""

    axis = array("n", "of each channel: which gain and delay it gets")
    length = array("1", "samples that are kept: the longest delay and one")
    kept = value("length", 0)


class LouderState(StateVector):
    """Past errors of each channel."""

    random = cells("6", "generator of the disturbance and the noise")
    error = cells("n, kept", "measured less reference, newest first")
    disturbance = cells("n", "what is added to the measured values")
    last = cells("n", "measured values of the sample before")


def initialise(p: LouderArrays, parameters: np.ndarray, x: LouderState, outputs: np.ndarray) -> None:
    """Start with zero errors and no disturbance."""
    x[:] = 0.0
    random_seed(x.random, float(parameters[parameters.shape[0] - 1]))
    outputs[:] = 0.0


def step(p: LouderArrays, parameters: np.ndarray, x: LouderState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample.

    inputs: what is measured, then the references. parameters: gain of each axis, then its delay [samples], then its
    share of the disturbance; keep, standard deviation of the noise, seed. outputs: what is passed on, then the same
    without the noise.
    """
    axes = (parameters.shape[0] - 3) // 3
    keep, noise = parameters[3 * axes], parameters[3 * axes + 1]
    for c in range(p.n):
        axis = int(p.axis[c])
        held = x.error[c]
        for j in range(p.kept - 1, 0, -1):
            held[j] = held[j - 1]
        share = parameters[2 * axes + axis]
        if share > 0.0:
            moved = inputs[c] - x.last[c]
            x.disturbance[c] = keep * x.disturbance[c] + share * moved * random_normal(x.random)
        x.last[c] = inputs[c]
        held[0] = inputs[c] - inputs[p.n + c]
        # Between two samples a straight line: at a tenth of the sampling rate that is 1.6 % short, and no later.
        whole = int(parameters[axes + axis])
        part = parameters[axes + axis] - whole
        late = held[whole]
        if part > 0.0:
            late += part * (held[whole + 1] - held[whole])
        outputs[p.n + c] = inputs[p.n + c] + parameters[axis] * late + x.disturbance[c]
        outputs[c] = outputs[p.n + c]
        if noise > 0.0:
            outputs[c] += noise * random_normal(x.random)
