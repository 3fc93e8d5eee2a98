"""Grey box: the equations of `_neck_equations_runtime`, and an echo of what was measured.

As in kind `play` the histories hold what is above the equations' output; that is bounded (see there) and the echo dies
out, so no free run can diverge.
"""

import numpy as np

from softneck.identification.models._feedforward_runtime import echo_added, echo_rest
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_advance,
    narx_observe,
    narx_rest,
)
from softneck.identification.structured._neck_equations_runtime import NeckState, neck_advance, neck_sense
from softneck.runtime._layout import array, cells, value


class GreyBoxArrays(NarxArrays):
    """The numbers of the equations, and what stands around them."""

    neck = array("16", "numbers of the equations, in the order of NECK_*")
    sensor = array("2", "dead time [samples], and sample time [s]")
    echo = array("2, p", "of what was measured above the equations, newest first")
    memory = array("1", "samples after which a held start has settled")
    dead = value("sensor", 0)


class GreyBoxState(NarxState):
    """Histories, then the state of the equations (see `NeckState`)."""

    neck = cells("7 + 2 * dead", "bend, hysteresis, compression, sensor, and the dead time's line of tilts")


def initialise(p: GreyBoxArrays, parameters: np.ndarray, x: GreyBoxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the neck settled; what the start is above that is remembered as measured."""
    narx_rest(p, parameters, x, outputs)
    m = np.zeros(3)
    for _ in range(int(p.memory[0])):
        neck_advance(p.neck, p.sensor[1], np.zeros(3), m, x.neck)
        # The sensor settles with the neck: its dead time holds the tilt at rest.
        neck_sense(p.neck, p.sensor[1], x.neck)
    for axis in range(2):
        echo_rest(p, x, axis, greybox_angle(x.neck, axis))


def greybox_angle(neck: NeckState, axis: int) -> float:
    """Return what the sensor of the equations says."""
    return neck.sensor[axis]


def step(p: GreyBoxArrays, parameters: np.ndarray, x: GreyBoxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    # From measured positions where there are any; a copy, as histories do not change.
    m = x.m[0].copy()
    targets = np.empty(3)
    for j in range(3):
        targets[j] = x.u[int(p.drive[j, 1]) - 1, j]  # u(k+1-d); d >= 1 for this kind
    neck_advance(p.neck, p.sensor[1], targets, m, x.neck)
    neck_sense(p.neck, p.sensor[1], x.neck)
    angles = np.empty(2)
    for axis in range(2):
        angles[axis] = echo_added(p, p.echo, x, axis, greybox_angle(x.neck, axis))
    narx_advance(p, parameters, x, angles[0], angles[1], outputs)
    # The equations move the motors, stalls among them; the lag of `narx_advance` does not.
    for j in range(3):
        x.motors[j] = m[j]
        outputs[2 + j] = m[j]
