"""The equations of kind `greybox`: a bent link between tendons, stalling drives and a slow sensor.

Lengths of tendon are in radians of motor, tensions in radians of stretch, so that no stiffness appears twice.

- drive: m_j lags its delayed set-point, not faster than `top_speed`, up to a tension of (1 - drag) `pull_limit`, from
  where it gets on to `pull_limit` at `drag_rate`, as friction falls with the speed; drag may be zero;
- stretch: x_j = pretension + m_j - lever (e_j . (b - home)) - arc |b|^2 - s, tension T_j = max(0, x_j): a tendon only
  pulls, and the plates that a bent link carries are nearer to each other (of an arc of length L by L |b|^2 / 24);
- bend: b' = gain sum T_j (e_j + 2 arc / lever b) - stiffness F (1 +- asymmetry) (b - rest) - stiffening |b|^2 b
  - friction z - stiffness (creep (b - r) + slow_creep (b - q)) - F stiffness a(b);
- softening: F = (1 - lasting (1 - exp(-2 B / reach))) (1 + a / 2) / (1 + a |b| / reach), B the largest bend of late,
  forgotten over 300 time constants (Mullins 1969, Rubber Chem. Technol. 42:339), a the softening;
- anisotropy: a = coupling (b_2 - rest_2, b_1 - rest_1) + (l_1 q - l_2 p, -l_1 p - l_2 q), where
  q = 2 (b_1^2 - b_2^2) / (reach + |b|) and p = 4 b_1 b_2 / (reach + |b|): three lobes, of bounded slope;
- creep (two Maxwell branches): r' = creep_rate (b - r), q' = slow_creep_rate (b - q);
- compression: s' = axial_rate (compliance (sum (T_j - pretension)) - s - 9 max(0, s - 1 / stop));
- hysteresis (Dahl): z' = b' - |b'| z / friction_angle, so |z| <= friction_angle;
- tilt: pitch = atan(tan|b| b_1/|b|), roll likewise, through a dead time and a first-order lag.

e_j points to tendon j: of a neck 120 deg apart or where it was found, times the arm of tendon j over that of the first;
of another robot as its file says; with one output all lie in a plane.

Bend and compression are taken half implicitly (Rosenbrock, one stage), stable for any rates, and |b| is kept below
1.2 rad: no input moves the output further.
"""

import math

import numpy as np

from softneck.identification.models._feedforward_runtime import echo_added, echo_rest
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_forward,
    narx_observe,
    narx_rest,
)
from softneck.runtime._layout import StateVector, array, cells, rest, value

# Numbers of `neck`, in this order.
NECK_DRIVE_RATE = 0
NECK_PRETENSION = 1
NECK_PULL_LIMIT = 2
NECK_LEVER = 3
NECK_GAIN = 4
NECK_STIFFNESS = 5
NECK_STIFFENING = 6
NECK_ASYMMETRY = 7
NECK_REST = 8  # two
NECK_COMPLIANCE = 10
NECK_AXIAL_RATE = 11
NECK_FRICTION = 12
NECK_FRICTION_ANGLE = 13
NECK_TWIST = 14
NECK_SENSOR_RATE = 15
NECK_SIZE = 16
# Behind them, of another robot than the neck: the largest part of sum e_j e_j' for each tendon, then the cosines and
# the sines of the tendons' angles; with one output the sines are zero.
NECK_SHARE = 16
NECK_TENDONS = 17
NECK_STATES = 12
# Numbers of `body`: what a body of foam or of coils does beside, and tendons and drives.
BODY_REACH = 0
BODY_SOFTENING = 1
BODY_LASTING = 2
BODY_CREEP = 3
BODY_CREEP_RATE = 4
BODY_COUPLING = 5
BODY_LOBES = 6  # two
BODY_STOP = 8
BODY_ARC = 9
BODY_HOME = 10  # two
BODY_SLOW_CREEP = 12
BODY_SLOW_CREEP_RATE = 13
BODY_TOP_SPEED = 14
BODY_DRAG = 15
BODY_DRAG_RATE = 16
# The largest bend of late is forgotten over 60 s of a neck's time, 300 time constants.
_FORGET_RATE = 1.0 / 60.0
# A stalled drive gives way as the bend does: 4 ms at 20 ms follow that closely enough.
NECK_SUBSTEPS = 5
_LARGEST_BEND = 1.2


class NeckState(StateVector):
    """The state of the equations."""

    b = cells("2", "bend [rad]")
    z = cells("2", "hysteresis [rad]")
    s = cells("", "compression [rad]")
    sensor = cells("2", "what the sensor says [rad]")
    r = cells("2", "bend that has crept [rad]")
    largest = cells("", "largest bend of late [rad]")
    q = cells("2", "bend that has crept slowly [rad]")
    tilts = rest("the dead time's line: tilts of pitch, newest first, then those of roll [rad]")


def neck_directions(neck: np.ndarray, e: np.ndarray) -> None:
    """Fill e (2, motors) with where the tendons pull, as mounted."""
    motors = e.shape[1]
    for j in range(motors):
        if neck.shape[0] == NECK_SIZE:
            e[0, j] = math.cos(neck[NECK_TWIST] + 2.0943951023931953 * j)  # 120 deg apart (Eq. 5)
            e[1, j] = math.sin(neck[NECK_TWIST] + 2.0943951023931953 * j)
        else:
            c = math.cos(neck[NECK_TWIST])
            s = math.sin(neck[NECK_TWIST])
            e[0, j] = c * neck[NECK_TENDONS + j] - s * neck[NECK_TENDONS + motors + j]
            e[1, j] = s * neck[NECK_TENDONS + j] + c * neck[NECK_TENDONS + motors + j]


def neck_decays(neck: np.ndarray, body: np.ndarray, sample_time: float, substeps: int) -> tuple:
    """Return what is left of a way after a substep or a sample: exact for what is held.

    After a substep of a motor's way to its target and to its limit, after a sample of both creeps, of the sensor's and
    of the largest bend.
    """
    dt = sample_time / substeps
    return (
        math.exp(-neck[NECK_DRIVE_RATE] * dt),
        math.exp(-body[BODY_DRAG_RATE] * dt),
        math.exp(-body[BODY_CREEP_RATE] * sample_time),
        math.exp(-body[BODY_SLOW_CREEP_RATE] * sample_time),
        math.exp(-neck[NECK_SENSOR_RATE] * sample_time),
        math.exp(-_FORGET_RATE * sample_time),
    )


def neck_advance(
    neck: np.ndarray,
    body: np.ndarray,
    e: np.ndarray,
    c: tuple,
    sample_time: float,
    substeps: int,
    targets: np.ndarray,
    m: np.ndarray,
    x: NeckState,
) -> None:
    """Move the motors `m` (motors,) towards `targets`, and the body in `x`, by one sample in so many substeps.

    `e` (2, motors) is filled by `neck_directions`; `c`: see `neck_decays`.
    """
    dt = sample_time / substeps
    keep, held, kept, kept_slowly, _, lasting = c
    share = 0.5 if neck.shape[0] == NECK_SIZE else neck[NECK_SHARE]
    # Of a body that was not bent of late, at half of its reach.
    whole = neck[NECK_STIFFNESS] * (1.0 + 0.5 * body[BODY_SOFTENING])
    if body[BODY_LASTING] > 0.0:
        whole *= 1.0 - body[BODY_LASTING] * (1.0 - math.exp(-2.0 * x.largest / body[BODY_REACH]))
    creep = neck[NECK_STIFFNESS] * body[BODY_CREEP]
    slow_creep = neck[NECK_STIFFNESS] * body[BODY_SLOW_CREEP]
    softening = body[BODY_SOFTENING] / body[BODY_REACH]
    coupling = body[BODY_COUPLING]
    lobe0 = body[BODY_LOBES]
    lobe1 = body[BODY_LOBES + 1]
    # The largest slope that these add, as a part of the stiffness.
    skew = abs(coupling) + 4.0 * (abs(lobe0) + abs(lobe1))
    most = dt * body[BODY_TOP_SPEED]
    drag = body[BODY_DRAG] * neck[NECK_PULL_LIMIT]
    part = 1.0 - held
    arc = body[BODY_ARC]
    arm = 2.0 * arc / neck[NECK_LEVER]
    size = math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1])
    for _ in range(substeps):
        pull0 = 0.0
        pull1 = 0.0
        total = 0.0
        taut = 0
        squared = x.b[0] * x.b[0] + x.b[1] * x.b[1]
        nearer = arc * squared + x.s
        for j in range(m.shape[0]):
            toward = e[0, j] * (x.b[0] - body[BODY_HOME]) + e[1, j] * (x.b[1] - body[BODY_HOME + 1])
            # x_j = pull_limit, solved for m_j. Where the neck moves away a stalled drive gives way: below m.
            limit = neck[NECK_PULL_LIMIT] - neck[NECK_PRETENSION] + neck[NECK_LEVER] * toward + nearer
            lagging = keep * m[j] + (1.0 - keep) * targets[j]
            limit = min(max(m[j] + part * (limit - m[j]), limit - drag), limit + drag)
            m[j] = min(min(max(lagging, m[j] - most), m[j] + most), limit)
            stretch = neck[NECK_PRETENSION] + m[j] - neck[NECK_LEVER] * toward - nearer
            if stretch > 0.0:  # a slack tendon neither pulls nor adds to `rate`
                pull0 += stretch * e[0, j]
                pull1 += stretch * e[1, j]
                total += stretch
                taut += 1
        pull0 += total * arm * x.b[0]
        pull1 += total * arm * x.b[1]
        loss = neck[NECK_STIFFENING] * squared
        stiffness = whole / (1.0 + softening * size)
        k0 = stiffness * (1.0 + neck[NECK_ASYMMETRY])
        k1 = stiffness * (1.0 - neck[NECK_ASYMMETRY])
        f0 = neck[NECK_GAIN] * pull0 - k0 * (x.b[0] - neck[NECK_REST]) - loss * x.b[0] - neck[NECK_FRICTION] * x.z[0]
        f1 = (
            neck[NECK_GAIN] * pull1 - k1 * (x.b[1] - neck[NECK_REST + 1]) - loss * x.b[1] - neck[NECK_FRICTION] * x.z[1]
        )
        f0 -= creep * (x.b[0] - x.r[0]) + slow_creep * (x.b[0] - x.q[0])
        f1 -= creep * (x.b[1] - x.r[1]) + slow_creep * (x.b[1] - x.q[1])
        if skew > 0.0:
            # Three lobes make it stiffer each 120 deg; divided, so that their slope stays bounded at large bends.
            q = 2.0 * (x.b[0] * x.b[0] - x.b[1] * x.b[1]) / (body[BODY_REACH] + size)
            p = 4.0 * x.b[0] * x.b[1] / (body[BODY_REACH] + size)
            f0 -= stiffness * (coupling * (x.b[1] - neck[NECK_REST + 1]) + lobe0 * q - lobe1 * p)
            f1 -= stiffness * (coupling * (x.b[0] - neck[NECK_REST]) - lobe0 * p - lobe1 * q)
        # Minus the slope of f over b, one number for both directions: the cube's at its steepest, and half of each taut
        # tendon, as e e' of all three add up to 3/2.
        rate = stiffness + 3.0 * loss + share * taut * neck[NECK_GAIN] * neck[NECK_LEVER] + neck[NECK_FRICTION] + creep
        rate += skew * stiffness + slow_creep
        # An arc lengthens each tendon's arm.
        rate += share * taut * neck[NECK_GAIN] * neck[NECK_LEVER] * arm * size * (2.0 + arm * size)
        d0 = dt * f0 / (1.0 + dt * rate)  # one stage: (1 + dt rate) d = dt f
        d1 = dt * f1 / (1.0 + dt * rate)
        x.b[0] += d0
        x.b[1] += d1
        size = math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1])
        # Both by one factor: the neck keeps leaning where it leant.
        if size > _LARGEST_BEND:
            x.b[0] *= _LARGEST_BEND / size
            x.b[1] *= _LARGEST_BEND / size
            size = _LARGEST_BEND
        # Implicit in z: it cannot leave |z| <= friction_angle.
        forget = 1.0 + math.sqrt(d0 * d0 + d1 * d1) / neck[NECK_FRICTION_ANGLE]
        x.z[0] = (x.z[0] + d0) / forget
        x.z[1] = (x.z[1] + d1) / forget
        axial = neck[NECK_AXIAL_RATE]
        rise = axial * (neck[NECK_COMPLIANCE] * (total - m.shape[0] * neck[NECK_PRETENSION]) - x.s)
        touch = 0.0
        if body[BODY_STOP] * x.s > 1.0:  # coils touch: ten times as stiff
            touch = 9.0
            rise -= axial * touch * (x.s - 1.0 / body[BODY_STOP])
        # Its slope again: s itself, and each taut tendon, which gets looser as the link gives way.
        x.s += dt * rise / (1.0 + dt * axial * (1.0 + touch + neck[NECK_COMPLIANCE] * taut))
    part = 1.0 - kept
    x.r[0] += part * (x.b[0] - x.r[0])
    x.r[1] += part * (x.b[1] - x.r[1])
    part = 1.0 - kept_slowly
    x.q[0] += part * (x.b[0] - x.q[0])
    x.q[1] += part * (x.b[1] - x.q[1])
    x.largest = max(size, x.largest * lasting)


def neck_crept(x: NeckState) -> None:
    """Let the body creep to where it is, as it does at rest."""
    x.r[0] = x.b[0]
    x.r[1] = x.b[1]
    x.q[0] = x.b[0]
    x.q[1] = x.b[1]


def neck_sense(c: tuple, x: NeckState) -> None:
    """Push the present tilt into the delay line, and step the sensor."""
    size = math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1])
    part = math.tan(size) / size if size > 1e-9 else 1.0  # tan x / x: the straight neck divides by nothing
    line = x.tilts
    lines = line.shape[0] // 2
    keep = c[4]
    for axis in range(2):
        tilt = math.atan(part * x.b[axis])
        first = axis * lines
        # Out comes the tilt of `lines` samples ago, before that of now goes in.
        seen = tilt
        if lines > 0:
            seen = line[first + lines - 1]
            for i in range(lines - 1, 0, -1):
                line[first + i] = line[first + i - 1]
            line[first] = tilt
        x.sensor[axis] = keep * x.sensor[axis] + (1.0 - keep) * seen


def neck_run(
    neck: np.ndarray,
    body: np.ndarray,
    sample_time: float,
    substeps: int,
    delay: np.ndarray,
    lines: int,
    settle: int,
    targets: np.ndarray,
    start: np.ndarray,
    motors: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Fill `motors` (time, motors) and `outputs` (time, outputs) for set-points `targets`, standing at `start` before.

    `delay` (motors,) is that of the drives in samples, `lines` the sensor's; `settle` samples of rest come first.
    """
    x = np.zeros(NECK_STATES + 2 * lines)
    m = start.copy()
    e = np.empty((2, m.shape[0]))
    neck_directions(neck, e)
    c = neck_decays(neck, body, sample_time, substeps)
    held = np.empty(m.shape[0])
    axes = outputs.shape[1]
    # Under set-points that stay: a run begins at rest, as its recording is taken to.
    for _ in range(settle):
        neck_advance(neck, body, e, c, sample_time, substeps, start, m, x)  # pyright: ignore[reportArgumentType]
        neck_crept(x)  # pyright: ignore[reportArgumentType]
        neck_sense(c, x)  # pyright: ignore[reportArgumentType]
    motors[0] = m
    outputs[0] = x[5 : 5 + axes]
    for k in range(targets.shape[0] - 1):
        for j in range(m.shape[0]):
            back = k + 1 - int(delay[j])
            held[j] = targets[back, j] if back >= 0 else start[j]
        neck_advance(neck, body, e, c, sample_time, substeps, held, m, x)  # pyright: ignore[reportArgumentType]
        neck_sense(c, x)  # pyright: ignore[reportArgumentType]
        motors[k + 1] = m
        outputs[k + 1] = x[5 : 5 + axes]


# As in kind `play`, the histories hold the measured errors of the equations. Their output is bounded and the noise
# model is stable, so no simulation can diverge.


class GreyBoxArrays(NarxArrays):
    """The parameters of the equations and the arrays around them."""

    neck = array("numbers", "of the equations, in the order of NECK_*; of another robot its tendons behind them")
    body = array("17", "reach [rad], softening, creep, anisotropy, stop, arc, home, drives; see BODY_*")
    sensor = array("2", "dead time [samples], and sample time in the time of a neck [s]")
    echo = array("outputs, p", "of what was measured above the equations, newest first")
    memory = array("1", "samples after which a held start has settled")
    dead = value("sensor", 0)


class GreyBoxState(NarxState):
    """Histories, then the state of the equations (see `NeckState`)."""

    neck = cells(
        "12 + 2 * dead", "bend, hysteresis, compression, sensor, creep, largest bend, and the dead time's line of tilts"
    )


def greybox_rest(
    p: GreyBoxArrays, neck: np.ndarray, parameters: np.ndarray, x: GreyBoxState, outputs: np.ndarray
) -> None:
    """Rest: motors at zero, the neck settled; the start's difference to the equations is kept as a measured error."""
    narx_rest(p, parameters, x, outputs)
    m = np.zeros(p.motors)
    e = np.empty((2, p.motors))
    neck_directions(neck, e)
    c = neck_decays(neck, p.body, p.sensor[1], NECK_SUBSTEPS)
    for _ in range(int(p.memory[0])):
        neck_advance(neck, p.body, e, c, p.sensor[1], NECK_SUBSTEPS, np.zeros(p.motors), m, x.neck)
        neck_crept(x.neck)
        # The sensor settles with the neck: its dead time holds the tilt at rest.
        neck_sense(c, x.neck)
    for axis in range(p.outputs):
        echo_rest(p, x, axis, greybox_angle(x.neck, axis))


def greybox_angle(neck: NeckState, axis: int) -> float:
    """Return the angle at the equations' sensor."""
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
    e = np.empty((2, p.motors))
    neck_directions(neck, e)
    c = neck_decays(neck, p.body, p.sensor[1], NECK_SUBSTEPS)
    neck_advance(neck, p.body, e, c, p.sensor[1], NECK_SUBSTEPS, targets, m, x.neck)
    neck_sense(c, x.neck)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        ahead[axis] = echo_added(p, p.echo, x, axis, greybox_angle(x.neck, axis))
    narx_forward(p, parameters, x, ahead, outputs)
    # The equations move the motors, stalls among them; the lag of `narx_forward` does not.
    for j in range(p.motors):
        x.motors[j] = m[j]
        outputs[p.outputs + j] = m[j]
