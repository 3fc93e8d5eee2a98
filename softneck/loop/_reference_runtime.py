"""References of outputs and co-contraction, for loops (`_references.py`) and the reference FMU.

`step` from sample k returns the reference at sample k + 1, where a master reads it.
"""

import math

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells


class ReferenceArrays(Arrays):
    """The kind of reference, and the table of a recorded one."""

    setup = array("2", "kind: 0 step, 1 ramp, 2 sine, 3 rotation, 4 recording; sample time [s]")
    table = array("rows, columns", "time [s], outputs and co-contraction of a recording")


class ReferenceState(StateVector):
    """The position in time."""

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
    """Advance by one sample."""
    x.sample += 1.0
    reference_at(p, parameters, x, outputs)


def reference_at(p: ReferenceArrays, parameters: np.ndarray, x: ReferenceState, outputs: np.ndarray) -> None:
    """Write the outputs' references, co-contraction and enabled at the state's sample.

    Parameters: outputs, cocontraction, inclination [SI], frequency [Hz], at, rise [s], enabled.
    """
    kind, m = int(p.setup[0]), p.columns - 2
    time = x.sample * p.setup[1]  # from a count: sums of sample times would drift
    frequency, at, rise = float(parameters[m + 2]), float(parameters[m + 3]), float(parameters[m + 4])
    if kind == 4:
        # Time only increases: the search continues at the last row.
        k = reference_row(time, p.table, int(x.row))
        x.row = float(k)
        for j in range(m + 1):
            outputs[j] = p.table[k, j + 1]
    elif kind == 3:
        outputs[0], outputs[1] = reference_rotation(time, float(parameters[m + 1]), frequency, at, rise)
        outputs[m] = parameters[m]
    else:
        for j in range(m + 1):
            outputs[j] = reference_value(kind, time, float(parameters[j]), frequency, at, rise)
        if kind == 2:
            outputs[m] = parameters[m]
    outputs[m + 1] = parameters[m + 5]


def reference_value(kind: int, time: float, value: float, frequency: float, at: float, rise: float) -> float:
    """Return a step at `at` (0), a linear rise over `rise` (1), or a sine from `at` on (2)."""
    if kind == 0:
        # Times are multiples of a sample time; half a nanosecond covers their rounding.
        if time >= at - 5e-10:
            return value
        return 0.0
    if kind == 1:
        return value * min(1.0, max(0.0, (time - at) / rise))
    return value * math.sin(2.0 * math.pi * frequency * max(0.0, time - at))


def reference_rotation(
    time: float, inclination: float, frequency: float, at: float, rise: float
) -> tuple[float, float]:  # fmt: skip
    """Return A cos(w t) and A sin(w t), where A rises from zero over `rise`."""
    elapsed = max(0.0, time - at)
    # A spiral out of the upright: a circle at once would be a step.
    a = inclination * min(1.0, elapsed / rise)
    angle = 2.0 * math.pi * frequency * elapsed
    return a * math.cos(angle), a * math.sin(angle)


def reference_row(time: float, table: np.ndarray, k: int) -> int:
    """Return the row of a recording at `time`; the search starts at row `k`."""
    while k + 1 < table.shape[0] and table[k + 1, 0] <= time + 5e-10:  # rounding of the times, as in `reference_value`
        k += 1
    return k
