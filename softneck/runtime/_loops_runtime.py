"""Loops over `step`, bundled with every runtime."""

import numpy as np


def step(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Placeholder: a bundle has the kind's own `step` instead."""
    raise NotImplementedError


def run_steps(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Step once for each row of `inputs` (time, n_in); the outputs go to `outputs` (time, n_out)."""
    for k in range(inputs.shape[0]):
        step(arrays, parameters, state, inputs[k], outputs[k])


def run_horizon(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    measured: np.ndarray,
    free: np.ndarray,
    horizon: int,
    outputs: np.ndarray,
) -> None:
    """Predict `horizon` steps ahead from every row.

    Row k of `measured` (time, n_in) holds the inputs at t_k with the outputs measured then; the same row of `free`
    holds them without. `outputs[k]` becomes the prediction of the outputs at t_k+1 from the data up to t_k+1-horizon
    (from the first row where that is earlier).
    """
    branch = np.empty_like(state)
    last = measured.shape[0]
    scratch = np.empty_like(outputs[0])
    for k in range(last):
        step(arrays, parameters, state, measured[k], scratch)
        if horizon == 1:
            outputs[k] = scratch
            continue
        # Data up to t_k: from here on a copy of the state is simulated, and the row `horizon` ahead is stored.
        branch[:] = state
        if k == 0:
            outputs[0] = scratch
        for j in range(k + 1, min(k + horizon, last)):
            step(arrays, parameters, branch, free[j], scratch)
            if k == 0 or j == k + horizon - 1:  # from the first row also the nearer ones, which no other row predicts
                outputs[j] = scratch
