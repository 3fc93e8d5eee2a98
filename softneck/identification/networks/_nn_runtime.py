"""NLARX network with two tanh layers and drives that stall under load (section 6.2; see `_bank_runtime`).

    z(k) = (regressor - mean) / scale,    N = w3 tanh(W2 tanh(W1 z + b1) + b2) + b3
    y(k+1) = N + d(k+1),                  d(k+1) = memory (d(k) + gain (y(k) - N(k) - d(k)))

d estimates the error of the network from measurements, and decays without them. A tanh layer is bounded, and so is the
output for any feedback.
"""

import numpy as np

from softneck.identification.models._bank_runtime import load_advance
from softneck.identification.models._feedforward_runtime import stalling_drives
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_forward,
    narx_observe,
    narx_regressor,
    narx_rest,
)
from softneck.runtime._layout import array, cells


class NnArrays(NarxArrays):
    """Weights of one network for each output."""

    table = array("n, 3", "regressors: source, channel and lag of each (see `narx_regressor`)")
    W1 = array("outputs, h1, n", "first layer")
    b1 = array("outputs, h1", "its offsets")
    W2 = array("outputs, h2, h1", "second layer")
    b2 = array("outputs, h2", "its offsets")
    w3 = array("outputs, h2", "output")
    b3 = array("outputs", "its offset")
    input_scale = array("outputs, 2, n", "mean and standard deviation of each regressor")
    output_scale = array("outputs, 2", "mean and standard deviation of the output [rad]")
    load = array("4", "where a drive stalls: pole, c, c1, c2 (see `_bank_runtime`)")
    correction = array("outputs, 2", "memory and gain of the disturbance")


class NnState(NarxState):
    """Histories, and the states of the network's drives and disturbance."""

    q = cells("motors", "motor positions behind a low-pass: the load of now [rad]")
    own = cells("outputs", "N: the network's part of the outputs of now [rad]")
    disturbance = cells("outputs", "d: what the network misses [rad]")


def initialise(p: NnArrays, parameters: np.ndarray, x: NnState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(p, parameters, x, outputs)
    # At the start the network has no error (d = 0).
    for axis in range(p.outputs):
        x.own[axis] = parameters[axis]


def nn_output(p: NnArrays, axis: int, regressor: np.ndarray) -> float:
    """Return the network's y(k+1) of one axis."""
    # Angles are a tenth of motor positions: scaled, all of them count.
    z = (regressor - p.input_scale[axis, 0]) / p.input_scale[axis, 1]
    first = np.tanh(np.dot(p.W1[axis], z) + p.b1[axis])
    second = np.tanh(np.dot(p.W2[axis], first) + p.b2[axis])
    value = np.dot(p.w3[axis], second) + p.b3[axis]
    return p.output_scale[axis, 0] + p.output_scale[axis, 1] * value


def step(p: NnArrays, parameters: np.ndarray, x: NnState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    q = x.q
    # q(k+1) from m(k): the drives below stall at the load that they have by then.
    load_advance(p.load, x.m[0], q)
    regressor = np.empty(p.n)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        # The newest output in the history is measured, or the prediction itself, with no error.
        missed = x.y[0, axis] - x.own[axis] - x.disturbance[axis]
        x.disturbance[axis] = p.correction[axis, 0] * (x.disturbance[axis] + p.correction[axis, 1] * missed)
        narx_regressor(p, p.table, x, axis, regressor)
        x.own[axis] = nn_output(p, axis, regressor)
        ahead[axis] = x.own[axis] + x.disturbance[axis]
    narx_forward(p, parameters, x, ahead, outputs)
    # These positions replace those of `narx_forward`, which has no load limit.
    stalling_drives(p, p.load, q, x, outputs)
