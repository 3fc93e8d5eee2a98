"""The names a kind's runtime gives the slave; in an FMU the runtime itself stands in their place."""

from __future__ import annotations

import numpy as np

from softneck.core import SettingsError

_TEXT = "the slave runs inside an FMU only; build one with `softneck.fmu.build_fmu`."


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    raise SettingsError(f"{_TEXT} ({len(arrays)} arrays)")


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Fill state and outputs at t_0."""
    raise SettingsError(f"{_TEXT} ({len(arrays)}, {parameters.size}, {state.size}, {outputs.size})")


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample time."""
    raise SettingsError(f"{_TEXT} ({len(arrays)}, {parameters.size}, {state.size}, {inputs.size}, {outputs.size})")
