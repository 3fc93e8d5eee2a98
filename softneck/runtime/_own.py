"""Python objects with a `step` method as runtimes: plain Python, with a module of their own inside an FMU."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import count
from types import ModuleType
from typing import Any

import numpy as np

# Runtime modules of this name hold an object called `own`.
PREFIX = "softneck_own_"
_NUMBERS = count(1)
_SOURCE_TEMPLATE = """
OWN = __import__("{module}").own


def state_size(p):
    return OWN.start().size


def initialise(p, parameters, state, outputs):
    state[:] = OWN.start()
    outputs[:] = OWN.first(outputs.size)


def step(p, parameters, state, inputs, outputs):
    state[:], outputs[:] = OWN.step(state, inputs)
"""


class OwnStep:
    """Adapter of an object with `step(state, inputs)` to vectors; an FMU contains this text too."""

    def __init__(self, stepped: Any, names: Sequence[str]) -> None:
        """Step `stepped`, whose inputs are called `names`."""
        self.stepped, self.names = stepped, tuple(names)

    def start(self) -> np.ndarray:
        """Return the state at the start (n_state,); empty where the object has none."""
        begin = getattr(self.stepped, "initial_state", tuple)
        return np.array(begin(), dtype=np.float64).reshape(-1)

    def first(self, count: int) -> np.ndarray:
        """Return the outputs at the start (count,); zero where the object does not say."""
        begin = getattr(self.stepped, "initial_outputs", None)
        return np.zeros(count) if begin is None else np.array(begin(), dtype=np.float64)

    def step(self, state: np.ndarray, inputs: np.ndarray) -> tuple[Any, Any]:
        """Return the state one sample later and the outputs."""
        after, outputs = self.stepped.step(state.copy(), dict(zip(self.names, inputs.tolist(), strict=True)))
        return np.array(after, dtype=np.float64).reshape(-1), np.array(outputs, dtype=np.float64)


def own_runtime(own: OwnStep) -> str:
    """Register an object as a runtime of this process and return the runtime's name."""
    module = ModuleType(f"{PREFIX}{next(_NUMBERS)}")
    vars(module)["own"] = own
    sys.modules[module.__name__] = module
    return module.__name__


def own_text(module: str) -> str:
    """Return the runtime functions of the object in `module`."""
    return _SOURCE_TEMPLATE.format(module=module)
