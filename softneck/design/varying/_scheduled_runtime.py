"""Linear controllers interpolated over the inclination.

Every matrix of the linear controller (see `_linear_parts_runtime`) is linear between the controllers of two
neighbouring inclinations and constant beyond the outermost. Their states mean the same at all of them - what the
integral adds to the tilt - so a change of the inclination alone moves no motor where the error is zero.

The inclination is that of the angles, `atan |(tan pitch, tan roll)|`, through a first-order lag: it must not change
faster than the loop it schedules (Shamma and Athans 1990, IEEE TAC 35:898).
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
)
from softneck.design.linear._rest_runtime import initialise as initialise
from softneck.runtime._layout import array, cells


class ScheduledArrays(SeveralArrays):
    """Those of every inclination."""

    knots = array("k", "inclinations, rising [rad]")
    memory = array("1", "pole of the inclination's lag")


class ScheduledState(LinearState):
    """That of the linear controller, and where between the inclinations it is."""

    inclination = cells("", "behind the lag [rad]")


def step(
    p: ScheduledArrays, parameters: np.ndarray, x: ScheduledState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Compute the set-points for now, and the state for the next sample; ports as of the linear controller."""
    # As in the linear controller: what is not a number would stay in the state.
    if not linear_finite(inputs):
        outputs[:] = x.held
        return
    flags, first = 2 * p.outputs + 1 + p.motors, p.outputs + 1
    active = inputs[flags] > 0.5 and inputs[flags + 1] > 0.5
    started = x.started > 0.5
    if not started:
        x.held[:] = inputs[first + p.outputs : flags]
    # A robot of one angle has no roll.
    roll = inputs[first + 1] if p.outputs > 1 else 0.0
    tilt = scheduled_inclination(inputs[first], roll)  # pyright: ignore[reportArgumentType]  (numbers)
    if not started or not active:
        # Nothing moves: the lag has nothing to protect.
        x.inclination = tilt
    else:
        memory = p.memory[0]
        x.inclination = memory * x.inclination + (1.0 - memory) * tilt
    now = scheduled_arrays(p, x.inclination)
    if not started or not active:
        linear_align(now, x, inputs[first : first + p.outputs])
        linear_exactly(now, x, inputs[first : first + p.outputs])
    x.started = 1.0
    if active:
        linear_control(now, parameters, x, inputs)
    outputs[:] = x.held


def scheduled_inclination(pitch: float, roll: float) -> float:
    """Return the inclination [rad]."""
    # Pitch and roll are atan2(n1, n3) and atan2(n2, n3) of the normal n: the squares of their tangents add up.
    return math.atan(math.hypot(math.tan(pitch), math.tan(roll)))


def scheduled_blend(stacked: np.ndarray, knots: int, low: int, part: float) -> np.ndarray:
    """Return the matrix that lies `part` of the way from inclination `low` to the next."""
    rows = stacked.shape[0] // knots
    # Beyond the last knot `part` is zero: it blends with itself.
    high = min(low + 1, knots - 1)
    return (1.0 - part) * stacked[low * rows : (low + 1) * rows] + part * stacked[high * rows : (high + 1) * rows]


def scheduled_arrays(p: ScheduledArrays, tilt: float) -> LinearArrays:
    """Return the arrays of the linear controller at inclination `tilt` [rad]."""
    low, part = p.k - 1, 0.0
    for i in range(1, p.k):
        if tilt < p.knots[i]:
            low = i - 1
            part = max(0.0, (tilt - p.knots[low]) / (p.knots[i] - p.knots[low]))
            break
    return (  # pyright: ignore[reportReturnType]  # a tuple is what arrays are in the bundle
        p.Af,
        p.Bf,
        p.Cf,
        p.Df,
        scheduled_blend(p.A, p.k, low, part),
        scheduled_blend(p.Br, p.k, low, part),
        scheduled_blend(p.By, p.k, low, part),
        scheduled_blend(p.C, p.k, low, part),
        scheduled_blend(p.Dr, p.k, low, part),
        scheduled_blend(p.Dy, p.k, low, part),
        scheduled_blend(p.L, p.k, low, part),
        scheduled_blend(p.align, p.k, low, part),
        p.rest,
        p.T,
        p.T_inverse,
        p.constants,
    )
