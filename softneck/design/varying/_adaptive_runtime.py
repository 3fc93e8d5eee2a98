"""Indirect adaptive control of all axes: online estimation, and the gains that follow from it.

Each axis is y+ = a y + b u(k-d) with the delay d known. Its a and b are estimated by recursive least squares in the
kit's U D U' form on angles and inputs behind one band-pass, (1 - z^-1) / (1 - f z^-1)^2, which takes out offsets and
what the model does not describe (Astrom and Wittenmark 1995, Adaptive Control, sec. 11.5). From them follows in every
sample

    v = ((1 - a) rf + kappa (ym - y)) / b + s,      s+ = s + kappa (1 - a) / b (ym - y),
    ym = z^-d (1 - a) / (z - a) rf:

IMC with the delay in full, for the loop is kappa z^-d / (z - 1) whatever a and b are.

What keeps it safe: nothing is learnt where the errors are within a dead zone, the band-passed input is too small, or a
neck is not healthy or not enabled; the covariance is bounded, poles are kept stable, a and the static gain within a
box; the gains move at a bounded rate; and where the estimate predicts worse than the nominal plant, the nominal one
is used and the learning begins again.
"""

import math

import numpy as np

from softneck.design.linear._linear_parts_runtime import (
    FilterArrays,
    LinearArrays,
    LinearState,
    linear_control,
    linear_finite,
    linear_motors,
    linear_reference,
)
from softneck.identification.linear._ud_runtime import ud_guarded
from softneck.runtime._layout import array, cells, value
from softneck.runtime._products_runtime import product
from softneck.runtime._rest_runtime import REST

# Places in `guards`.
ADAPTIVE_FORGETTING = 0
ADAPTIVE_BOUND = 1  # on the trace of F
ADAPTIVE_DEAD_ZONE = 2  # of the error [rad]
ADAPTIVE_RADIUS = 3  # largest pole of an estimate
ADAPTIVE_EXCITED = 4  # least band-passed input from which is learnt [rad]
ADAPTIVE_FILTER = 5  # f of the band-pass
ADAPTIVE_DISTRUST = 6  # how much worse than the nominal plant an estimate may predict
ADAPTIVE_RATE = 7  # largest change of a gain in one sample, relative
ADAPTIVE_LEAK = 8  # of the integral, at a limit
ADAPTIVE_START = 9  # F(0)
# Memory of the averages that judge excitation and predictions: 1 s at 20 ms.
ADAPTIVE_AVERAGE = 0.98


def adaptive_longest(delays: np.ndarray) -> int:
    """Return the longest delay [samples]."""
    longest = delays[0]
    for i in range(1, delays.shape[0]):  # numpy's `max` would take a tenth of a step's time
        longest = max(longest, delays[i])
    return int(longest)


class AdaptiveArrays(FilterArrays):
    """Reference filter, allocation, and prior model."""

    rest = array("m, references", "from r to the filter's state at rest")
    T = array("references, motors", "of Eq. 9-11: motors to (theta_i, phi_i, delta_i)")
    T_inverse = array("motors, references", "redefined inputs to motors")
    constants = array("numbers = 1 | 1 + 2 * motors + 2 * references", "as of the linear controller")
    nominal = array("outputs, 2", "a and b of each axis")
    box = array("outputs, 4", "least and largest a, least and largest static gain of each axis")
    delays = array("outputs", "d of each axis [samples]")
    loop = array("outputs", "kappa of each axis")
    guards = array("10", "see ADAPTIVE_*")
    d = value("delays", function=adaptive_longest)
    motors = value("T_inverse", function=linear_motors, written=True)


class AdaptiveState(LinearState):
    """State of the linear controller, and estimates of each axis."""

    x = cells("outputs, d + 2", "integral s, then y of the model and its past, newest first [rad]")
    theta = cells("outputs, 2", "estimate: -a and b")
    U = cells("outputs, 2, 2", "of the covariance U D U': U' without its ones")
    D = cells("outputs, 2", "")
    tally = cells("outputs, 4", "counts of the recursion (see `ud_guarded`)")
    used = cells("outputs, 2", "a and b in use")
    angle = cells("outputs, 3", "angle of before, and behind one and both poles of the band-pass [rad]")
    input = cells("outputs, 3", "the same of the input v")
    line = cells("outputs, d + 1", "band-passed inputs, newest first")
    power = cells("outputs", "mean square of the band-passed input [rad^2]")
    missed = cells("outputs", "mean square of the estimate's errors [rad^2]")
    nominal_missed = cells("outputs", "of the nominal plant's")
    samples = cells("outputs", "in the line since the last stop")


def initialise(p: AdaptiveArrays, parameters: np.ndarray, x: AdaptiveState, outputs: np.ndarray) -> None:
    """Start with motors at rest and the nominal plant."""
    x[:] = 0.0
    for axis in range(p.outputs):
        adaptive_forget(p, x, axis)
        x.used[axis] = p.nominal[axis]
    outputs[:] = 0.0


def step(p: AdaptiveArrays, parameters: np.ndarray, x: AdaptiveState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Learn from the angles of now, redesign, and compute the set-points; ports as of the linear controller.

    parameters: those of the linear controller, and whether to adapt at all (0 or 1).
    """
    # As in the linear controller; the line of inputs has a gap now, and begins anew.
    if not linear_finite(inputs):
        x.samples[:] = 0.0
        outputs[:] = x.held
        return
    first = int(p.outputs) + 1  # of the angles; references and co-contraction stand before them
    flags = int(2 * p.outputs + 1 + p.motors)
    if x.started == 0.0:
        x.held[:] = inputs[2 * first - 1 : flags]
    active = inputs[flags] > 0.5 and inputs[flags + 1] > 0.5
    # A regression needs the sample before.
    going = active and x.started > 0.5
    for axis in range(p.outputs):
        if going:
            if parameters[5] > 0.5:
                adaptive_learn(p, x, axis, inputs[first + axis])
            before = adaptive_asked(p, parameters, x, axis, inputs)
            adaptive_redesign(p, x, axis, parameters[5] > 0.5)
            # New gains move no motor: the integral takes up what they would have changed.
            change = adaptive_asked(p, parameters, x, axis, inputs) - before
            x.x[axis, 0] -= change
        # Behind the learning, which needs the band-pass of before.
        adaptive_see(p, x, axis, inputs[first + axis], going)
    now = adaptive_arrays(p, x)
    if x.started == 0.0 or not active:
        adaptive_align(p, now, x, inputs[first : 2 * first - 1])
    x.started = 1.0
    if active:
        linear_control(now, parameters, x, inputs)
    v = product(p.T, x.held)
    for axis in range(p.outputs):
        adaptive_push(p, x, axis, v[axis], active)
    outputs[:] = x.held


def adaptive_forget(p: AdaptiveArrays, x: AdaptiveState, axis: int) -> None:
    """Set the estimate back to the nominal plant."""
    x.theta[axis, 0] = -p.nominal[axis, 0]  # Eq. 23 has a_1 = -a
    x.theta[axis, 1] = p.nominal[axis, 1]
    x.U[axis] = 0.0  # U = I: its ones are not kept
    x.D[axis] = p.guards[ADAPTIVE_START]
    x.tally[axis] = 0.0


def adaptive_learn(p: AdaptiveArrays, x: AdaptiveState, axis: int, y: float) -> None:
    """Update the estimate with the present angle if it is informative; compare it with the nominal plant."""
    f = p.guards[ADAPTIVE_FILTER]
    # The angle of now behind the band-pass, which `adaptive_see` advances once all is decided.
    first = f * x.angle[axis, 1] + (y - x.angle[axis, 0])
    target = f * x.angle[axis, 2] + first
    newest = x.angle[axis, 2]
    past = x.line[axis, int(p.delays[axis])]  # u_f(k - 1 - d): the input of now is pushed last
    # The band-passed input of the last second, and whether all of the line has been filled since the last stop.
    x.power[axis] = ADAPTIVE_AVERAGE * x.power[axis] + (1.0 - ADAPTIVE_AVERAGE) * past * past
    # d samples for the line, and two time constants, 2 / (1 - f) samples, for the band-pass to forget the stop.
    filled = x.samples[axis] > p.d + 2.0 / (1.0 - f)
    excited = math.sqrt(x.power[axis]) > p.guards[ADAPTIVE_EXCITED]
    if not (filled and excited):
        return
    a, b = p.nominal[axis, 0], p.nominal[axis, 1]
    # Both errors before the row is learnt: afterwards the estimate would judge itself.
    error = target + x.theta[axis, 0] * newest - x.theta[axis, 1] * past
    nominal = target - a * newest - b * past
    x.missed[axis] = ADAPTIVE_AVERAGE * x.missed[axis] + (1.0 - ADAPTIVE_AVERAGE) * error * error
    x.nominal_missed[axis] = ADAPTIVE_AVERAGE * x.nominal_missed[axis] + (1.0 - ADAPTIVE_AVERAGE) * nominal * nominal
    adaptive_update(p, x, axis, -newest, past, target)
    adaptive_confine(p, x, axis)
    # Within the dead zone one is as good as the other.
    floor = p.guards[ADAPTIVE_DEAD_ZONE] * p.guards[ADAPTIVE_DEAD_ZONE]
    worse = x.missed[axis] > p.guards[ADAPTIVE_DISTRUST] * x.nominal_missed[axis] + floor
    sound = math.isfinite(x.theta[axis, 0]) and math.isfinite(x.theta[axis, 1])
    if worse or not (sound and math.isfinite(x.D[axis, 0] + x.D[axis, 1])):
        adaptive_forget(p, x, axis)
        # Even at first, or the new estimate would be distrusted for the old one's errors.
        x.missed[axis] = x.nominal_missed[axis]


def adaptive_update(
    p: AdaptiveArrays, x: AdaptiveState, axis: int, past_angle: float, past_input: float, target: float
) -> None:
    """Let the kit's guarded recursion take one row in."""
    row = np.empty((1, 2))
    row[0, 0] = past_angle
    row[0, 1] = past_input
    g = p.guards
    # One a, whose pole is kept stable.
    rules = np.array([g[ADAPTIVE_FORGETTING], g[ADAPTIVE_BOUND], g[ADAPTIVE_DEAD_ZONE], 1.0, g[ADAPTIVE_RADIUS]])
    factor = x.U[axis].reshape((2, 2))
    ud_guarded(row, np.array([target]), x.theta[axis], factor, x.D[axis], rules, x.tally[axis], np.empty((0, 5)))


def adaptive_confine(p: AdaptiveArrays, x: AdaptiveState, axis: int) -> None:
    """Put the estimate back into the box of pole and static gain."""
    a = min(max(-x.theta[axis, 0], p.box[axis, 0]), p.box[axis, 1])
    x.theta[axis, 0] = -a
    # The box is of the static gain b / (1 - a), whatever sign it has.
    x.theta[axis, 1] = min(max(x.theta[axis, 1], p.box[axis, 2] * (1.0 - a)), p.box[axis, 3] * (1.0 - a))


def adaptive_redesign(p: AdaptiveArrays, x: AdaptiveState, axis: int, adapt: bool) -> None:
    """Move 1 - a and b in use towards the estimate, or the nominal plant, by no more than the rate allows."""
    rate = p.guards[ADAPTIVE_RATE]
    a, b = p.nominal[axis, 0], p.nominal[axis, 1]
    if adapt:
        a, b = -x.theta[axis, 0], x.theta[axis, 1]
    # 1 - a and the static gain move, as the controller's time and gain do; relative, so that neither gets to zero.
    lag = 1.0 - x.used[axis, 0]
    gain = x.used[axis, 1] / lag
    lag = min(max(1.0 - a, lag * (1.0 - rate)), lag * (1.0 + rate))
    target = b / (1.0 - a)
    # The gain may be negative where tendons are mounted the other way round; its sign is the nominal one.
    size = min(max(abs(target), abs(gain) * (1.0 - rate)), abs(gain) * (1.0 + rate))
    x.used[axis, 0] = 1.0 - lag
    x.used[axis, 1] = math.copysign(size, gain) * lag


def adaptive_asked(p: AdaptiveArrays, parameters: np.ndarray, x: AdaptiveState, axis: int, inputs: np.ndarray) -> float:
    """Return the control action of the gains in use, without the integral."""
    rf = linear_reference(p, p.constants, parameters, x.xf, inputs)[axis]
    ym = x.x[axis, 1 + int(p.delays[axis])]
    a, b = x.used[axis, 0], x.used[axis, 1]
    return float(((1.0 - a) * rf + p.loop[axis] * (ym - inputs[p.outputs + 1 + axis])) / b)


def adaptive_see(p: AdaptiveArrays, x: AdaptiveState, axis: int, y: float, going: bool) -> None:
    """Advance the band-pass of the angle; after a stop it begins at rest where the neck is."""
    f = p.guards[ADAPTIVE_FILTER]
    if going:
        x.angle[axis, 1] = (f * x.angle[axis, 1] + (y - x.angle[axis, 0]) + REST) - REST
        x.angle[axis, 2] = (f * x.angle[axis, 2] + x.angle[axis, 1] + REST) - REST
    else:  # behind a zero at z = 1 what rests is zero
        x.angle[axis, 1] = 0.0
        x.angle[axis, 2] = 0.0
    x.angle[axis, 0] = y


def adaptive_push(p: AdaptiveArrays, x: AdaptiveState, axis: int, u: float, going: bool) -> None:
    """Put the band-passed input of now into the line."""
    f = p.guards[ADAPTIVE_FILTER]
    # What was held or moved by others is no experiment: the line begins anew.
    if not going or x.samples[axis] == 0.0:
        x.input[axis, 1] = 0.0
        x.input[axis, 2] = 0.0
        x.line[axis] = 0.0
        x.samples[axis] = 1.0 if going else 0.0
    else:
        x.input[axis, 1] = (f * x.input[axis, 1] + (u - x.input[axis, 0]) + REST) - REST
        x.input[axis, 2] = (f * x.input[axis, 2] + x.input[axis, 1] + REST) - REST
        x.samples[axis] += 1.0
    x.input[axis, 0] = u
    for i in range(p.d, 0, -1):
        x.line[axis, i] = x.line[axis, i - 1]
    x.line[axis, 0] = x.input[axis, 2]


def adaptive_arrays(p: AdaptiveArrays, x: AdaptiveState) -> LinearArrays:
    """Return the arrays of the linear controller for a and b in use."""
    # s, ym and its past of d samples, for each axis.
    n = p.d + 2
    m, rows = p.outputs, p.outputs * n
    A, Br, By = np.zeros((rows, rows)), np.zeros((rows, m)), np.zeros((rows, m))
    C, Dr, Dy, L = np.zeros((m, rows)), np.zeros((m, m)), np.zeros((m, m)), np.zeros((rows, m))
    for axis in range(p.outputs):
        a, b, kappa = x.used[axis, 0], x.used[axis, 1], p.loop[axis]
        o = axis * n
        seen = o + 1 + int(p.delays[axis])
        A[o, o] = 1.0
        A[o, seen] = kappa * (1.0 - a) / b  # s+ = s + kappa (1 - a) / b (ym - y)
        A[o + 1, o + 1] += a  # ym+ = a ym + (1 - a) rf
        for i in range(2, n):
            A[o + i, o + i - 1] = 1.0  # a line of delay
        Br[o + 1, axis] = 1.0 - a
        By[o, axis] = -kappa * (1.0 - a) / b
        C[axis, o] = 1.0
        C[axis, seen] += kappa / b
        Dr[axis, axis] = (1.0 - a) / b
        Dy[axis, axis] = -kappa / b
        L[o, axis] = p.guards[ADAPTIVE_LEAK]  # gives up what is beyond a limit over `leak_time`
        L[o + 1, axis] = b  # the model gets what the motors could do, and waits
    # `adaptive_align` aligns: no matrix of y and v can, as it would move with the gains.
    align = np.zeros((rows, 2 * m))
    return (  # pyright: ignore[reportReturnType]  # a tuple is what arrays are in the bundle
        p.Af, p.Bf, p.Cf, p.Df, A, Br, By, C, Dr, Dy, L, align, p.rest, p.T, p.T_inverse, p.constants,
    )  # fmt: skip


def adaptive_align(p: AdaptiveArrays, now: LinearArrays, x: AdaptiveState, y: np.ndarray) -> None:
    """Set the model to rest at the present angle and the integral to the held action: a bumpless start."""
    v = product(p.T, x.held)
    rest = np.empty(p.outputs + 1)
    rest[: p.outputs] = y
    rest[p.outputs] = v[p.outputs]
    x.xf[:] = product(p.rest, rest)
    for axis in range(p.outputs):
        x.x[axis] = y[axis]
        # v = rf / G_0 + s where ym = y: Dr is 1 / G_0.
        x.x[axis, 0] = v[axis] - now.Dr[axis, axis] * y[axis]
