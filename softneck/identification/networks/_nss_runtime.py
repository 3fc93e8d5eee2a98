"""Neural state space behind drives that stall under load, and a linear echo of what was measured.

The map is that of `_nss_map_runtime`. As in kind `play` the histories hold what is above y of the map, which is kept
within `range` and never fed back; the echo dies out where nothing is measured.
"""

import numpy as np

from softneck.identification.models._bank_runtime import load_advance
from softneck.identification.models._feedforward_runtime import echo_added, echo_rest, stalling_drives
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_advance,
    narx_observe,
    narx_rest,
)
from softneck.identification.networks._nss_map_runtime import nss_inputs, nss_next
from softneck.runtime._layout import array, cells


class NssArrays(NarxArrays):
    """The map x+ = A x + B v + E tanh(F x + G v + D t + h), y = C x + c, and what stands around it."""

    load = array("4", "where a drive stalls: pole, c, c1, c2 (see `_bank_runtime`)")
    redefinition = array("3, 3", "T of Eq. 9-11: motors to redefined inputs")
    widths = array("w", "widths of the play operators behind each redefined input [rad]")
    delay = array("1", "samples after which a motor position acts")
    A = array("n, n", "contracting")
    B = array("n, 3 * (1 + w)", "of the inputs v, each as it is and behind its plays")
    E = array("n, q", "of the neurons t")
    F = array("q, n", "")
    G = array("q, 3 * (1 + w)", "")
    h = array("q", "")
    D = array("q, q", "strictly lower triangular: the neurons are found one by one")
    C = array("2, n", "")
    c = array("2", "[rad]")
    range = array("2, 2", "least and largest y of each axis [rad]")
    echo = array("2, p", "of what was measured above y, newest first")
    memory = array("1", "samples after which a held start has settled")


class NssState(NarxState):
    """Histories, load, play operators and the state of the map."""

    q = cells("3", "motor positions behind a low-pass: the load of now [rad]")
    plays = cells("3 * w", "play operators [rad]")
    x = cells("n", "state of the map")


def nss_output(p: NssArrays, x: np.ndarray, axis: int) -> float:
    """Return y of one axis, kept within `range`."""
    y = p.c[axis]
    for i in range(p.n):
        y += p.C[axis, i] * x[i]
    return min(max(y, p.range[axis, 0]), p.range[axis, 1])  # training's range, widened


def initialise(p: NssArrays, parameters: np.ndarray, x: NssState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the neck settled; what the start is above that is remembered as measured."""
    narx_rest(p, parameters, x, outputs)
    v = np.zeros(p.B.shape[1])
    # Long enough: the map contracts, so that what it began with is forgotten.
    for _ in range(int(p.memory[0])):
        nss_advance(p, x.x, v)
    for axis in range(2):
        echo_rest(p, x, axis, nss_output(p, x.x, axis))


def nss_advance(p: NssArrays, x: np.ndarray, v: np.ndarray) -> None:
    """Move the state of the map on."""
    t = np.empty(p.q)
    ahead = np.empty(p.n)
    nss_next(p.A, p.B, p.E, p.F, p.G, p.h, p.D, x, v, t, ahead)
    x[:] = ahead


def step(p: NssArrays, parameters: np.ndarray, x: NssState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    load_advance(p.load, x.m[0], x.q)
    v = np.empty(p.B.shape[1])
    # v comes from simulated or measured motors, not set-points: the drives are outside of the map.
    nss_inputs(p.redefinition, p.widths, x.m[int(p.delay[0])], x.plays, v)
    nss_advance(p, x.x, v)
    angles = np.empty(2)
    for axis in range(2):
        angles[axis] = echo_added(p, p.echo, x, axis, nss_output(p, x.x, axis))
    narx_advance(p, parameters, x, angles[0], angles[1], outputs)
    stalling_drives(p, p.load, x.q, x, outputs)
