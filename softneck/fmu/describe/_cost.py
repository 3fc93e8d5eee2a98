"""How much work one step of a block is in plain Python, as a count that every machine agrees on."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import numpy as np

from softneck.runtime import Block, load_runtime

# 0.1 us a line and 1 ns a number, about: 15 us and more are middling, 100 us and more are heavy.
_MIDDLING_LINES, _HEAVY_LINES, _HEAVY_NUMBERS = 150, 1000, 20_000


def plain_cost(block: Block) -> str:
    """Return "light", "middling" or "heavy": what an FMU of `block` costs where its runtime is not compiled."""
    if sum(array.size for array in block.arrays) > _HEAVY_NUMBERS:
        return "heavy"
    lines = _lines(block)
    return "heavy" if lines > _HEAVY_LINES else "middling" if lines > _MIDDLING_LINES else "light"


def _lines(block: Block) -> int:
    """Return the number of lines that one plain step runs through."""
    runtime = load_runtime(block.runtime, compiled=False)
    parameters = np.array([port.start for port in block.parameters])
    inputs = np.array([np.nan if port.missing else port.start for port in block.inputs])
    state, outputs = np.zeros(runtime.state_size(block.arrays)), np.zeros(len(block.outputs))
    count = 0

    def trace(_frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    with np.errstate(all="ignore"):
        runtime.initialise(block.arrays, parameters, state, outputs)
        sys.settrace(trace)
        try:
            runtime.step(block.arrays, parameters, state, inputs, outputs)
        finally:
            sys.settrace(before)
    return count
