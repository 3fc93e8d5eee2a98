"""The grey box of any payload: the equations of `_neck_equations_runtime`, and an echo of what was measured.

As in kind `play` the histories hold what is above the equations' output; that is bounded (see there) and the echo dies
out, so no free run can diverge.
"""

import numpy as np

from softneck.identification.models._feedforward_runtime import echo_added, echo_rest
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_forward,
    narx_observe,
    narx_rest,
)
from softneck.identification.structured._neck_equations_runtime import NeckState, neck_advance, neck_sense
from softneck.runtime._layout import array, cells, value


class GreyBoxArrays(NarxArrays):
    """The numbers of the equations, and what stands around them."""

    neck = array("numbers", "of the equations, in the order of NECK_*; of another robot its tendons behind them")
    sensor = array("2", "dead time [samples], and sample time in the time of a neck [s]")
    echo = array("outputs, p", "of what was measured above the equations, newest first")
    memory = array("1", "samples after which a held start has settled")
    dead = value("sensor", 0)


class GreyBoxState(NarxState):
    """Histories, then the state of the equations (see `NeckState`)."""

    neck = cells("7 + 2 * dead", "bend, hysteresis, compression, sensor, and the dead time's line of tilts")


def greybox_rest(
    p: GreyBoxArrays, neck: np.ndarray, parameters: np.ndarray, x: GreyBoxState, outputs: np.ndarray
) -> None:
    """Rest: motors at zero, the neck settled; what the start is above that is remembered as measured."""
    narx_rest(p, parameters, x, outputs)
    m = np.zeros(p.motors)
    for _ in range(int(p.memory[0])):
        neck_advance(neck, p.sensor[1], np.zeros(p.motors), m, x.neck)
        # The sensor settles with the neck: its dead time holds the tilt at rest.
        neck_sense(neck, p.sensor[1], x.neck)
    for axis in range(p.outputs):
        echo_rest(p, x, axis, greybox_angle(x.neck, axis))


def greybox_angle(neck: NeckState, axis: int) -> float:
    """Return what the sensor of the equations says."""
    return neck.sensor[axis]


def greybox_step(
    p: GreyBoxArrays,
    neck: np.ndarray,
    parameters: np.ndarray,
    x: GreyBoxState,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample under the numbers `neck`."""
    narx_observe(p, parameters, x, inputs)
    # From measured positions where there are any; a copy, as histories do not change.
    m = x.m[0].copy()
    targets = np.empty(p.motors)
    for j in range(p.motors):
        targets[j] = x.u[int(p.drive[j, 1]) - 1, j]  # u(k+1-d); d >= 1 for this kind
    neck_advance(neck, p.sensor[1], targets, m, x.neck)
    neck_sense(neck, p.sensor[1], x.neck)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        ahead[axis] = echo_added(p, p.echo, x, axis, greybox_angle(x.neck, axis))
    narx_forward(p, parameters, x, ahead, outputs)
    # The equations move the motors, stalls among them; the lag of `narx_forward` does not.
    for j in range(p.motors):
        x.motors[j] = m[j]
        outputs[p.outputs + j] = m[j]
