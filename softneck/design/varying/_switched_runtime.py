"""Linear controllers of several payloads, of which the estimated payload chooses one.

The controllers of two payloads share the meaning of their states but one: what the integral adds. At a switch it is set
so that the new controller asks for what the old one would have (bumpless transfer). A switch waits until the last one
is `dwell` samples ago, for which the design shows that no sequence of switches can drive the loop off (Hespanha and
Morse 1999, 38th CDC, 2655), and until the estimate is past the middle between two payloads by a margin. While the neck
is told to be one that no payload explains, the reference moves slowly.
"""

import math

import numpy as np

from softneck.design.linear._linear_parts_runtime import (
    LinearArrays,
    LinearState,
    SeveralArrays,
    linear_align,
    linear_control,
    linear_exactly,
    linear_finite,
    linear_reference,
)
from softneck.design.linear._rest_runtime import initialise as initialise
from softneck.runtime._layout import array, cells

# Places in `switching`.
SWITCHED_DWELL = 0  # samples between two switches, at the least
SWITCHED_MARGIN = 1  # past the middle between two payloads, as a part of their distance
SWITCHED_SLOW = 2  # the most that a reference moves in a sample while the neck is unknown


class SwitchedArrays(SeveralArrays):
    """Those of every payload."""

    payloads = array("k", "rising [kg]")
    switching = array("3", "see SWITCHED_*")


class SwitchedState(LinearState):
    """That of the linear controller, which of them it is, and how far the reference is."""

    chosen = cells("", "place among the payloads")
    since = cells("", "samples since the last switch")
    slow = cells("", "1 while the reference is held back")
    asked = cells("outputs", "reference of now")


def step(p: SwitchedArrays, parameters: np.ndarray, x: SwitchedState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: as of the linear controller, then payload, changed.
    """
    flags, first = 2 * p.outputs + 1 + p.motors, p.outputs + 1
    own = inputs[: flags + 2].copy()
    # As in the linear controller: what is not a number would stay in the state.
    if not linear_finite(own):
        outputs[:] = x.held
        return
    payload = float(inputs[flags + 2])
    active = bool(own[flags] > 0.5 and own[flags + 1] > 0.5)
    started = x.started > 0.5
    y = own[first : first + p.outputs].copy()
    if not started:
        x.held[:] = own[first + p.outputs : flags]
    if not started or not active:
        # Nothing moves: no switch can jolt.
        x.chosen = switched_nearest(p, payload, x.chosen, 0.0)
        x.since = p.switching[SWITCHED_DWELL]
        x.slow = 0.0
        x.asked[:] = y
        now = switched_arrays(p, int(x.chosen))
        linear_align(now, x, y)
        linear_exactly(now, x, y)
    switched_reference(p, x, own, float(inputs[flags + 3]) > 0.5, active)
    x.started = 1.0
    if active:
        wanted = switched_nearest(p, payload, x.chosen, p.switching[SWITCHED_MARGIN])
        if wanted != x.chosen and x.since >= p.switching[SWITCHED_DWELL]:
            switched_over(p, parameters, x, own, int(wanted))
        x.since += 1.0
        linear_control(switched_arrays(p, int(x.chosen)), parameters, x, own)
    outputs[:] = x.held


def switched_nearest(p: SwitchedArrays, payload: float, chosen: float, margin: float) -> float:
    """Return the place of the payload next to the estimate; `chosen` unless it is past the middle by a margin."""
    if not math.isfinite(payload):
        return chosen
    best = 0
    for i in range(1, p.k):
        if abs(payload - p.payloads[i]) < abs(payload - p.payloads[best]):
            best = i
    here = p.payloads[int(chosen)]
    apart = abs(p.payloads[best] - here)
    # Past the middle: nearer to the other than to this one.
    if abs(payload - here) - abs(payload - p.payloads[best]) <= 2.0 * margin * apart:
        return chosen
    return float(best)


def switched_reference(p: SwitchedArrays, x: SwitchedState, own: np.ndarray, changed: bool, active: bool) -> None:
    """Put the reference of now into `own`: what is asked, or as far as it may move while the neck is unknown."""
    if not active:
        return
    if changed:
        x.slow = 1.0
    if x.slow < 0.5:
        x.asked[:] = own[: p.outputs]
        return
    there = True
    for i in range(p.outputs):
        way = own[i] - x.asked[i]
        most = p.switching[SWITCHED_SLOW]
        x.asked[i] += min(max(way, -most), most)
        there = there and abs(way) <= most
        own[i] = x.asked[i]
    if there and not changed:
        x.slow = 0.0


def switched_over(p: SwitchedArrays, parameters: np.ndarray, x: SwitchedState, own: np.ndarray, to: int) -> None:
    """Go over to another controller, its integral such that it asks for what the old one would have."""
    asked = switched_wants(switched_arrays(p, int(x.chosen)), parameters, x, own)
    would = switched_wants(switched_arrays(p, to), parameters, x, own)
    inside, width = x.x, x.x.shape[0] // p.outputs
    for i in range(p.outputs):
        # The integral is the first state of each axis, and is added as it is.
        inside[i * width] += asked[i] - would[i]
    x.chosen = float(to)
    x.since = 0.0


def switched_wants(p: LinearArrays, parameters: np.ndarray, x: LinearState, own: np.ndarray) -> np.ndarray:
    """Return the redefined inputs (outputs,) that a controller asks for, before all limits."""
    rf = linear_reference(p, p.constants, parameters, x.xf, own)
    y = own[p.outputs + 1 : 2 * p.outputs + 1]
    return np.dot(p.C, x.x) + np.dot(p.Dr, rf[: p.outputs]) + np.dot(p.Dy, y)


def switched_rows(stacked: np.ndarray, payloads: int, which: int) -> np.ndarray:
    """Return the matrix of one payload."""
    rows = stacked.shape[0] // payloads
    return stacked[which * rows : (which + 1) * rows].copy()


def switched_arrays(p: SwitchedArrays, which: int) -> LinearArrays:
    """Return the arrays of the linear controller of one payload."""
    return (  # pyright: ignore[reportReturnType]  # a tuple is what arrays are in the bundle
        p.Af,
        p.Bf,
        p.Cf,
        p.Df,
        switched_rows(p.A, p.k, which),
        switched_rows(p.Br, p.k, which),
        switched_rows(p.By, p.k, which),
        switched_rows(p.C, p.k, which),
        switched_rows(p.Dr, p.k, which),
        switched_rows(p.Dy, p.k, which),
        switched_rows(p.L, p.k, which),
        switched_rows(p.align, p.k, which),
        p.rest,
        p.T,
        p.T_inverse,
        p.constants,
    )
