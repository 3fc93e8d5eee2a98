"""Set membership on what the free run of any plant leaves over (see `_residual`).

Arrays: H (1), memory (1), table, scale, points, values, (gamma, epsilon), tree nodes and frame; then those of the base,
the one member. State: motors m (H, 3) and base outputs y (H, 2), newest first; those of now (5), what the set adds now
(2), random generator (6); then the base's state. What the set adds is never fed back, and what is measured moves the
base alone, by what it is above that: the free run is as stable as the base's, and the set adds at most its own range.
"""

import math

import numpy as np

from softneck.identification.set_membership._principal_tree_runtime import slant_bounds
from softneck.runtime._compiled_runtime import COMPILED
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed

OWN_ARRAYS = 9


def residual_own(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state before the base's."""
    return 5 * int(arrays[0][0]) + 13


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return residual_own(arrays) + member_size(arrays, 0)


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: as the base rests, its outputs at their start values for ever."""
    h = int(arrays[0][0])
    base = np.zeros(9)
    state[:] = 0.0
    member_initialise(arrays, 0, parameters, state[residual_own(arrays) :], base)
    for j in range(h):
        state[3 * h + 2 * j] = base[0]
        state[3 * h + 2 * j + 1] = base[1]
    state[5 * h + 3] = base[0]
    state[5 * h + 4] = base[1]
    random_seed(state[5 * h + 7 : 5 * h + 13], parameters[4])
    outputs[:5] = base[:5]
    outputs[5:7] = base[0]
    outputs[7:9] = base[1]


def residual_query(arrays: tuple[np.ndarray, ...], axis: int, x: np.ndarray) -> tuple[float, float]:
    """Return the bounds of one axis: by the tree where loops are fast, else over all points by numpy."""
    gamma = arrays[6][axis, 0]
    epsilon = arrays[6][axis, 1]
    if COMPILED:
        low, high = slant_bounds(arrays[4][axis], arrays[5][axis], arrays[7][axis], arrays[8][axis], gamma, x)
        return low - epsilon, high + epsilon
    squared = np.zeros(arrays[4].shape[2])
    for i in range(arrays[4].shape[1]):
        gap = arrays[4][axis, i] - x[i]
        squared += gap * gap
    cone = gamma * np.sqrt(squared)
    return np.max(arrays[5][axis] - cone) - epsilon, np.min(arrays[5][axis] + cone) + epsilon


def residual_observe(arrays: tuple[np.ndarray, ...], state: np.ndarray, given: np.ndarray, measured: bool) -> None:
    """Push motors and base outputs of now into the histories: measured where they are."""
    h = int(arrays[0][0])
    now = 5 * h
    if measured:
        for j in range(2):
            if math.isfinite(given[3 + j]):
                state[now + 3 + j] = given[3 + j]
        for j in range(3):
            if math.isfinite(given[5 + j]):
                state[now + j] = given[5 + j]
    state[3 : 3 * h] = state[: 3 * h - 3].copy()
    state[3 * h + 2 : 5 * h] = state[3 * h : 5 * h - 2].copy()
    state[:3] = state[now : now + 3]
    state[3 * h : 3 * h + 2] = state[now + 3 : now + 5]


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample; the bounds of pitch and roll follow the motor positions in `outputs`."""
    h = int(arrays[0][0])
    now = 5 * h
    quiet = parameters.copy()
    quiet[3] = 0.0
    given = inputs.copy()
    given[3] -= state[now + 5]
    given[4] -= state[now + 6]
    residual_observe(arrays, state, given, parameters[2] > 0.5)
    base = np.zeros(9)
    member_step(arrays, 0, quiet, state[residual_own(arrays) :], given, base)
    state[now : now + 3] = base[2:5]
    state[now + 3 : now + 5] = base[:2]
    outputs[2:5] = base[2:5]
    table = arrays[2]
    x = np.empty(table.shape[0])
    for i in range(table.shape[0]):
        back = int(table[i, 2]) - 1
        channel = int(table[i, 1])
        value = state[3 * back + channel] if table[i, 0] == 2 else state[3 * h + 2 * back + channel]
        x[i] = value * arrays[3][i]
    for axis in range(2):
        low, high = residual_query(arrays, axis, x)
        state[now + 5 + axis] = 0.5 * (low + high)
        outputs[axis] = base[axis] + 0.5 * (low + high)
        outputs[5 + 2 * axis] = base[axis] + low
        outputs[6 + 2 * axis] = base[axis] + high
    if parameters[3] > 0.0:
        outputs[0] += parameters[3] * random_normal(state[now + 7 : now + 13])
        outputs[1] += parameters[3] * random_normal(state[now + 7 : now + 13])
