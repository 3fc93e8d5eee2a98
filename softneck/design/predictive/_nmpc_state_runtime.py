"""What the nonlinear predictive controller remembers, what it is asked for, and what it expects its model to miss."""

import math

import numpy as np

NMPC_REFERENCE_LIMIT = 0.8
NMPC_MOTOR_LIMIT = 6.0
# No neck leans this far; whoever says so measures nothing.
NMPC_PLAUSIBLE = 1.3
NMPC_NO_BOUND = 1e30

# Head of the state.
NMPC_STARTED = 0
NMPC_ITERATIONS = 1
NMPC_STATUS = 2  # of the last sample: one of the numbers below
NMPC_SHIFTED = 3  # samples on which the shifted previous plan was used
NMPC_SOFTENED = 4  # samples on which a soft limit could not be kept
NMPC_MISSED = 5  # samples in a row without a measurement
NMPC_RESIDUAL = 6  # of the KKT conditions, last answer
NMPC_HELD = 7
NMPC_OPTIMAL = 1.0
NMPC_SOFT = 2.0
NMPC_PLAN = 3.0
NMPC_HOLDING = 4.0

# arrays[0], by place.
NMPC_TS = 0
NMPC_N = 1
NMPC_WINDOW = 2
NMPC_AHEAD = 3
NMPC_LEAD = 4
NMPC_KEEP = 5
NMPC_MOVE = 6
NMPC_COCONTRACTION = 7
NMPC_SLACK = 8  # weight; zero for no soft limit
NMPC_ANGLE_LIMIT = 9
NMPC_BUDGET = 10
NMPC_CONVERGED = 11
NMPC_COAST = 12
NMPC_SETTLE = 13
NMPC_OUTPUTS = 14  # of the model


def nmpc_places(arrays: tuple[np.ndarray, ...], size: int) -> tuple[int, int, int, int, int, int, int]:
    """Return where references to come, model, angles, misses, plan and active rows begin, and the end.

    Args:
        arrays: of the controller.
        size: of the model's state.
    """
    nz = 3 * arrays[1].shape[0]
    ahead = NMPC_HELD + 9
    x = ahead + 2 * int(arrays[0][NMPC_AHEAD])
    y = x + size
    missed = y + 2
    plan = missed + 2 * int(arrays[0][NMPC_WINDOW])
    active = plan + nz
    rows = 2 * nz
    if arrays[0][NMPC_SLACK] > 0.0:
        rows += 1 + 4 * arrays[1].shape[0]
    return ahead, x, y, missed, plan, active, active + rows


def nmpc_plausible(angle: float) -> bool:
    """Return whether an angle is one that a neck can have."""
    return math.isfinite(angle) and abs(angle) < NMPC_PLAUSIBLE


def nmpc_listen(arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray, first: bool) -> None:
    """Take in the references; one that is not finite leaves what was."""
    seen = state[NMPC_HELD + 6 : NMPC_HELD + 9]
    for i in range(3):
        if math.isfinite(inputs[i]):
            limit = NMPC_REFERENCE_LIMIT if i < 2 else NMPC_MOTOR_LIMIT
            seen[i] = min(max(inputs[i], -limit), limit)
    H = int(arrays[0][NMPC_AHEAD])
    for axis in range(2):
        if H > 0:
            start = NMPC_HELD + 9 + axis * H
            row = state[start : start + H]
            if first:
                row[:] = seen[axis]
            for i in range(H - 1):
                row[i] = row[i + 1]
            value = inputs[10 + axis]
            if math.isfinite(value):
                row[H - 1] = min(max(value, -NMPC_REFERENCE_LIMIT), NMPC_REFERENCE_LIMIT)


def nmpc_asked(arrays: tuple[np.ndarray, ...], state: np.ndarray, target: np.ndarray, asked: np.ndarray) -> None:
    """Move the reference filters on; fill the filtered references to come (2 N,) and the moves they ask for (nz,)."""
    q, slopes, inverse = arrays[0], arrays[6], arrays[7]
    H, lead, keep = int(q[NMPC_AHEAD]), int(q[NMPC_LEAD]), q[NMPC_KEEP]
    filtered = state[NMPC_HELD + 3 : NMPC_HELD + 6]
    seen = state[NMPC_HELD + 6 : NMPC_HELD + 9]
    first = NMPC_HELD + 9
    rows = slopes.shape[1]
    path = np.empty(rows)
    asked[:] = 0.0
    for i in range(3):
        now = seen[i]
        if i < 2 and H > 0 and lead > 0:
            now = state[first + i * H + lead - 1]
        filtered[i] = keep * filtered[i] + (1.0 - keep) * now
    for axis in range(2):
        value = filtered[axis]
        for i in range(rows):
            wanted = state[first + axis * H + int(arrays[8][i])] if H > 0 else seen[axis]
            value = keep * value + (1.0 - keep) * wanted
            path[i] = value
            if 2 * i + axis < target.shape[0]:
                target[2 * i + axis] = value
        for b in range(slopes.shape[0]):
            move = np.dot(slopes[b], path)
            for j in range(3):
                asked[3 * b + j] += inverse[j, axis] * move


def nmpc_ahead(arrays: tuple[np.ndarray, ...], missed: np.ndarray, ahead: np.ndarray) -> None:
    """Fill what the model will miss (2 N,), from what it missed (window, 2)."""
    gains, future = arrays[4], arrays[5]
    for axis in range(2):
        level = 0.0
        rate = 0.0
        for i in range(gains.shape[1]):
            level += gains[0, i] * missed[2 * i + axis]
            rate += gains[1, i] * missed[2 * i + axis]
        for i in range(future.shape[0]):
            ahead[2 * i + axis] = future[i, 0] * level + future[i, 1] * rate


def nmpc_shift(starts: np.ndarray, plan: np.ndarray) -> None:
    """Make the plan that of the next sample: what is planned for one sample later becomes first."""
    b = starts.shape[0]
    before = plan.copy()
    for j in range(3):
        last = 0.0
        for i in range(b):
            # Position one sample after this start, relative to what is held now.
            now = 0.0
            for c in range(1, b):
                if starts[c] <= starts[i] + 1.0:
                    now += before[3 * c + j]
            plan[3 * i + j] = now - last
            last = now
