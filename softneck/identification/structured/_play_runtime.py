"""Play operators and low-pass filters, polynomials of them, and a linear echo of what was measured.

Arrays: H, drive, load, redefinition, widths, chain, table (n, 3), weights (2, n), range (2, 2), echo (2, p),
memory (samples after which a held start has settled). State: that of `_histories_runtime`, then q (3), plays, bank.
The histories hold the measured output less the feed-forward part f, else the echo itself: y(k+1) = f(k+1) +
sum_i echo_i (y - f)(k+1-i). f has no feedback at all and is kept within `range`; the echo is a stable filter that
dies out when nothing is measured. So no free run can diverge.
"""

import numpy as np

from softneck.identification.models._bank_runtime import bank_advance, load_advance, monomial
from softneck.identification.models._feedforward_runtime import echo_added, echo_rest, stalling_drives
from softneck.identification.models._histories_runtime import narx_advance, narx_observe, narx_rest, narx_size


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    count = arrays[4].shape[0]
    return narx_size(arrays) + 3 + 3 * count + 3 * (count + 1) * int(arrays[5][1])


def play_output(arrays: tuple[np.ndarray, ...], bank: np.ndarray, axis: int) -> float:
    """Return the feed-forward part f of one axis."""
    y = 0.0
    for i in range(arrays[6].shape[0]):
        y += arrays[7][axis, i] * monomial(arrays[6], i, bank)
    return min(max(y, arrays[8][axis, 0]), arrays[8][axis, 1])


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the output at its start value; what that is above f is remembered as measured."""
    narx_rest(arrays, parameters, state, outputs)
    bank = state[narx_size(arrays) + 3 + 3 * arrays[4].shape[0] :]
    for axis in range(2):
        echo_rest(arrays, state, axis, play_output(arrays, bank, axis))


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
    q = state[narx_size(arrays) : narx_size(arrays) + 3]
    plays = state[narx_size(arrays) + 3 : narx_size(arrays) + 3 + 3 * arrays[4].shape[0]]
    bank = state[narx_size(arrays) + 3 + 3 * arrays[4].shape[0] :]
    m = state[3 * h : 3 * h + 3]
    load_advance(arrays[2], m, q)
    bank_advance(arrays[3], arrays[4], arrays[5], m, plays, bank)
    angles = np.empty(2)
    for axis in range(2):
        angles[axis] = echo_added(arrays, arrays[9], state, axis, play_output(arrays, bank, axis))
    narx_advance(arrays, parameters, state, angles[0], angles[1], outputs)
    stalling_drives(arrays, arrays[2], q, state, outputs)
