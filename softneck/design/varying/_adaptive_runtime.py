"""Indirect adaptive control of both axes: what the neck is, learnt as it moves, and the gains that follow from it.

Each axis is y+ = a y + b u(k-d) with the delay d known. Its a and b are estimated by recursive least squares in the
kit's U D U' form on angles and inputs behind one band-pass, (1 - z^-1) / (1 - f z^-1)^2, which takes out offsets and
what the model does not describe (Astrom and Wittenmark 1995, Adaptive Control, sec. 11.5). From them follows in every
sample

    v = ((1 - a) rf + kappa (ym - y)) / b + s,      s+ = s + kappa (1 - a) / b (ym - y),
    ym = z^-d (1 - a) / (z - a) rf:

IMC with the delay in full, for the loop is kappa z^-d / (z - 1) whatever a and b are.

What keeps it safe: nothing is learnt where the errors are within a dead zone, the band-passed input is too small, or a
neck is not healthy or not enabled; the covariance is bounded, poles are kept stable, a and the static gain within a
box; the gains move at a bounded rate; and where the estimate predicts worse than the nominal plant, the nominal one
is used and the learning begins again.

Arrays: 0 to 3 Af, Bf, Cf, Df; 4 to 7 rest, T, T_inverse, constants (sample time); 8 nominal a, b of each axis; 9 box
(2, 4) of a and of the static gain; 10 delays; 11 kappa of each axis; 12 guards, see ADAPTIVE_*.
State vector: xf (m,), x (2 (d + 2),), set-points held (3,), memory of each axis, whether started.
Memory of an axis: theta (2), U' - I (4), D (2), tally (4), a and b in use (2), band-pass (6), line (d + 1), tail (4).
"""

import math

import numpy as np

from softneck.design.linear._linear_parts_runtime import linear_control, linear_reference
from softneck.identification.linear._ud_runtime import ud_guarded

# Guards: forgetting, bound on the trace of F, dead zone [rad], bound on the pole, least input [rad], memory f, how much
# worse than the nominal plant an estimate may predict, change of a gain in one sample, leak of the integral, F(0).
ADAPTIVE_FORGETTING, ADAPTIVE_BOUND, ADAPTIVE_DEAD_ZONE, ADAPTIVE_RADIUS, ADAPTIVE_EXCITED = 0, 1, 2, 3, 4
ADAPTIVE_FILTER, ADAPTIVE_DISTRUST, ADAPTIVE_RATE, ADAPTIVE_LEAK, ADAPTIVE_START = 5, 6, 7, 8, 9
# Places in the memory of an axis.
ADAPTIVE_TALLY, ADAPTIVE_USED, ADAPTIVE_BAND, ADAPTIVE_LINE = 8, 12, 14, 20
ADAPTIVE_TAIL = 4
# Memory of the averages that judge excitation and predictions: 1 s at 20 ms.
ADAPTIVE_AVERAGE = 0.98


def adaptive_longest(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the longer delay [samples]."""
    return int(max(arrays[10][0], arrays[10][1]))


def adaptive_memory(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of an axis' memory."""
    return ADAPTIVE_LINE + adaptive_longest(arrays) + 1 + ADAPTIVE_TAIL


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return arrays[0].shape[0] + 2 * (adaptive_longest(arrays) + 2) + 3 + 2 * adaptive_memory(arrays) + 1


def initialise(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Start with motors at rest and the nominal plant."""
    state[:] = 0.0
    size = adaptive_memory(arrays)
    for axis in range(2):
        start = state.shape[0] - 1 - (2 - axis) * size
        memory = state[start : start + size]
        adaptive_forget(arrays, axis, memory)
        memory[ADAPTIVE_USED : ADAPTIVE_USED + 2] = arrays[8][axis]
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Learn from the angles of now, redesign, and compute the set-points; ports as of the linear controller.

    parameters: those of the linear controller, and whether to adapt at all (0 or 1).
    """
    m, n = arrays[0].shape[0], 2 * (adaptive_longest(arrays) + 2)
    size = adaptive_memory(arrays)
    held = state[m + n : m + n + 3]
    if state[-1] == 0.0:
        held[:] = inputs[5:8]
    active = inputs[8] > 0.5 and inputs[9] > 0.5
    for axis in range(2):
        start = m + n + 3 + axis * size
        memory = state[start : start + size]
        if active and state[-1] > 0.5:
            if parameters[5] > 0.5:
                adaptive_learn(arrays, axis, memory, inputs[3 + axis])
            before = adaptive_asked(arrays, parameters, axis, memory, state, inputs)
            adaptive_redesign(arrays, axis, memory, parameters[5] > 0.5)
            # New gains move no motor: the integral takes up what they would have changed.
            change = adaptive_asked(arrays, parameters, axis, memory, state, inputs) - before
            state[m + axis * (n // 2)] -= change
        adaptive_see(arrays, memory, inputs[3 + axis], active and state[-1] > 0.5)
    now = adaptive_arrays(arrays, state, m + n + 3, size)
    if state[-1] == 0.0 or not active:
        adaptive_align(arrays, now, state, inputs[3:5])
    state[-1] = 1.0
    if active:
        linear_control(now, parameters, state, inputs)
    v = np.dot(arrays[5], held)
    for axis in range(2):
        start = m + n + 3 + axis * size
        adaptive_push(arrays, state[start : start + size], v[axis], active)
    outputs[:] = held


def adaptive_forget(arrays: tuple[np.ndarray, ...], axis: int, memory: np.ndarray) -> None:
    """Set the estimate back to the nominal plant."""
    memory[0] = -arrays[8][axis, 0]
    memory[1] = arrays[8][axis, 1]
    memory[2:6] = 0.0
    memory[6:8] = arrays[12][ADAPTIVE_START]
    memory[ADAPTIVE_TALLY : ADAPTIVE_TALLY + 4] = 0.0


def adaptive_learn(arrays: tuple[np.ndarray, ...], axis: int, memory: np.ndarray, y: float) -> None:
    """Take the angle of now in, unless it says too little; compare the estimate with the nominal plant."""
    guards, band = arrays[12], memory[ADAPTIVE_BAND : ADAPTIVE_BAND + 6]
    tail = memory.shape[0] - ADAPTIVE_TAIL
    f = guards[ADAPTIVE_FILTER]
    first = f * band[1] + (y - band[0])
    target = f * band[2] + first
    past = memory[ADAPTIVE_LINE + int(arrays[10][axis])]
    # The band-passed input of the last second, and whether all of the line has been filled since the last stop.
    memory[tail] = ADAPTIVE_AVERAGE * memory[tail] + (1.0 - ADAPTIVE_AVERAGE) * past * past
    filled = memory[tail + 3] > adaptive_longest(arrays) + 2.0 / (1.0 - f)
    excited = math.sqrt(memory[tail]) > guards[ADAPTIVE_EXCITED]
    if not (filled and excited):
        return
    a, b = arrays[8][axis, 0], arrays[8][axis, 1]
    error = target + memory[0] * band[2] - memory[1] * past
    nominal = target - a * band[2] - b * past
    memory[tail + 1] = ADAPTIVE_AVERAGE * memory[tail + 1] + (1.0 - ADAPTIVE_AVERAGE) * error * error
    memory[tail + 2] = ADAPTIVE_AVERAGE * memory[tail + 2] + (1.0 - ADAPTIVE_AVERAGE) * nominal * nominal
    adaptive_update(guards, memory, -band[2], past, target)
    adaptive_confine(arrays[9][axis], memory)
    floor = guards[ADAPTIVE_DEAD_ZONE] * guards[ADAPTIVE_DEAD_ZONE]
    worse = memory[tail + 1] > guards[ADAPTIVE_DISTRUST] * memory[tail + 2] + floor
    if worse or not (math.isfinite(memory[0]) and math.isfinite(memory[1]) and math.isfinite(memory[6] + memory[7])):
        adaptive_forget(arrays, axis, memory)
        memory[tail + 1] = memory[tail + 2]


def adaptive_update(
    guards: np.ndarray, memory: np.ndarray, past_angle: float, past_input: float, target: float
) -> None:
    """Let the kit's guarded recursion take one row in."""
    row = np.empty((1, 2))
    row[0, 0] = past_angle
    row[0, 1] = past_input
    rules = np.array(
        [guards[ADAPTIVE_FORGETTING], guards[ADAPTIVE_BOUND], guards[ADAPTIVE_DEAD_ZONE], 1.0, guards[ADAPTIVE_RADIUS]]
    )
    factor = memory[2:6].reshape((2, 2))
    tally = memory[ADAPTIVE_TALLY : ADAPTIVE_TALLY + 4]
    ud_guarded(row, np.array([target]), memory[0:2], factor, memory[6:8], rules, tally, np.empty((0, 5)))


def adaptive_confine(box: np.ndarray, memory: np.ndarray) -> None:
    """Put the estimate back into the box of pole and static gain."""
    a = min(max(-memory[0], box[0]), box[1])
    memory[0] = -a
    memory[1] = min(max(memory[1], box[2] * (1.0 - a)), box[3] * (1.0 - a))


def adaptive_redesign(arrays: tuple[np.ndarray, ...], axis: int, memory: np.ndarray, adapt: bool) -> None:
    """Move 1 - a and b in use towards the estimate, or the nominal plant, by no more than the rate allows."""
    rate = arrays[12][ADAPTIVE_RATE]
    a, b = arrays[8][axis, 0], arrays[8][axis, 1]
    if adapt:
        a, b = -memory[0], memory[1]
    used = memory[ADAPTIVE_USED : ADAPTIVE_USED + 2]
    lag = 1.0 - used[0]
    gain = used[1] / lag
    lag = min(max(1.0 - a, lag * (1.0 - rate)), lag * (1.0 + rate))
    target = b / (1.0 - a)
    # The gain may be negative where tendons are mounted the other way round; its sign is the nominal one.
    size = min(max(abs(target), abs(gain) * (1.0 - rate)), abs(gain) * (1.0 + rate))
    used[0] = 1.0 - lag
    used[1] = math.copysign(size, gain) * lag


def adaptive_asked(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    axis: int,
    memory: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
) -> float:
    """Return what the gains in use ask for, without the integral."""
    m = arrays[0].shape[0]
    rf = linear_reference(arrays, parameters, state[:m], inputs)[axis]
    ym = state[m + axis * (adaptive_longest(arrays) + 2) + 1 + int(arrays[10][axis])]
    a, b = memory[ADAPTIVE_USED], memory[ADAPTIVE_USED + 1]
    return float(((1.0 - a) * rf + arrays[11][axis] * (ym - inputs[3 + axis])) / b)


def adaptive_see(arrays: tuple[np.ndarray, ...], memory: np.ndarray, y: float, going: bool) -> None:
    """Advance the band-pass of the angle; after a stop it begins at rest where the neck is."""
    f = arrays[12][ADAPTIVE_FILTER]
    band = memory[ADAPTIVE_BAND : ADAPTIVE_BAND + 6]
    if going:
        band[1] = f * band[1] + (y - band[0])
        band[2] = f * band[2] + band[1]
    else:
        band[1] = 0.0
        band[2] = 0.0
    band[0] = y


def adaptive_push(arrays: tuple[np.ndarray, ...], memory: np.ndarray, u: float, going: bool) -> None:
    """Put the band-passed input of now into the line."""
    f = arrays[12][ADAPTIVE_FILTER]
    band = memory[ADAPTIVE_BAND : ADAPTIVE_BAND + 6]
    tail = memory.shape[0] - ADAPTIVE_TAIL
    line = memory[ADAPTIVE_LINE:tail]
    if not going or memory[tail + 3] == 0.0:
        band[4] = 0.0
        band[5] = 0.0
        line[:] = 0.0
        memory[tail + 3] = 1.0 if going else 0.0
    else:
        band[4] = f * band[4] + (u - band[3])
        band[5] = f * band[5] + band[4]
        memory[tail + 3] += 1.0
    band[3] = u
    for i in range(line.shape[0] - 1, 0, -1):
        line[i] = line[i - 1]
    line[0] = band[5]


def adaptive_arrays(arrays: tuple[np.ndarray, ...], state: np.ndarray, first: int, size: int) -> tuple[np.ndarray, ...]:
    """Return the arrays of the linear controller for a and b in use."""
    longest = adaptive_longest(arrays)
    n = longest + 2
    A, Br, By = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2)), np.zeros((2 * n, 2))
    C, Dr, Dy, L = np.zeros((2, 2 * n)), np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2 * n, 2))
    for axis in range(2):
        used = first + axis * size + ADAPTIVE_USED
        a, b, kappa = state[used], state[used + 1], arrays[11][axis]
        o = axis * n
        seen = o + 1 + int(arrays[10][axis])
        A[o, o] = 1.0
        A[o, seen] = kappa * (1.0 - a) / b
        A[o + 1, o + 1] += a
        for i in range(2, n):
            A[o + i, o + i - 1] = 1.0
        Br[o + 1, axis] = 1.0 - a
        By[o, axis] = -kappa * (1.0 - a) / b
        C[axis, o] = 1.0
        C[axis, seen] += kappa / b
        Dr[axis, axis] = (1.0 - a) / b
        Dy[axis, axis] = -kappa / b
        L[o, axis] = arrays[12][ADAPTIVE_LEAK]
        L[o + 1, axis] = b
    unused = np.zeros((2 * n, 4))
    return (
        arrays[0], arrays[1], arrays[2], arrays[3], A, Br, By, C, Dr, Dy, L, unused,
        arrays[4], arrays[5], arrays[6], arrays[7],
    )  # fmt: skip


def adaptive_align(
    arrays: tuple[np.ndarray, ...], now: tuple[np.ndarray, ...], state: np.ndarray, y: np.ndarray
) -> None:
    """Let the model rest where the neck is, and the integral ask for what is held besides: no bump."""
    m, n = arrays[0].shape[0], adaptive_longest(arrays) + 2
    v = np.dot(arrays[5], state[m + 2 * n : m + 2 * n + 3])
    rest = np.empty(3)
    rest[:2] = y
    rest[2] = v[2]
    state[:m] = np.dot(arrays[4], rest)
    for axis in range(2):
        o = m + axis * n
        state[o + 1 : o + n] = y[axis]
        state[o] = v[axis] - now[8][axis, axis] * y[axis]
