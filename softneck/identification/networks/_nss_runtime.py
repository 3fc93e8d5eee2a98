"""Neural state space behind drives that stall under load, and a linear echo of what was measured.

Arrays: H, drive, load, redefinition, widths, delay, A, B, E, F, G, h, D, C, c (see `_nss_map_runtime`), range (2, 2),
echo (2, p), memory (samples after which a held start has settled). State: that of `_histories_runtime`, then q (3),
plays, x. As in kind `play` the histories hold what is above y of the map, which is kept within `range` and never
fed back; the echo dies out where nothing is measured.
"""

import numpy as np

from softneck.identification.models._bank_runtime import load_advance
from softneck.identification.models._feedforward_runtime import echo_added, echo_rest, stalling_drives
from softneck.identification.models._histories_runtime import narx_advance, narx_observe, narx_rest, narx_size
from softneck.identification.networks._nss_map_runtime import nss_inputs, nss_next


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return narx_size(arrays) + 3 + 3 * arrays[4].shape[0] + arrays[6].shape[0]


def nss_output(arrays: tuple[np.ndarray, ...], x: np.ndarray, axis: int) -> float:
    """Return y of one axis, kept within `range`."""
    y = arrays[14][axis]
    for i in range(x.shape[0]):
        y += arrays[13][axis, i] * x[i]
    return min(max(y, arrays[15][axis, 0]), arrays[15][axis, 1])


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the neck settled; what the start is above that is remembered as measured."""
    narx_rest(arrays, parameters, state, outputs)
    first = narx_size(arrays) + 3 + 3 * arrays[4].shape[0]
    x = state[first:]
    v = np.zeros(arrays[7].shape[1])
    t = np.empty(arrays[11].shape[0])
    ahead = np.empty(x.shape[0])
    for _ in range(int(arrays[17][0])):
        nss_next(arrays[6], arrays[7], arrays[8], arrays[9], arrays[10], arrays[11], arrays[12], x, v, t, ahead)
        x[:] = ahead
    for axis in range(2):
        echo_rest(arrays, state, axis, nss_output(arrays, x, axis))


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
    own = narx_size(arrays)
    q = state[own : own + 3]
    plays = state[own + 3 : own + 3 + 3 * arrays[4].shape[0]]
    x = state[own + 3 + 3 * arrays[4].shape[0] :]
    load_advance(arrays[2], state[3 * h : 3 * h + 3], q)
    v = np.empty(arrays[7].shape[1])
    late = 3 * h + 3 * int(arrays[5][0])
    nss_inputs(arrays[3], arrays[4], state[late : late + 3], plays, v)
    t = np.empty(arrays[11].shape[0])
    ahead = np.empty(x.shape[0])
    nss_next(arrays[6], arrays[7], arrays[8], arrays[9], arrays[10], arrays[11], arrays[12], x, v, t, ahead)
    x[:] = ahead
    angles = np.empty(2)
    for axis in range(2):
        angles[axis] = echo_added(arrays, arrays[16], state, axis, nss_output(arrays, x, axis))
    narx_advance(arrays, parameters, state, angles[0], angles[1], outputs)
    stalling_drives(arrays, arrays[2], q, state, outputs)
