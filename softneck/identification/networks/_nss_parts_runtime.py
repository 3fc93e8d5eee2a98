"""What neural state spaces share: arrays, state, output, and the map's advance."""

import numpy as np

from softneck.identification.models._histories_runtime import NarxArrays, NarxState
from softneck.identification.networks._nss_map_runtime import nss_next
from softneck.runtime._layout import array, cells


class NssArrays(NarxArrays):
    """The map x+ = A x + B v + E tanh(F x + G v + D t + h), y = C x + c, and what stands around it."""

    load = array("4", "where a drive stalls: pole, c, c1, c2 (see `_bank_runtime`)")
    redefinition = array("channels, motors", "T of Eq. 9-11: motors to redefined inputs")
    widths = array("w", "widths of the play operators behind each redefined input [rad]")
    delay = array("1", "samples after which a motor position acts")
    A = array("n, n", "contracting")
    B = array("n, channels * (1 + w)", "of the inputs v, each as it is and behind its plays")
    E = array("n, q", "of the neurons t")
    F = array("q, n", "")
    G = array("q, channels * (1 + w)", "")
    h = array("q", "")
    D = array("q, q", "strictly lower triangular: the neurons are found one by one")
    C = array("outputs, n", "")
    c = array("outputs", "[rad]")
    range = array("outputs, 2", "least and largest y of each axis [rad]")
    echo = array("outputs, p", "of what was measured above y, newest first")
    memory = array("1", "samples after which a held start has settled")


class NssState(NarxState):
    """Histories, load, play operators and the state of the map."""

    q = cells("motors", "motor positions behind a low-pass: the load of now [rad]")
    plays = cells("channels * w", "play operators [rad]")
    x = cells("n", "state of the map")


def nss_output(p: NssArrays, x: np.ndarray, axis: int) -> float:
    """Return y of one axis, kept within `range`."""
    y = p.c[axis]
    for i in range(p.n):
        y += p.C[axis, i] * x[i]
    return min(max(y, p.range[axis, 0]), p.range[axis, 1])  # training's range, widened


def nss_advance(p: NssArrays, x: np.ndarray, v: np.ndarray) -> None:
    """Move the state of the map on."""
    t = np.empty(p.q)
    ahead = np.empty(p.n)
    nss_next(p.A, p.B, p.E, p.F, p.G, p.h, p.D, x, v, t, ahead)
    x[:] = ahead
