"""Set membership (Eq. 18-20, Algorithm 1), alone or on a linear base.

Arrays: H, drive, table, scale, W, y, (gamma, epsilon), tree nodes and frame; then the base: redefinition, a, b, delay.
An empty base is the paper's Eq. 21, fed back what it puts out. With one, the histories hold the base's outputs: what
the set adds to them is never fed back, and what is measured moves the base alone.
"""

import numpy as np

from softneck.identification.linear._arx_runtime import arx_output
from softneck.identification.models._narx_runtime import narx_advance, narx_observe, narx_regressor
from softneck.identification.set_membership._principal_tree_runtime import slant_bounds
from softneck.runtime._compiled_runtime import COMPILED


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
        low, high = slant_bounds(arrays[4][axis], arrays[5][axis], arrays[7][axis], arrays[8][axis], gamma, x)
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
    h = int(arrays[0][0])
    table = arrays[2]
    scale = arrays[3]
    x = np.empty(table.shape[0])
    angles = np.empty(2)
    for axis in range(2):
        narx_regressor(arrays, table, state, axis, x)
        low, high = nlsm_query(arrays, axis, x * scale)
        base = arx_output(arrays[9], arrays[10][axis], arrays[11][axis], int(arrays[12][axis]), h, state, axis)
        middle = 0.5 * (low + high)
        angles[axis] = base + middle
        outputs[5 + 2 * axis] = base + low
        outputs[6 + 2 * axis] = base + high
        if arrays[11].shape[1] > 0:
            state[8 * h + 11 + axis] = middle
    narx_advance(arrays, parameters, state, angles[0], angles[1], outputs)
