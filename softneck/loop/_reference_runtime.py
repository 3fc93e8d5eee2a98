"""A reference as a runtime: what `_references.py` computes, sample by sample, for the reference FMU.

Arrays: (settings) = [kind, sample time], and a table (N, 4) of time, pitch, roll, co-contraction for a recorded one.
Kinds: 0 step, 1 ramp, 2 sine, 3 rotation, 4 recording. `step` from sample k returns the reference at sample k + 1,
which is where a master reads it.
"""

from __future__ import annotations

import math

import numpy as np


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state: the number of the sample, and the row of the table."""
    return 2


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Fill the state and the outputs at t_0."""
    state[0] = 0.0
    state[1] = 0.0
    reference_at(arrays, parameters, state, outputs)


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Go on by one sample."""
    state[0] += 1.0
    reference_at(arrays, parameters, state, outputs)


def reference_at(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray
) -> None:
    """Write pitch, roll, co-contraction and enabled at the state's sample.

    Parameters: pitch, roll, cocontraction, inclination [rad], frequency [Hz], at, rise [s], enabled.
    """
    kind = int(arrays[0][0])
    time = state[0] * arrays[0][1]
    pitch, roll, cocontraction = parameters[0], parameters[1], parameters[2]
    elapsed = time - parameters[5]
    outputs[3] = parameters[7]
    if kind == 4:
        table = arrays[1]
        k = int(state[1])
        # Half a nanosecond, as everywhere: times are multiples of a sample time.
        while k + 1 < table.shape[0] and table[k + 1, 0] <= time + 5e-10:
            k += 1
        state[1] = float(k)
        outputs[0], outputs[1], outputs[2] = table[k, 1], table[k, 2], table[k, 3]
    elif kind == 3:
        elapsed = max(0.0, elapsed)
        a = parameters[3] * min(1.0, elapsed / parameters[6])
        angle = 2.0 * math.pi * parameters[4] * elapsed
        outputs[0], outputs[1], outputs[2] = a * math.cos(angle), a * math.sin(angle), cocontraction
    else:
        third = 1.0
        if kind == 0:
            part = 1.0 if time >= parameters[5] - 5e-10 else 0.0
            third = part
        elif kind == 1:
            part = min(1.0, max(0.0, elapsed / parameters[6]))
            third = part
        else:
            part = math.sin(2.0 * math.pi * parameters[4] * max(0.0, elapsed))
        outputs[0], outputs[1], outputs[2] = pitch * part, roll * part, cocontraction * third
