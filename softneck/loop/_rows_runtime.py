"""The rows of a loop, interpreted or compiled, for simulations, studies, verification and drives.

A row is a list of actions (see `_run.py`). The bus, the outputs of each part and the memory of faults change in place.
"""

from __future__ import annotations

import math

import numpy as np

from softneck.loop._faults_runtime import faults_act
from softneck.runtime._compiled_runtime import COMPILED

ROWS_DONE = 0
ROWS_MISSING_INPUT = 1
ROWS_BAD_OUTPUT = 2

# Actions of a row; each comes with its part or place of faults, and its period in rows.
ROWS_STEP = 0
ROWS_SHOW = 1
ROWS_REFER = 2
ROWS_DISTURB = 3
ROWS_RECORD = 4


def part_step(part: int, time: float, parts: tuple, inputs: np.ndarray, outputs: np.ndarray) -> bool:
    """Step one part and return whether all its outputs are finite; `load_linked` replaces it for compiled parts."""
    values = parts[part](time, inputs)
    # A part may have written into `outputs` itself.
    if values is not outputs:
        outputs[:] = values
    # The sum is finite unless an output is not; Python's `sum` does not warn of inf - inf.
    return math.isfinite(sum(values.tolist()))


def run_rows(
    first: int, stop: int, plan: tuple, signals: tuple, faults: tuple, parts: tuple, table: np.ndarray
) -> tuple:
    """Run rows `first` to `stop`; return (code of the problem, part).

    plan: (actions, step [s], taps, reference (rows, 4)). signals: (bus, last outputs of each part, their views of the
    bus, the next row), with the reference after the parts. parts: for `part_step`.
    """
    cycle, step, taps, reference = plan
    bus, held, shown, following = signals
    for k in range(first, stop):
        for what, part, every in zip(cycle[0], cycle[1], cycle[2]):  # noqa: B905 - numba knows no `strict`
            if k % every != 0:
                continue
            if what == ROWS_STEP:
                problem = rows_step(part, k * step, taps, bus, held[part], parts)
                if problem != ROWS_DONE:
                    return problem, part
            elif what == ROWS_SHOW:
                rows_copy(held[part], shown[part])
            elif what == ROWS_REFER:
                rows_copy(reference[k], shown[part])
            elif what == ROWS_DISTURB:
                faults_act(k, part, faults, bus)
            else:
                rows_copy(bus, table[k])
        # A stopped or saved run continues here.
        following[0] = k + 1
    return ROWS_DONE, 0


def rows_copy(source: np.ndarray, target: np.ndarray) -> None:
    """Copy a vector; compiled, a slice would first look for an overlap."""
    if COMPILED:
        for i in range(target.size):
            target[i] = source[i]
    else:
        target[:] = source


def rows_step(part: int, time: float, taps: tuple, bus: np.ndarray, outputs: np.ndarray, parts: tuple) -> int:
    """Gather the inputs of a part, step it, and check its outputs.

    taps: of each part, the positions of its inputs on the bus, their factors and offsets (none without conversion),
    the inputs that must not be missing, the outputs that may be (none without a check), and memory for the inputs.
    """
    slots, scales, fragile, missing, given = taps
    # A copy, so that no part can change the bus through its inputs.
    places, scale, inputs = slots[part], scales[part], given[part]
    if COMPILED:
        for i in range(places.size):
            inputs[i] = bus[places[i]]
    else:
        inputs = bus[places]  # a new one, as a part in Python may keep it
    if scale.size:
        for i in range(places.size):
            inputs[i] = inputs[i] * scale[0, i] + scale[1, i]
    if fragile[part].size:
        # Parts that cannot use a missing value stop the run; all others get the NaN.
        for i in fragile[part]:
            if not math.isfinite(inputs[i]):
                return ROWS_MISSING_INPUT
    if part_step(part, time, parts, inputs, outputs):
        return ROWS_DONE
    may_miss = missing[part]
    for i in range(may_miss.size):
        # NaN means "missing" where that is allowed; infinity is always an error.
        if not math.isfinite(outputs[i]) and not (may_miss[i] and math.isnan(outputs[i])):
            return ROWS_BAD_OUTPUT
    return ROWS_DONE
