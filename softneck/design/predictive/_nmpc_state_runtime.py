"""What the nonlinear predictive controller remembers, what it is asked for, and what it expects its model to miss."""

import math

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, rest, value

NMPC_REFERENCE_LIMIT = 0.8  # [rad], as the ports' min and max
NMPC_MOTOR_LIMIT = 6.0  # [rad], the paper's largest rotation (section 3.1)
# No neck leans this far; whoever says so measures nothing.
NMPC_PLAUSIBLE = 1.3
NMPC_NO_BOUND = 1e30

# Status of the last sample.
NMPC_OPTIMAL = 1.0
NMPC_SOFT = 2.0
NMPC_PLAN = 3.0
NMPC_HOLDING = 4.0

# Places in `setup`.
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


def nmpc_slacks(setup: np.ndarray) -> int:
    """Return 1 if the angles have a soft limit, else 0."""
    return 1 if setup[NMPC_SLACK] > 0.0 else 0


class NmpcArrays(Arrays):
    """Those of the model follow."""

    setup = array("15", "numbers of the problem, at the places NMPC_TS to NMPC_OUTPUTS")
    starts = array("moves", "samples at which the motors may move")
    T = array("3, 3", "of Eq. 9-11: motors to redefined inputs")
    weights = array("N, 2", "on angle errors [1/rad^2]")
    gains = array("2, window", "what was missed to its level and rate")
    future = array("N, 2", "what level and rate of it make of each sample to come")
    slopes = array("moves, path", "references to come to moves of the redefined inputs")
    inverse = array("3, 2", "of T, by the static gains")
    asked_at = array("path", "which of the references to come each sample asks for")
    free = array("parameters", "of the model in free run")
    N = value("setup", NMPC_N)
    H = value("setup", NMPC_AHEAD)
    lead = value("setup", NMPC_LEAD)
    slacks = value("setup", function=nmpc_slacks)


class NmpcState(StateVector):
    """What is held, asked, missed and planned; the model's own state follows."""

    started = cells("", "whether a sample came yet")
    iterations = cells("", "of the QP solver in the last sample")
    status = cells("", "of the last sample: NMPC_OPTIMAL to NMPC_HOLDING, 0 before the first")
    shifted = cells("", "samples on which the previous plan went on")
    softened = cells("", "samples on which a soft limit could not be kept")
    lost = cells("", "samples in a row without a measurement")
    residual = cells("", "of the KKT conditions, last answer")
    held = cells("3", "set-points [rad]")
    filtered = cells("3", "references behind their filter [rad]")
    seen = cells("3", "references last seen [rad]")
    ahead = cells("2, H", "references to come [rad]")
    angles = cells("2", "of the model now [rad]")
    missed = cells("window, 2", "what measurements were above the model, newest first [rad]")
    plan = cells("3 * moves", "moves of the motors [rad]")
    active = cells("6 * moves + slacks * (1 + 4 * moves)", "sign of each row of the QP that is active")
    model = rest("state of the model")


def nmpc_plausible(angle: float) -> bool:
    """Return whether an angle is one that a neck can have."""
    return math.isfinite(angle) and abs(angle) < NMPC_PLAUSIBLE


def nmpc_listen(p: NmpcArrays, x: NmpcState, inputs: np.ndarray, first: bool) -> None:
    """Take in the references; one that is not finite leaves what was."""
    for i in range(3):
        if math.isfinite(inputs[i]):
            limit = NMPC_REFERENCE_LIMIT if i < 2 else NMPC_MOTOR_LIMIT
            x.seen[i] = min(max(inputs[i], -limit), limit)
    for axis in range(2):
        if p.H > 0:
            row = x.ahead[axis]
            if first:
                row[:] = x.seen[axis]
            for i in range(p.H - 1):
                row[i] = row[i + 1]
            newest = inputs[10 + axis]
            if math.isfinite(newest):
                row[p.H - 1] = min(max(newest, -NMPC_REFERENCE_LIMIT), NMPC_REFERENCE_LIMIT)


def nmpc_asked(p: NmpcArrays, x: NmpcState, target: np.ndarray, asked: np.ndarray) -> None:
    """Move the reference filters on; fill the filtered references to come (2 N,) and the moves they ask for (nz,)."""
    keep = p.setup[NMPC_KEEP]
    path = np.empty(p.path)
    asked[:] = 0.0
    for i in range(3):
        now = x.seen[i]
        if i < 2 and p.H > 0 and p.lead > 0:
            now = x.ahead[i, p.lead - 1]  # as many samples early as the filter makes late
        x.filtered[i] = keep * x.filtered[i] + (1.0 - keep) * now
    for axis in range(2):
        filtered = x.filtered[axis]
        for i in range(p.path):
            wanted = x.ahead[axis, int(p.asked_at[i])] if p.H > 0 else x.seen[axis]  # no preview: it stays
            filtered = keep * filtered + (1.0 - keep) * wanted
            path[i] = filtered
            if 2 * i + axis < target.shape[0]:
                target[2 * i + axis] = filtered
        for b in range(p.moves):
            move = np.dot(p.slopes[b], path)
            for j in range(3):
                asked[3 * b + j] += p.inverse[j, axis] * move  # T^-1 over the static gains


def nmpc_ahead(p: NmpcArrays, x: NmpcState, ahead: np.ndarray) -> None:
    """Fill what the model will miss (2 N,), from what it missed."""
    for axis in range(2):
        # o and r of now, by least squares over the window (see `estimate_gains`).
        level = 0.0
        rate = 0.0
        for i in range(p.gains.shape[1]):
            level += p.gains[0, i] * x.missed[i, axis]
            rate += p.gains[1, i] * x.missed[i, axis]
        for i in range(p.future.shape[0]):
            # o_i = o + r (1 + a + ...): the same disturbance as the linear controller's.
            ahead[2 * i + axis] = p.future[i, 0] * level + p.future[i, 1] * rate


def nmpc_shift(starts: np.ndarray, plan: np.ndarray) -> None:
    """Make the plan that of the next sample: what is planned for one sample later becomes first."""
    b = starts.shape[0]
    before = plan.copy()
    for j in range(3):
        last = 0.0
        for i in range(b):
            # Position one sample after this start, relative to what is held now.
            now = 0.0
            # The first move is in `held` already: the sum begins at 1.
            for c in range(1, b):
                if starts[c] <= starts[i] + 1.0:
                    now += before[3 * c + j]
            plan[3 * i + j] = now - last
            last = now
