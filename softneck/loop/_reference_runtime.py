"""References: what pitch, roll and co-contraction are to be, for loops (`_references.py`) and the reference FMU.

`step` from sample k returns the reference at sample k + 1, which is where a master reads it.
"""

import math

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells


class ReferenceArrays(Arrays):
    """Which reference, and the rows of a recorded one."""

    setup = array("2", "kind: 0 step, 1 ramp, 2 sine, 3 rotation, 4 recording, 5 of any robot; sample time [s]")
    table = array("rows, columns", "time [s], pitch, roll, co-contraction [rad] of a recording; outputs of any robot")


class ReferenceState(StateVector):
    """Where in time it is."""

    sample = cells("", "number of the sample")
    row = cells("", "row of the table")


def initialise(p: ReferenceArrays, parameters: np.ndarray, x: ReferenceState, outputs: np.ndarray) -> None:
    """Fill the state and the outputs at t_0."""
    x.sample = 0.0
    x.row = 0.0
    reference_at(p, parameters, x, outputs)


def step(
    p: ReferenceArrays, parameters: np.ndarray, x: ReferenceState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Go on by one sample."""
    x.sample += 1.0
    reference_at(p, parameters, x, outputs)


def reference_at(p: ReferenceArrays, parameters: np.ndarray, x: ReferenceState, outputs: np.ndarray) -> None:
    """Write pitch, roll, co-contraction and enabled at the state's sample.

    Parameters: pitch, roll, cocontraction, inclination [rad], frequency [Hz], at, rise [s], enabled.
    """
    kind = int(p.setup[0])
    time = x.sample * p.setup[1]  # from a count: sums of sample times would drift
    if kind == 5:
        k = reference_row(time, p.table, int(x.row))
        x.row = float(k)
        for j in range(1, p.columns):
            outputs[j - 1] = p.table[k, j]
        outputs[p.columns - 1] = parameters[0]  # its one parameter: enabled
        return
    pitch, roll, cocontraction = parameters[0], parameters[1], parameters[2]
    frequency, at, rise = parameters[4], parameters[5], parameters[6]
    if kind == 0:
        pitch, roll, cocontraction = reference_step(time, pitch, roll, cocontraction, at)
    elif kind == 1:
        pitch, roll, cocontraction = reference_ramp(time, pitch, roll, cocontraction, at, rise)
    elif kind == 2:
        pitch, roll, cocontraction = reference_sine(time, pitch, roll, cocontraction, frequency, at)
    elif kind == 3:
        pitch, roll, cocontraction = reference_rotation(time, parameters[3], cocontraction, frequency, at, rise)
    else:
        # Time only goes forward: the search goes on where it was.
        k = reference_row(time, p.table, int(x.row))
        x.row = float(k)
        pitch, roll, cocontraction = p.table[k, 1], p.table[k, 2], p.table[k, 3]
    outputs[0], outputs[1], outputs[2], outputs[3] = pitch, roll, cocontraction, parameters[7]


def reference_step(
    time: float, pitch: float, roll: float, cocontraction: float, at: float
) -> tuple[float, float, float]:  # fmt: skip
    """Jump from zero at `at`."""
    # Times are multiples of a sample time; half a nanosecond covers their rounding.
    if time >= at - 5e-10:
        return pitch, roll, cocontraction
    return 0.0, 0.0, 0.0


def reference_ramp(
    time: float, pitch: float, roll: float, cocontraction: float, at: float, rise: float
) -> tuple[float, float, float]:
    """Rise linearly from zero over `rise`."""
    part = min(1.0, max(0.0, (time - at) / rise))
    return pitch * part, roll * part, cocontraction * part


def reference_sine(
    time: float, pitch: float, roll: float, cocontraction: float, frequency: float, at: float
) -> tuple[float, float, float]:
    """Swing in phase from `at` on."""
    wave = math.sin(2.0 * math.pi * frequency * max(0.0, time - at))
    return pitch * wave, roll * wave, cocontraction


def reference_rotation(
    time: float, inclination: float, cocontraction: float, frequency: float, at: float, rise: float
) -> tuple[float, float, float]:
    """Go around: pitch = A cos(w t), roll = A sin(w t), A rising from zero over `rise`."""
    elapsed = max(0.0, time - at)
    # Out of the upright on a spiral: a circle begun at once would be a step.
    a = inclination * min(1.0, elapsed / rise)
    angle = 2.0 * math.pi * frequency * elapsed
    return a * math.cos(angle), a * math.sin(angle), cocontraction


def reference_row(time: float, table: np.ndarray, k: int) -> int:
    """Return the row of a recording that holds at `time`, from row `k` on."""
    while k + 1 < table.shape[0] and table[k + 1, 0] <= time + 5e-10:  # rounding of the times, as in `reference_step`
        k += 1
    return k
