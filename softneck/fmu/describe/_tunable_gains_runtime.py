"""PI and PID of all axes whose gains are parameters, which may change during a run.

    pi     v = K (e + s),                        s+ = s + Ts/Ti e,    e = rf - y
    pid    v = (K + r) e - g y + I + D,          I+ = I + r e,        D+ = a D + (1 - a) g y,
           r = K Ts/Ti,   a = Tf/(Tf + Ts),   g = K Td/(Tf + Ts)

With the gains of the design its arrays are used, to the bit. Other gains act from the next sample on and are bumpless:
s or I takes the value with which v of that sample is what it would have been with the gains before (Astrom and Hagglund
2006, Advanced PID Control, chapter 13).
"""

import numpy as np

from softneck.design.linear._linear_parts_runtime import (
    LinearArrays,
    LinearState,
    linear_finite,
    linear_reference,
    linear_step,
)
from softneck.design.linear._rest_runtime import initialise as initialise
from softneck.runtime._layout import array, cells

TUNABLE_FIRST = 5  # of the gains among the parameters; the limits of all linear controllers stand before them
# Places among the gains of an axis; a PI has the first two.
TUNABLE_K, TUNABLE_TI, TUNABLE_TD, TUNABLE_TF = 0, 1, 2, 3


class TunableArrays(LinearArrays):
    """A linear controller, and the gains it was designed with."""

    gains = array("outputs, each = 2 | 4", "K, Ti [s], of a PID also Td and Tf [s] of each axis")


class TunableState(LinearState):
    """State of the linear controller, and the gains of the sample before."""

    gains = cells("outputs, each", "K, Ti, Td, Tf in use")


def step(p: TunableArrays, parameters: np.ndarray, x: TunableState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Compute the set-points for now, and the state for the next sample; ports as of the linear controller.

    parameters: the limits of the linear controller, then the gains of each axis.
    """
    if not linear_finite(inputs):
        outputs[:] = x.held
        return
    if x.started > 0.5:
        tunable_keep_command(p, parameters, x, inputs)
    designed = True
    for axis in range(p.outputs):
        for i in range(p.each):
            x.gains[axis, i] = parameters[TUNABLE_FIRST + axis * p.each + i]
            designed = designed and x.gains[axis, i] == p.gains[axis, i]
    now = tunable_arrays(p, parameters, designed)
    linear_step(now, parameters, x, inputs, outputs)


def tunable_keep_command(p: TunableArrays, parameters: np.ndarray, x: TunableState, inputs: np.ndarray) -> None:
    """Where gains have changed, set the integral so that v of now is that of the gains before."""
    rf = linear_reference(p, p.constants, parameters, x.xf, inputs)
    Ts = p.constants[0]
    for axis in range(p.outputs):
        first = TUNABLE_FIRST + axis * p.each
        new = parameters[first : first + p.each]
        y = inputs[int(p.outputs) + 1 + axis]
        if tunable_same(x.gains[axis], new):
            continue
        if p.each == 2:
            e = rf[axis] - y
            x.x[axis] = x.gains[axis, TUNABLE_K] / new[TUNABLE_K] * (e + x.x[axis]) - e
        else:
            integral = 2 * axis
            before = tunable_direct(x.gains[axis], Ts, rf[axis], y) + x.x[integral] + x.x[integral + 1]
            # The filtered y of the derivative stays; without a derivative before, it begins at y.
            g, ahead = tunable_slope(x.gains[axis], Ts), tunable_slope(new, Ts)
            x.x[integral + 1] = ahead * y if g == 0.0 else ahead / g * x.x[integral + 1]
            x.x[integral] = before - tunable_direct(new, Ts, rf[axis], y) - x.x[integral + 1]


def tunable_same(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two axes have the same gains."""
    same = True
    for i in range(a.shape[0]):
        same = same and a[i] == b[i]
    return same


def tunable_slope(gains: np.ndarray, Ts: float) -> float:
    """Return g of a PID."""
    return gains[TUNABLE_K] * gains[TUNABLE_TD] / (gains[TUNABLE_TF] + Ts)


def tunable_direct(gains: np.ndarray, Ts: float, rf: float, y: float) -> float:
    """Return the part of v of a PID that is not in its state."""
    return gains[TUNABLE_K] * (1.0 + Ts / gains[TUNABLE_TI]) * (rf - y) - tunable_slope(gains, Ts) * y


def tunable_arrays(p: TunableArrays, parameters: np.ndarray, designed: bool) -> LinearArrays:
    """Return the arrays of the linear controller for the gains among `parameters`; unchanged axes keep theirs."""
    A, Br, By, C, Dr, Dy, L, align = p.A, p.Br, p.By, p.C, p.Dr, p.Dy, p.L, p.align
    if not designed:
        A, Br, By, C, Dr, Dy = p.A.copy(), p.Br.copy(), p.By.copy(), p.C.copy(), p.Dr.copy(), p.Dy.copy()
        L, align = p.L.copy(), p.align.copy()
    Ts, m = p.constants[0], p.outputs
    for axis in range(p.outputs):
        first = TUNABLE_FIRST + axis * p.each
        gains = parameters[first : first + p.each]
        if tunable_same(p.gains[axis], gains):
            continue
        K = gains[TUNABLE_K]
        if p.each == 2:
            rate = Ts / gains[TUNABLE_TI]
            Br[axis, axis] = rate
            By[axis, axis] = -rate
            C[axis, axis] = K
            Dr[axis, axis] = K
            Dy[axis, axis] = -K
            L[axis, axis] = rate / K
            align[axis, m + axis] = 1.0 / K  # s = v / K at e = 0
        else:
            i = 2 * axis
            rate = K * Ts / gains[TUNABLE_TI]
            a, g = gains[TUNABLE_TF] / (gains[TUNABLE_TF] + Ts), tunable_slope(gains, Ts)
            A[i + 1, i + 1] = a
            Br[i, axis] = rate
            By[i, axis] = -rate
            By[i + 1, axis] = (1.0 - a) * g
            Dr[axis, axis] = K + rate
            Dy[axis, axis] = -K - rate - g
            align[i + 1, axis] = g  # D = g y at rest, and I = v at e = 0
            # Both states are in units of v: another K alone leaves the conditioning of the design as it is. For other
            # times it is Hanus', Br / Dr.
            if not tunable_same(p.gains[axis, 1:], gains[1:]):
                L[i, axis] = rate / (K + rate)
                L[i + 1, axis] = 0.0
    return (  # pyright: ignore[reportReturnType]  # a tuple is what arrays are in the bundle
        p.Af, p.Bf, p.Cf, p.Df, A, Br, By, C, Dr, Dy, L, align, p.rest, p.T, p.T_inverse, p.constants,
    )  # fmt: skip
