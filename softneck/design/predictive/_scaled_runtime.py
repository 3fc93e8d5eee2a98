"""Inputs of both predictive runtimes: inputs and limits in scaled quantities, references within bounds.

`q` are a controller's numbers. Behind the first SCALED_NUMBERS stand, where they are not ones, the lowest and highest
set-points and references, scaled; then the units in SI, that of the motors and one for each output.
"""

import math

import numpy as np

SCALED_NUMBERS = 17
SCALED_REFERENCE = 0.8  # as the ports' min and max
SCALED_MOTOR = 6.0  # the paper's largest rotation (section 3.1)
# No neck leans this far: such a value is not a measurement.
SCALED_PLAUSIBLE = 1.3


def scaled_first(motors: int, outputs: int) -> int:
    """Return where the units begin: that of the motors, those of the outputs."""
    return SCALED_NUMBERS + 2 * motors + 2 * (outputs + 1)


def scaled_unit(q: np.ndarray, motors: int, outputs: int) -> float:
    """Return the unit of the motors in SI."""
    return float(q[scaled_first(motors, outputs)]) if q.shape[0] > SCALED_NUMBERS else 1.0


def scaled_output(q: np.ndarray, motors: int, outputs: int, axis: int) -> float:
    """Return the unit of an output in SI."""
    return float(q[scaled_first(motors, outputs) + 1 + axis]) if q.shape[0] > SCALED_NUMBERS else 1.0


def scaled_inputs(q: np.ndarray, motors: int, outputs: int, ahead: int, inputs: np.ndarray) -> np.ndarray:
    """Return the inputs scaled: references, co-contraction, outputs, motors, flags, references ahead."""
    u = inputs.copy()
    unit, flags = scaled_unit(q, motors, outputs), 2 * outputs + 1 + motors
    for i in range(outputs):
        size = scaled_output(q, motors, outputs, i)
        u[i] /= size
        u[outputs + 1 + i] /= size
        if ahead > 0:
            u[flags + 2 + i] /= size
    u[outputs] /= unit
    for j in range(motors):
        u[2 * outputs + 1 + j] /= unit
    return u


def scaled_range(q: np.ndarray, motors: int, parameters: np.ndarray, j: int) -> tuple[float, float]:
    """Return the lowest and highest set-point of motor j, by the first parameter and the fourth as well."""
    least, most = max(-parameters[0], parameters[3]), parameters[0]
    if q.shape[0] > SCALED_NUMBERS:
        least = max(least, q[SCALED_NUMBERS + j])
        most = min(most, q[SCALED_NUMBERS + motors + j])
    return least, most


def scaled_measured(q: np.ndarray, outputs: int, inputs: np.ndarray) -> bool:
    """Return whether the outputs are numbers, without bounds of their own those that can be."""
    for i in range(outputs + 1, 2 * outputs + 1):
        if not math.isfinite(inputs[i]) or (q.shape[0] == SCALED_NUMBERS and abs(inputs[i]) >= SCALED_PLAUSIBLE):
            return False
    return True


def scaled_reference(q: np.ndarray, motors: int, outputs: int, i: int, asked: float) -> float:
    """Return a reference clipped to its range."""
    if q.shape[0] > SCALED_NUMBERS:
        low = SCALED_NUMBERS + 2 * motors + i
        return min(max(asked, float(q[low])), float(q[low + outputs + 1]))
    limit = SCALED_REFERENCE if i < outputs else SCALED_MOTOR
    return min(max(asked, -limit), limit)


def scaled_listen(
    q: np.ndarray, motors: int, outputs: int, ahead: int, first: bool, inputs: np.ndarray, seen: np.ndarray,
    coming: np.ndarray,
) -> None:  # fmt: skip
    """Update references, and those ahead (outputs ahead,); a value that is not finite keeps the previous one."""
    for i in range(outputs + 1):
        if math.isfinite(inputs[i]):
            seen[i] = scaled_reference(q, motors, outputs, i, float(inputs[i]))
    for axis in range(outputs):
        if ahead > 0:
            row = coming[axis * ahead : (axis + 1) * ahead]
            # What is to come is not known yet: as now.
            if first:
                row[:] = seen[axis]
            for i in range(ahead - 1):
                row[i] = row[i + 1]
            newest = float(inputs[2 * outputs + 3 + motors + axis])
            if math.isfinite(newest):
                row[ahead - 1] = scaled_reference(q, motors, outputs, axis, newest)
