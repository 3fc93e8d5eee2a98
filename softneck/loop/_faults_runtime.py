"""Change signals on the bus of a loop by its faults, row by row.

A fault is a row of `codes`: place (0 where sensors are read, 1 where the plant reads), action, first and last row,
begin and end of its signals among `slots`, end of its validity flags there, begin of its memory, and number of rows in
the memory.
"""

from __future__ import annotations

import math

import numpy as np

FAULT_DROPOUT = 0
FAULT_FREEZE = 1
FAULT_ADD = 2
FAULT_DELAY = 3
FAULT_SLOW = 4


def faults_act(k: int, place: int, faults: tuple, bus: np.ndarray) -> None:
    """Copy the signals that the faults of one place change, and apply these faults at row `k`.

    faults: detours (from and to of both places), codes, slots, largest steps, (rows, slots) values to add, memory.
    """
    detours, codes = faults[0], faults[1]
    origins, targets = detours[2 * place], detours[2 * place + 1]
    # Faults change a copy; the signal itself stays true for other readers.
    for i in range(len(origins)):
        bus[targets[i]] = bus[origins[i]]
    for i in range(len(codes)):
        if codes[i][0] == place:
            fault_act(k, codes[i], faults, bus)


def fault_act(k: int, code: np.ndarray, faults: tuple, bus: np.ndarray) -> None:
    """Apply one fault at row `k` and update its memory."""
    slots, most, added, memory = faults[2], faults[3], faults[4], faults[5]
    kind, begin, end = code[1], code[4], code[5]
    on = code[2] <= k < code[3]
    for i in range(begin, end):
        slot, at = slots[i], code[7] + i - begin
        now = bus[slot]
        # Bias, outliers, noise, offsets and disturbances of the neck: all rows were computed before.
        if kind == FAULT_ADD:
            if on:
                bus[slot] = now + added[k, i]
        elif kind == FAULT_DROPOUT:
            if on:
                bus[slot] = math.nan
        elif kind == FAULT_FREEZE:
            # The memory follows the signal until the fault starts. At row 0 there is no earlier value: its own stays.
            if on and k > 0:
                bus[slot] = memory[at]
            else:
                memory[at] = now
        elif kind == FAULT_SLOW:
            # From the value of the last row, in the window or before it: a slow motor starts without a jump.
            if on and k > 0:
                bus[slot] = memory[at] + min(max(now - memory[at], -most[i]), most[i])
            memory[at] = bus[slot]
        else:
            fault_delay(k, i, code, memory, bus, slot, on)
    if kind == FAULT_DROPOUT and on:
        # The validity flags come after the signals in `slots`.
        for i in range(end, code[6]):
            bus[slots[i]] = 0.0


def fault_delay(
    k: int, i: int, code: np.ndarray, memory: np.ndarray, bus: np.ndarray, slot: int, on: bool
) -> None:  # fmt: skip
    """Return the signal of `lag` rows ago to the bus; before row 0 it had the value of row 0."""
    width, lag, now = code[5] - code[4], code[8], bus[slot]
    first = code[7] + i - code[4]
    if k == 0:
        for row in range(lag):
            memory[first + row * width] = now
    # A ring buffer: this cell was written `lag` rows ago and is overwritten now.
    at = first + (k % lag) * width
    if on:
        bus[slot] = memory[at]
    memory[at] = now
