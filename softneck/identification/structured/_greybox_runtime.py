"""Grey box: the equations of `_neck_model_runtime`, and an echo of what was measured.

Arrays: H, drive (3, 2), neck (16), sensor (dead time in samples, sample time), echo (2, p), memory. State: that of
`_histories_runtime`, then b, z, s, sensor and its line of tilts. As in kind `play` the histories hold what is above
the equations' output; that is bounded (see there) and the echo dies out, so no free run can diverge.
"""

import numpy as np

from softneck.identification.models._feedforward_runtime import echo_added, echo_rest
from softneck.identification.models._histories_runtime import narx_advance, narx_observe, narx_rest, narx_size
from softneck.identification.structured._neck_equations_runtime import NECK_STATES, neck_advance, neck_sense


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return narx_size(arrays) + NECK_STATES + 2 * int(arrays[3][0])


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the neck settled; what the start is above that is remembered as measured."""
    narx_rest(arrays, parameters, state, outputs)
    x = state[narx_size(arrays) :]
    m = np.zeros(3)
    for _ in range(int(arrays[5][0])):
        neck_advance(arrays[2], arrays[3][1], np.zeros(3), m, x)
        neck_sense(arrays[2], arrays[3][1], x)
    for axis in range(2):
        echo_rest(arrays, state, axis, x[5 + axis])


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample."""
    narx_observe(arrays, parameters, state, inputs)
    h = int(arrays[0][0])
    now = 8 * h
    x = state[narx_size(arrays) :]
    m = state[3 * h : 3 * h + 3].copy()
    targets = np.empty(3)
    for j in range(3):
        targets[j] = state[3 * (int(arrays[1][j, 1]) - 1) + j]
    neck_advance(arrays[2], arrays[3][1], targets, m, x)
    neck_sense(arrays[2], arrays[3][1], x)
    angles = np.empty(2)
    for axis in range(2):
        angles[axis] = echo_added(arrays, arrays[4], state, axis, x[5 + axis])
    narx_advance(arrays, parameters, state, angles[0], angles[1], outputs)
    for j in range(3):
        state[now + j] = m[j]
        outputs[2 + j] = m[j]
