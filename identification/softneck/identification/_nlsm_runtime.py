"""Set membership (Eq. 18-20, Algorithm 1); arrays: H, drive, table, scale, W, y, (gamma, epsilon), tree nodes."""

import numpy as np

from softneck.core._compiled_runtime import COMPILED
from softneck.identification._narx_runtime import narx_advance, narx_observe, narx_regressor
from softneck.identification._tree_runtime import tree_bounds


def nlsm_bounds(
    points: np.ndarray, values: np.ndarray, gamma: float, epsilon: float, x: np.ndarray
) -> tuple[float, float]:
    """Return f_l(x), f_u(x) over `points` (n, N), scaled, and their `values` (N,)."""
    squared = np.zeros(points.shape[1])
    for i in range(points.shape[0]):
        gap = points[i] - x[i]
        squared += gap * gap
    cone = gamma * np.sqrt(squared)
    return np.max(values - cone) - epsilon, np.min(values + cone) + epsilon


def nlsm_query(arrays: tuple[np.ndarray, ...], axis: int, x: np.ndarray) -> tuple[float, float]:
    """Return f_l(x), f_u(x) of one axis: by the tree where loops are fast, else over all points by numpy."""
    gamma = arrays[6][axis, 0]
    epsilon = arrays[6][axis, 1]
    if COMPILED:
        low, high = tree_bounds(arrays[4][axis], arrays[5][axis], arrays[7][axis], gamma, x)
        return low - epsilon, high + epsilon
    return nlsm_bounds(arrays[4][axis], arrays[5][axis], gamma, epsilon, x)


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample; the bounds of pitch and roll follow the motor positions in `outputs`."""
    narx_observe(arrays, parameters, state, inputs)
    table = arrays[2]
    scale = arrays[3]
    x = np.empty(table.shape[0])
    angles = np.empty(2)
    for axis in range(2):
        narx_regressor(arrays, table, state, axis, x)
        low, high = nlsm_query(arrays, axis, x * scale)
        angles[axis] = 0.5 * (low + high)
        outputs[5 + 2 * axis] = low
        outputs[6 + 2 * axis] = high
    narx_advance(arrays, parameters, state, angles[0], angles[1], outputs)
