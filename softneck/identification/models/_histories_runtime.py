"""Parts of all plants: histories, the drive model, measured or simulated signals, output noise."""

import numpy as np

from softneck.identification.models._validity_runtime import GroundArrays, ground_outside
from softneck.runtime._layout import StateVector, array, cells, value
from softneck.runtime._random_runtime import random_normal, random_seed
from softneck.runtime._rest_runtime import REST


def narx_outputs(history: np.ndarray) -> int:
    """Return the number of outputs; two by default."""
    return int(history[1]) if history.shape[0] > 1 else 2


def narx_motors(drive: np.ndarray) -> int:
    """Return the number of motors."""
    return drive.shape[0]


class NarxArrays(GroundArrays):
    """The first arrays of every plant."""

    history = array("sizes = 1 | 2", "H, samples of each signal that are kept; and the number of outputs if not two")
    drive = array("motors, 2", "a, d of each motor: m(k+1) = a m(k) + (1 - a) u(k+1-d); d = 0: it is where it is sent")
    H = value("history", 0)
    outputs = value("history", function=narx_outputs, written=True)
    motors = value("drive", function=narx_motors, written=True)


class NarxState(StateVector):
    """Histories, newest first, and present values; kinds add further states."""

    u = cells("H, motors", "motor set-points [rad]")
    m = cells("H, motors", "motor positions [rad]")
    y = cells("H, outputs", "pitch and roll [rad], or only their base where a kind adds something to it")
    motors = cells("motors", "motor positions of now [rad]")
    angles = cells("outputs", "pitch and roll of now [rad]")
    random = cells("6", "generator of the output noise")
    added = cells("outputs", "how far the angles of now are above what goes into their history [rad]")
    slow = cells("motors", "where the motors have been held [rad]")


# Parameters, in this order: the start of each output, use_measurement, noise_std, noise_seed.


def narx_rest(p: NarxArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    x[:] = 0.0
    for j in range(p.H):
        for axis in range(p.outputs):
            x.y[j, axis] = parameters[axis]
    random_seed(x.random, float(parameters[p.outputs + 2]))
    outputs[:] = 0.0
    for axis in range(p.outputs):
        x.angles[axis] = parameters[axis]
        outputs[axis] = parameters[axis]
    outputs[outputs.shape[0] - 1] = narx_validity(p, x)


def narx_validity(p: NarxArrays, x: NarxState) -> float:
    """Return the validity of the next outputs from the motors at t_k; 0 for a model without a training region."""
    if p.ground.shape[0] == 0:
        return 0.0
    outside = ground_outside(p, x.m[0], x.slow)
    doubt = 0.0
    for axis in range(p.outputs):
        doubt = max(doubt, p.doubt[axis, 0] + p.doubt[axis, 1] * outside)
    return 1.0 / (1.0 + doubt)


def narx_push(history: np.ndarray, newest: np.ndarray) -> None:
    """Put the newest sample in front of a history; the oldest falls out."""
    width = newest.shape[0]
    # numpy and numba both copy before they overwrite.
    history[width:] = history[: history.shape[0] - width].copy()
    history[:width] = newest


def narx_known(p: NarxArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray) -> None:
    """Replace angles and motors at t_k by their measurements where there are any."""
    measured = parameters[p.outputs] > 0.5  # a Boolean parameter as a number
    for axis in range(p.outputs):
        if measured and np.isfinite(inputs[p.motors + axis]):  # NaN: not measured now
            x.angles[axis] = inputs[p.motors + axis]
    for j in range(p.motors):
        # A drive without delay is where it is sent, unless an encoder says otherwise.
        if p.drive[j, 1] == 0.0:
            x.motors[j] = inputs[j]
        at = p.motors + p.outputs + j
        if measured and np.isfinite(inputs[at]):
            x.motors[j] = inputs[at]


def narx_observe(p: NarxArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray) -> None:
    """Push set-points, motors and outputs at t_k, measured where possible, into the histories."""
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[: p.motors])
    narx_push(x.m, x.motors)
    # The part that a kind adds is never fed back: the history holds the outputs without it.
    base = x.angles - x.added
    narx_push(x.y, base)


def narx_forward(p: NarxArrays, parameters: np.ndarray, x: NarxState, ahead: np.ndarray, outputs: np.ndarray) -> None:
    """Write the outputs at t_k+1, `ahead` (outputs,), and the motors that the drive model gives."""
    for j in range(p.motors):
        d = int(p.drive[j, 1])
        if d > 0:
            a = p.drive[j, 0]
            # Row 0 of the history is u(k), so that u(k+1-d) is row d - 1; m is measured where it is.
            x.motors[j] = (a * x.motors[j] + (1.0 - a) * x.u[d - 1, j] + REST) - REST
        outputs[p.outputs + j] = x.motors[j]
    for axis in range(p.outputs):
        x.angles[axis] = (ahead[axis] + REST) - REST
        outputs[axis] = x.angles[axis]
    # Sensor noise is on the outputs only and never fed back.
    if parameters[p.outputs + 1] > 0.0:
        for axis in range(p.outputs):
            outputs[axis] += parameters[p.outputs + 1] * random_normal(x.random)
    # Behind bounds, where a kind has them.
    outputs[outputs.shape[0] - 1] = narx_validity(p, x)


def narx_regressor(p: NarxArrays, table: np.ndarray, x: NarxState, axis: int, regressor: np.ndarray) -> None:
    """Fill the regressor of y(k+1); row (source, channel, lag) of `table`: source 0 own output, 1 u, 2 m, 3 outputs."""
    # Eq. 13 in the order of the table.
    for i in range(table.shape[0]):
        source = int(table[i, 0])
        channel = int(table[i, 1])
        back = int(table[i, 2]) - 1  # lag 1 of y(k+1) is sample k, the newest
        if source == 0:
            regressor[i] = x.y[back, axis]
        elif source == 1:
            regressor[i] = x.u[back, channel]
        elif source == 2:
            regressor[i] = x.m[back, channel]
        else:
            regressor[i] = x.y[back, channel]
