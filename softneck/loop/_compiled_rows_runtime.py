"""Rows of a loop, compiled: what `LoopRun` does in Python, for loops whose parts are all blocks.

`part_step` is written by `softneck.runtime._compile.load_linked` and calls the parts' own compiled steps. All that a
loop is made of comes as arrays (see `_compiled_rows.py`); the bus, the pending outputs and the memories are changed in
"""

from __future__ import annotations

import math

import numpy as np

ROWS_DONE = 0
ROWS_MISSING_INPUT = 1
ROWS_BAD_OUTPUT = 2
# What a fault does; see `_acting.py`, which does the same in Python.
ROWS_DROPOUT = 0
ROWS_FREEZE = 1
ROWS_ADD = 2
ROWS_DELAY = 3
ROWS_ADD_ROWS = 4
ROWS_SLOW = 5


def part_step(
    part: int, arrays: tuple, parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Step one part; replaced when the loop is compiled."""
    raise NotImplementedError


def run_rows(first: int, stop: int, plan: tuple, parts: tuple, bus: np.ndarray, table: np.ndarray) -> tuple:
    """Run rows `first` to `stop`; return (next row, what stopped it, part).

    plan: (sequential, order, ratios, late, spans, taps, reference, detours, faults); parts: (arrays, parameters,
    states, outputs, pending, missing).
    """
    sequential, order, ratios, late = plan[0], plan[1], plan[2], plan[3]
    for k in range(first, stop):
        rows_arrive(k, plan, parts, bus)
        if sequential:
            for i in range(order.shape[0]):
                part = int(order[i])
                if k % ratios[part] == 0:
                    status = rows_advance(part, plan, parts, bus)
                    if status != ROWS_DONE:
                        return k, status, part
                    rows_publish(part, plan, parts[3], bus)
        rows_detour(k, plan[7], plan[8], 1, bus)
        table[k] = bus
        for part in range(ratios.shape[0]):
            if k % ratios[part] == 0 and (late[part] or not sequential):
                status = rows_advance(part, plan, parts, bus)
                if status != ROWS_DONE:
                    return k, status, part
                if late[part]:
                    parts[4][part][:] = parts[3][part]
        if not sequential:
            for part in range(ratios.shape[0]):
                if k % ratios[part] == 0 and not late[part]:
                    rows_publish(part, plan, parts[3], bus)
    return stop, ROWS_DONE, 0


def rows_arrive(k: int, plan: tuple, parts: tuple, bus: np.ndarray) -> None:
    """Put on the bus what becomes valid at t_k: the plant's outputs and the reference."""
    ratios, late, reference = plan[2], plan[3], plan[6]
    for part in range(ratios.shape[0]):
        if late[part] and k % ratios[part] == 0:
            rows_publish(part, plan, parts[4], bus)
    if reference[1].shape[0] > 0:
        at = reference[0]
        for j in range(reference[1].shape[1]):
            bus[at + j] = reference[1][k, j]
    rows_detour(k, plan[7], plan[8], 0, bus)


def rows_publish(part: int, plan: tuple, values: tuple, bus: np.ndarray) -> None:
    """Copy a part's outputs to its place on the bus."""
    at = plan[4][part]
    for j in range(values[part].shape[0]):
        bus[at + j] = values[part][j]


def rows_advance(part: int, plan: tuple, parts: tuple, bus: np.ndarray) -> int:
    """Gather the inputs of a part, step it, look at its outputs."""
    begins, slots, factors, fragile = plan[5]
    begin, end = begins[part], begins[part + 1]
    inputs = np.empty(end - begin)
    for i in range(begin, end):
        inputs[i - begin] = bus[slots[i]] * factors[i]
        if fragile[i] and not math.isfinite(inputs[i - begin]):
            return ROWS_MISSING_INPUT
    part_step(part, parts[0], parts[1][part], parts[2][part], inputs, parts[3][part])
    outputs, missing = parts[3][part], parts[5][part]
    for j in range(outputs.shape[0]):
        if not math.isfinite(outputs[j]) and not (missing[j] and math.isnan(outputs[j])):
            return ROWS_BAD_OUTPUT
    return ROWS_DONE


def rows_detour(k: int, detours: tuple, faults: tuple, place: int, bus: np.ndarray) -> None:
    """Copy signals past faults and let the faults of one place act: 0 sensors, 1 what the plant reads."""
    origins, targets = detours[2 * place], detours[2 * place + 1]
    for i in range(origins.shape[0]):
        bus[targets[i]] = bus[origins[i]]
    codes = faults[0]
    for fault in range(codes.shape[0]):
        if codes[fault, 0] == place:
            rows_fault(fault, k, faults, bus)


def rows_fault(fault: int, k: int, faults: tuple, bus: np.ndarray) -> None:
    """Let one fault act at row `k`, and remember what it needs.

    faults: codes (n, 9) = place, kind, first and last row, begin and end of its slots, end of its flags, begin of its
    memory, lag; slots; values to add or greatest steps; rows to add; memory.
    """
    codes, slots, values, rows, memory = faults
    kind, begin, end = codes[fault, 1], codes[fault, 4], codes[fault, 5]
    on = codes[fault, 2] <= k < codes[fault, 3]
    held = codes[fault, 7]
    for i in range(begin, end):
        slot, at = slots[i], held + i - begin
        now = bus[slot]
        if kind == ROWS_DROPOUT:
            if on:
                bus[slot] = math.nan
        elif kind == ROWS_FREEZE:
            if on and k > 0:
                bus[slot] = memory[at]
            else:
                memory[at] = now
        elif kind == ROWS_ADD:
            if on:
                bus[slot] = now + values[i]
        elif kind == ROWS_ADD_ROWS:
            if on:
                bus[slot] = now + rows[k, i]
        elif kind == ROWS_SLOW:
            wanted = now
            if on and k > 0:
                most = values[i]
                wanted = memory[at] + min(max(now - memory[at], -most), most)
                bus[slot] = wanted
            memory[at] = wanted
        else:
            rows_delay(fault, k, i, codes, memory, bus, slot)
    if kind == ROWS_DROPOUT and on:
        for i in range(end, codes[fault, 6]):
            bus[slots[i]] = 0.0


def rows_delay(fault: int, k: int, i: int, codes: np.ndarray, memory: np.ndarray, bus: np.ndarray, slot: int) -> None:
    """Show the value of some rows ago."""
    begin, end, lag = codes[fault, 4], codes[fault, 5], codes[fault, 8]
    width, now = end - begin, bus[slot]
    first = codes[fault, 7] + i - begin
    if k == 0:
        for row in range(lag):
            memory[first + row * width] = now
    at = first + (k % lag) * width
    old = memory[at]
    memory[at] = now
    if codes[fault, 2] <= k < codes[fault, 3]:
        bus[slot] = old
