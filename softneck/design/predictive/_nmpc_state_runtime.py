"""State of the nonlinear predictive controller: inputs, references, and predicted model errors.

All but the model's state is in scaled quantities (see `_scaled_runtime`).
"""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, rest, value

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
NMPC_COAST = 11
NMPC_SETTLE = 12
NMPC_OUTPUTS = 13  # of the model
NMPC_TAUT = 14  # least tautness wished for; -NMPC_NO_BOUND for none
NMPC_LEVER = 15  # motor that one radian of neck takes up [rad/rad]
NMPC_LOOK = 16  # samples by which what is measured is ahead of the sensor
# Behind them what `_scaled_runtime` says.
NMPC_NUMBERS = 17


def nmpc_slacks(setup: np.ndarray) -> int:
    """Return 1 if the angles have a soft limit, else 0."""
    return 1 if setup[NMPC_SLACK] > 0.0 else 0


def nmpc_outputs(T: np.ndarray) -> int:
    """Return the number of outputs: the redefined inputs are one more, co-contraction."""
    return T.shape[0] - 1


def nmpc_motors(T: np.ndarray) -> int:
    """Return the number of motors."""
    return T.shape[1]


class NmpcArrays(Arrays):
    """Those of the model follow."""

    setup = array("numbers", "numbers of the problem, at the places NMPC_TS to NMPC_NUMBERS")
    starts = array("moves", "samples at which the motors may move")
    T = array("references, motors", "of Eq. 9-11: motors to redefined inputs")
    levels = array("kept, motors", "co-contraction, and what else of the motors moves no output and is kept at zero")
    weights = array("N, outputs", "on angle errors [1/rad^2]")
    gains = array("2, window", "what was missed to its level and rate")
    future = array("N, 2", "what level and rate of it make of each sample to come")
    slopes = array("moves, path", "references to come to moves of the redefined inputs")
    inverse = array("motors, outputs", "of T, by the static gains")
    asked_at = array("path", "which of the references to come each sample asks for")
    free = array("parameters", "of the model in free run")
    N = value("setup", NMPC_N)
    H = value("setup", NMPC_AHEAD)
    lead = value("setup", NMPC_LEAD)
    look = value("setup", NMPC_LOOK)
    slacks = value("setup", function=nmpc_slacks)
    outputs = value("T", function=nmpc_outputs, written=True)
    motors = value("T", function=nmpc_motors, written=True)


class NmpcState(StateVector):
    """Held inputs, references, model errors and plan; the model's own state follows."""

    started = cells("", "whether a sample came yet")
    iterations = cells("", "of the QP solver in the last sample")
    status = cells("", "of the last sample: NMPC_OPTIMAL to NMPC_HOLDING, 0 before the first")
    shifted = cells("", "samples on which the previous plan went on")
    softened = cells("", "samples on which a soft limit could not be kept")
    lost = cells("", "samples in a row without a measurement")
    residual = cells("", "of the KKT conditions, last answer")
    held = cells("motors", "set-points [rad]")
    filtered = cells("outputs + 1", "references behind their filter [rad]")
    seen = cells("outputs + 1", "references last seen [rad]")
    ahead = cells("outputs, H", "references to come [rad]")
    angles = cells("outputs", "of the model now, or as far ahead as the observer looks [rad]")
    missed = cells("window, outputs", "what measurements were above the model, newest first [rad]")
    plan = cells("motors * moves", "moves of the motors [rad]")
    active = cells(
        "2 * motors * moves + slacks * (1 + 2 * outputs * moves)", "sign of each row of the QP that is active"
    )
    model = rest("state of the model")


def nmpc_common(p: NmpcArrays, x: NmpcState) -> float:
    """Return the wanted co-contraction [rad]: its reference, or more to keep the loosest tendon taut.

    Where the neck is asked to lean, not where it is measured: no noise goes into the tendons.
    """
    wanted = x.filtered[p.outputs]
    if p.setup[NMPC_TAUT] > -NMPC_NO_BOUND:
        short = -NMPC_NO_BOUND
        for j in range(p.motors):
            lean = 0.0
            for axis in range(p.outputs):
                lean += p.T[axis, j] * x.filtered[axis]
            short = max(short, p.setup[NMPC_TAUT] + p.setup[NMPC_LEVER] * lean - x.held[j])
        # All motors pull by what the loosest tendon lacks, or let go by what it has to spare.
        wanted = max(wanted, np.dot(p.T[p.outputs], x.held) + short)
    return wanted


def nmpc_asked(p: NmpcArrays, x: NmpcState, target: np.ndarray, asked: np.ndarray) -> None:
    """Move the filters on; fill the filtered references to come (outputs N,), and the moves they ask for (nz,)."""
    keep = p.setup[NMPC_KEEP]
    path = np.empty(p.path)
    asked[:] = 0.0
    for i in range(p.outputs + 1):
        now = x.seen[i]
        if i < p.outputs and p.H > 0 and p.lead > 0:
            now = x.ahead[i, p.lead - 1]  # as many samples early as the filter makes late
        x.filtered[i] = keep * x.filtered[i] + (1.0 - keep) * now
    for axis in range(p.outputs):
        filtered = x.filtered[axis]
        for i in range(p.path):
            wanted = x.ahead[axis, int(p.asked_at[i])] if p.H > 0 else x.seen[axis]  # no preview: it stays
            filtered = keep * filtered + (1.0 - keep) * wanted
            path[i] = filtered
            if p.outputs * i + axis < target.shape[0]:
                target[p.outputs * i + axis] = filtered
        for b in range(p.moves):
            move = np.dot(p.slopes[b], path)
            for j in range(p.motors):
                asked[p.motors * b + j] += p.inverse[j, axis] * move  # T^-1 over the static gains


def nmpc_ahead(p: NmpcArrays, x: NmpcState, ahead: np.ndarray) -> None:
    """Fill the predicted model errors (outputs N,) from past ones."""
    for axis in range(p.outputs):
        # o and r of now, by least squares over the window (see `estimate_gains`).
        level = 0.0
        rate = 0.0
        for i in range(p.gains.shape[1]):
            level += p.gains[0, i] * x.missed[i, axis]
            rate += p.gains[1, i] * x.missed[i, axis]
        for i in range(p.future.shape[0]):
            # o_i = o + r (1 + a + ...): the same disturbance as the linear controller's.
            ahead[p.outputs * i + axis] = p.future[i, 0] * level + p.future[i, 1] * rate


def nmpc_take(p: NmpcArrays, x: NmpcState, z: np.ndarray, sign: np.ndarray, answered: bool, slack: float) -> None:
    """Make an answer the plan; without one the previous plan goes on."""
    if answered:
        x.plan[:] = z
        x.active[:] = sign
        # 1e-6 rad is no violation that anybody could measure.
        x.status = NMPC_SOFT if slack > 1e-6 else NMPC_OPTIMAL
        if slack > 1e-6:
            x.softened += 1.0
    else:
        x.active[:] = 0.0
        x.status = NMPC_PLAN
        x.shifted += 1.0


def nmpc_shift(starts: np.ndarray, plan: np.ndarray) -> None:
    """Shift the plan by one sample."""
    b = starts.shape[0]
    motors = plan.shape[0] // b
    before = plan.copy()
    for j in range(motors):
        last = 0.0
        for i in range(b):
            # Position one sample after this start, relative to what is held now.
            now = 0.0
            # The first move is in `held` already: the sum begins at 1.
            for c in range(1, b):
                if starts[c] <= starts[i] + 1.0:
                    now += before[motors * c + j]
            plan[motors * i + j] = now - last
            last = now
