"""State of a predictive controller and its update: models, disturbances, references, past inputs.

Each axis has a model `x+ = A x + B v(k - d)`, `y = x[0] + o` that runs on the inputs alone; v is the redefined input of
the axis, of a coupled plant those of all axes: B and `rest` have n columns for each. The output disturbance o follows
what was measured: `o+ = o + r`, `r+ = a r` with a the plant's slowest pole: what a load at the plant's input makes of
the angle.

All this is in scaled quantities: `scaled_inputs` and `mpc_limits` come from SI.
"""

import math

import numpy as np

from softneck.design.predictive._scaled_runtime import scaled_listen, scaled_measured, scaled_unit
from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._products_runtime import product

MPC_NO_BOUND = 1e30

# Status of a sample.
MPC_OPTIMAL = 1.0
MPC_SOFT = 2.0
MPC_PLAN = 3.0
MPC_HOLDING = 4.0

# Numbers of `constants`, in this order; 2, 15 and 16 are those of what earlier versions had: 1, 0 and 0.
MPC_TS = 0
MPC_ROWS = 1
MPC_ORDER = 3
MPC_PAST = 4
MPC_MOVES = 5
MPC_SLACKS = 6
MPC_AHEAD = 7
MPC_LEAD = 8  # samples by which references are taken early, to make up for their filters
MPC_PAYLOAD = 9  # 1 where a payload is told
MPC_BUDGET = 10
MPC_TOLERANCE = 11
MPC_COAST = 12  # samples without measurement until the motors are held
MPC_ANGLE_AT = 13  # places of two parameters; those whose limit is not set are not there
MPC_TAUT_AT = 14
# Behind them what `_scaled_runtime` says, and the units of the redefined inputs in SI.
MPC_NUMBERS = 17

# Kinds of rows.
MPC_ROW_MOVE = 0.0
MPC_ROW_POSITION = 1.0
MPC_ROW_SLACK = 2.0
MPC_ROW_ANGLE_HIGH = 3.0
MPC_ROW_ANGLE_LOW = 4.0
MPC_ROW_TAUT = 5.0


def mpc_outputs(T: np.ndarray) -> int:
    """Return the number of outputs: the redefined inputs are one more, co-contraction."""
    return T.shape[0] - 1


def mpc_motors(T: np.ndarray) -> int:
    """Return the number of motors."""
    return T.shape[1]


class MpcArrays(Arrays):
    """The models, and the QP `min 1/2 z'Hz + (F theta)'z, lower <= A z + E theta <= upper`."""

    _z, _m = "motors * moves + slacks", "(references - 1)"
    _theta = f"{_m} * (n + 2) + {_m} * L + motors + 2"
    constants = array("numbers = 17 | 16 + 2 * motors + 4 * references", "see MPC_TS to MPC_NUMBERS")
    model_A = array(f"{_m} * n, n", "A of each model, below each other")
    model_B = array(f"{_m}, entries", "B of each model, one input behind the other")
    observer = array(f"{_m}, 3", "gains on o and r, and the pole a")
    rest = array(f"{_m}, entries", "x at rest under inputs of one")
    delays = array(_m, "d, dead times [samples]")
    disturbances = array(
        f"1, columns = {_m} + 1 | {_m} + 2", "zero for each output, the pole of its filter, where told the tautness"
    )
    filters = array("references", "poles of the reference filters")
    T = array("references, motors", "of Eq. 9-11: motors to redefined inputs")
    starts = array("moves", "samples of the horizon at which the motors move")
    K = array(f"{_z}, {_theta}", "-H^-1 F: the answer without limits")
    A = array(f"m, {_z}", "the rows that are limited")
    G = array("m, m", "A H^-1 A'")
    E = array(f"m, {_theta}", "what theta adds to the rows")
    kinds = array("m, 2", "of each row: its MPC_ROW_*, and the motor or axis that it is of")
    AH = array(f"m, {_z}", "A H^-1")
    H = array(f"{_z}, {_z}", "")
    F = array(f"{_z}, {_theta}", "")
    scale = array("1", "the largest entry of H, at least one")
    L = value("constants", MPC_ROWS)  # samples of which the reference is needed
    n = value("constants", MPC_ORDER)
    D = value("constants", MPC_PAST)  # the longest dead time
    moves = value("constants", MPC_MOVES)
    slacks = value("constants", MPC_SLACKS)
    ahead = value("constants", MPC_AHEAD)  # samples that the reference is known ahead
    lead = value("constants", MPC_LEAD)
    told = value("constants", MPC_PAYLOAD)
    outputs = value("T", function=mpc_outputs, written=True)
    motors = value("T", function=mpc_motors, written=True)


class MpcState(StateVector):
    """The state between samples."""

    started = cells("", "1 after the first sample")
    iterations = cells("", "of the last answer")
    status = cells("", "of the last sample: MPC_OPTIMAL to MPC_HOLDING")
    shifted = cells("", "samples on which the shifted previous plan was used")
    softened = cells("", "samples on which a soft limit could not be kept")
    missed = cells("", "samples in a row without a measurement")
    age = cells("", "of the plan [samples]")
    residual = cells("", "of the KKT conditions, last answer")
    slack = cells("", "the largest, last answer")
    held = cells("motors", "set-points of now [rad]")
    filtered = cells("outputs + 1", "references behind their filters [rad]")
    seen = cells("outputs + 1", "references last seen [rad]")
    payload = cells("2 * told", "payload [kg], and that behind its filter")
    models = cells("outputs, n", "x of each model")
    offsets = cells("outputs, 2", "o [rad] and r [rad/sample] of each model")
    past = cells("D, outputs", "inputs v, newest first [rad]")
    coming = cells("outputs, ahead", "references to come [rad]")
    plan = cells("motors * moves + slacks", "z: moves of the motors [rad], then slacks")
    active = cells("m", "1 for rows at their upper, -1 at their lower bound")


class MpcTheta(StateVector):
    """The parameter of the QP."""

    models = cells("outputs, n", "x(k + d) of each model")
    offsets = cells("outputs, 2", "o and r of each model")
    wanted = cells("outputs, L", "pitch and roll at k + 1 .. k + L [rad]")
    held = cells("motors", "set-points of now [rad]")
    cocontraction = cells("", "wanted [rad]")
    one = cells("", "1")


def mpc_limits(p: MpcArrays, x: MpcState, parameters: np.ndarray) -> np.ndarray:
    """Return the parameters scaled, but for the angles' limit, which each output scales.

    A payload that is told adds to the tautness that is wished for.
    """
    limits, taut = parameters.copy(), int(p.constants[MPC_TAUT_AT])
    unit = scaled_unit(p.constants, p.motors, p.outputs)
    for i in range(4):
        limits[i] /= unit
    if taut < limits.shape[0]:
        limits[taut] /= unit
    if p.told > 0:
        limits[taut] += p.disturbances[0, p.outputs + 1] * x.payload[1]
    return limits


def mpc_begin(p: MpcArrays, x: MpcState, inputs: np.ndarray) -> bool:
    """Update measurements and motors; return whether the motors may move."""
    flags = 2 * p.outputs + 1 + p.motors
    if x.started == 0.0:
        for j in range(p.motors):
            position = inputs[2 * p.outputs + 1 + j]
            x.held[j] = position if math.isfinite(position) else 0.0
    mpc_listen(p, x, inputs)
    measured = scaled_measured(p.constants, p.outputs, inputs)
    x.missed = 0.0 if measured else x.missed + 1.0
    active = inputs[flags] > 0.5 and inputs[flags + 1] > 0.5 and x.missed <= p.constants[MPC_COAST]
    if x.started == 0.0 or not active:
        mpc_align(p, x, inputs, measured)
    elif measured:
        mpc_correct(p, x, inputs)
    x.started = 1.0
    if active:
        mpc_filter(p, x)
    else:
        x.status = MPC_HOLDING
    return active  # pyright: ignore[reportReturnType]  (of numbers)


def mpc_listen(p: MpcArrays, x: MpcState, inputs: np.ndarray) -> None:
    """Update references and payload; a value that is not finite keeps the previous one."""
    scaled_listen(p.constants, p.motors, p.outputs, p.ahead, bool(x.started == 0.0), inputs, x.seen, x.coming)
    # Of the payload in `inputs`: behind the preview, where there is one.
    first = 2 * p.outputs + 3 + p.motors + (p.outputs if p.ahead > 0 else 0)
    if p.told > 0:
        value = inputs[first]
        x.payload[0] = value if math.isfinite(value) else x.payload[0]
        if x.started == 0.0:
            x.payload[1] = x.payload[0]


def mpc_align(p: MpcArrays, x: MpcState, inputs: np.ndarray, measured: bool) -> None:
    """Start as if the neck had always stood where it is under the held set-points: no bump."""
    v = product(p.T, x.held)
    for i in range(p.outputs):
        for j in range(p.n):
            x.models[i, j] = mpc_driven(p, p.rest, i, j, v)
        x.offsets[i, 0] = 0.0
        x.offsets[i, 1] = 0.0
        if measured:
            # What the angle is beyond that is a disturbance, there to stay.
            x.offsets[i, 0] = inputs[p.outputs + 1 + i] - x.models[i, 0]
        x.filtered[i] = x.models[i, 0] + x.offsets[i, 0]
    x.filtered[p.outputs] = v[p.outputs]
    for i in range(p.D):
        for axis in range(p.outputs):
            x.past[i, axis] = v[axis]
    x.plan[:] = 0.0
    x.active[:] = 0.0
    x.age = 0.0


def mpc_correct(p: MpcArrays, x: MpcState, inputs: np.ndarray) -> None:
    """Take the measured angles in."""
    for i in range(p.outputs):
        # x runs on its inputs alone: only o and r answer to what was measured.
        error = inputs[p.outputs + 1 + i] - x.models[i, 0] - x.offsets[i, 0]
        x.offsets[i, 0] += p.observer[i, 0] * error
        x.offsets[i, 1] += p.observer[i, 1] * error


def mpc_filter(p: MpcArrays, x: MpcState) -> None:
    """Step the reference filters, without a sample of delay."""
    for i in range(p.outputs + 1):
        a = p.filters[i]
        asked = x.seen[i]
        # As many samples early as the filter makes late.
        if i < p.outputs and p.ahead > 0 and p.lead > 0:
            asked = x.coming[i, min(p.lead, p.ahead) - 1]
        x.filtered[i] = a * x.filtered[i] + (1.0 - a) * asked


def mpc_driven(p: MpcArrays, gains: np.ndarray, i: int, j: int, v: np.ndarray) -> float:
    """Return the effect of the inputs v on state j of model i: of all axes if the plant is coupled."""
    if p.entries == p.n:
        return gains[i, j] * v[i]
    total = 0.0
    for axis in range(p.outputs):
        total += gains[i, axis * p.n + j] * v[axis]
    return total


def mpc_model(p: MpcArrays, i: int, v: np.ndarray, now: np.ndarray, after: np.ndarray) -> None:
    """Fill `after` with A x + B v of model i at x = `now`."""
    for j in range(p.n):
        total = mpc_driven(p, p.model_B, i, j, v)
        for k in range(p.n):
            total += p.model_A[i * p.n + j, k] * now[k]
        after[j] = total


def mpc_parameter(p: MpcArrays, x: MpcState, theta: MpcTheta) -> None:
    """Fill theta."""
    now, after = np.empty(p.n), np.empty(p.n)
    for i in range(p.outputs):
        now[:] = x.models[i]
        # The inputs of the dead time are given, oldest first.
        for back in range(int(p.delays[i]), 0, -1):
            mpc_model(p, i, x.past[back - 1], now, after)
            now[:] = after
        theta.models[i] = now
        theta.offsets[i, 0] = x.offsets[i, 0]
        theta.offsets[i, 1] = x.offsets[i, 1]
    for axis in range(p.outputs):
        a = p.filters[axis]
        value = x.filtered[axis]
        for i in range(1, p.L + 1):
            # No preview: the reference of now is taken to stay.
            asked = x.seen[axis]
            if p.ahead > 0:
                asked = x.coming[axis, min(i + p.lead, p.ahead) - 1]
            value = a * value + (1.0 - a) * asked
            theta.wanted[axis, i - 1] = value
    theta.held[:] = x.held
    theta.cocontraction = x.filtered[p.outputs]
    theta.one = 1.0


def mpc_predict(p: MpcArrays, x: MpcState) -> None:
    """Move models, past inputs, disturbances and the payload's filter on to the next sample."""
    v = product(p.T, x.held)
    now = np.empty(p.n)
    for i in range(p.outputs):
        back = int(p.delays[i])
        now[:] = x.models[i]
        if back > 0:
            mpc_model(p, i, x.past[back - 1], now, x.models[i])  # v(k - d)
        else:
            mpc_model(p, i, v, now, x.models[i])  # without dead time v of now
        # o first: r of now moves it (o+ = o + r, r+ = a r).
        x.offsets[i, 0] += x.offsets[i, 1]
        x.offsets[i, 1] *= p.observer[i, 2]
    for i in range(p.D - 1, 0, -1):
        for axis in range(p.outputs):
            x.past[i, axis] = x.past[i - 1, axis]
    if p.D > 0:
        for axis in range(p.outputs):
            x.past[0, axis] = v[axis]
    if p.told > 0:
        keep = p.disturbances[0, p.outputs]
        x.payload[1] = keep * x.payload[1] + (1.0 - keep) * x.payload[0]
