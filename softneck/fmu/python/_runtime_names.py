"""Placeholders for the runtime's functions that the slave calls; an FMU has the runtime itself instead."""

from __future__ import annotations

import numpy as np

from softneck.core import SettingsError

_ONLY_IN_FMU = "the slave runs inside an FMU only; build one with `softneck.fmu.build_fmu`."


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    raise SettingsError(f"{_ONLY_IN_FMU} ({len(arrays)} arrays)")


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Fill state and outputs at t_0."""
    raise SettingsError(f"{_ONLY_IN_FMU} ({len(arrays)}, {parameters.size}, {state.size}, {outputs.size})")


def step(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Advance by one sample time."""
    raise SettingsError(
        f"{_ONLY_IN_FMU} ({len(arrays)}, {parameters.size}, {state.size}, {inputs.size}, {outputs.size})"
    )
