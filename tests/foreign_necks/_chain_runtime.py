"""`chain`: six links on ball joints, tendons through a disc at each, friction of the guides after the capstan law.

Joint k turns by the vector b_k [rad] (rotation about (-b_k2, b_k1, 0)); discs sit half way between joints. With h the
height of a link (all are compressed alike, by s in sum) and beta = |b_k|, tendon i spans

    l_ki = h cos(beta / 2) - 2 a (b_k . e_i) sin(beta / 2) / beta

from disc to disc: constant curvature is nowhere assumed (pseudo-rigid bodies: Howell 2001, ch. 5; routed tendons:
Rucker and Webster 2011, IEEE T-RO 27:1033). Disc k multiplies the tension by exp(mu theta_k) in the direction in
which the tendon slides (Euler-Eytelwein; theta_k the angle of wrap), so that upper joints are pulled less than lower
ones. Each joint is a standard linear solid (one Maxwell branch beside spring and dashpot: creep). Kinetic energy is
that of the platform, moved by sum c_k b_k', and of the links, j each; the weight acts at the exact place. New guides
rub more until they have run in. Drives follow a ramp of limited acceleration and feel no load. The body is symmetric
under a third of a turn.
"""

import math

import numpy as np

from softneck.plant._geometry_runtime import bend_functions, tilt_rotation
from softneck.runtime._layout import cells
from tests.foreign_necks._shared_runtime import (
    FOREIGN_GRAVITY,
    ForeignArrays,
    ForeignNumbers,
    ForeignState,
    foreign_age,
    foreign_enqueue,
    foreign_lag,
    foreign_load,
    foreign_outputs,
    foreign_sense,
    foreign_start,
    foreign_tilt,
)

CHAIN_LINKS = 6


class ChainNumbers(ForeignNumbers):
    """Numbers of the chain."""

    length = cells("1", "of the chain [m]")
    radius = cells("1", "of the tendons' holes [m]")
    stiffness = cells("1", "of the whole chain against bending [N m/rad]")
    damping = cells("1", "of the whole chain [N m s/rad]")
    creep = cells("2", "Maxwell branch: part of the stiffness [1], time constant [s]")
    axial = cells("2", "stiffness [N/m] and damping [N s/m] against compression")
    mass = cells("3", "platform [kg], its height above the last disc [m], inertia of a link [kg m^2]")
    tendon = cells("2", "stiffness [N/m] and damping [N s/m]")
    friction = cells("3", "mu [1], wrap at the base [rad], speed over which it is smoothed [m/s]")
    running_in = cells("2", "additional part of the friction while new [1], way over which it goes [rad]")
    drive = cells("3", "position gain [1/s], speed limit [rad/s], acceleration limit [rad/s^2]")
    sensor_lag = cells("1", "time constant of the attitude filter [s]")


# Value, and relative spread between necks of different seeds.
CHAIN = {
    "position_limit": (6.0, 0.0),
    "latency": (0.03, 0.2),
    "sensor_delay": (0.03, 0.1),
    "noise_std": (0.0009, 0.2),
    "rate_noise_std": (0.002, 0.2),
    "noise_quantum": (0.0, 0.0),
    "pretension": (1.5, 0.15),
    "winch_radius": (0.0075, 0.0),
    "length": (0.11, 0.01),
    "radius": (0.045, 0.01),
    "stiffness": (0.55, 0.1),
    "damping": (0.04, 0.2),
    "creep": ((0.35, 12.0), 0.1),
    "axial": ((480.0, 25.0), 0.1),
    "mass": ((0.22, 0.012, 4e-5), 0.05),
    "tendon": ((1700.0, 5.0), 0.1),
    "friction": ((0.12, 1.6, 0.006), 0.1),
    "running_in": ((0.4, 150.0), 0.1),
    "drive": ((14.0, 10.0, 90.0), 0.05),
    "sensor_lag": (0.02, 0.1),
}


class ChainState(ForeignState):
    """The body, behind what all foreign necks keep."""

    b = cells("6, 2", "bend of each joint [rad]")
    w = cells("6, 2", "its rate [rad/s]")
    e = cells("6, 2", "bend of the Maxwell branches' dashpots [rad]")
    s = cells("", "compression [m]")
    v = cells("", "its rate [m/s]")
    force = cells("6, 2", "what turns the joints [N m]")
    spans = cells("6, 3, 4", "of each tendon at each joint: length, its gradient to b_k1, b_k2 and s")
    tip = cells("7, 12", "of the discs: where, and how turned")


def state_size(a: ForeignArrays) -> int:
    """Return the length of the state: the first vector that `step` names is that of its numbers."""
    return ChainState.size(a)


def initialise(a: ForeignArrays, p: ChainNumbers, x: ChainState, outputs: np.ndarray) -> None:
    """Home the tendons at their pretension and let the chain come to rest."""
    x[:] = 0.0
    load = foreign_load(np.zeros(8))
    for _ in range(8000):
        chain_body(p, x, load, 5e-4, True)
    for i in range(3):
        x.free[i] = chain_length(p, x, i) - p.pretension[0] / p.tendon[0]
    pitch, roll = chain_lean(x, load)
    foreign_start(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def step(a: ForeignArrays, p: ChainNumbers, x: ChainState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    foreign_enqueue(p, x, inputs)
    load = foreign_load(inputs)
    h = a.setup[0] / a.substeps
    for i in range(a.substeps):
        chain_drives(p, x, foreign_age(a, p, i), h)
        chain_body(p, x, load, h, False)
        pitch, roll = chain_lean(x, load)
        foreign_lag(x, pitch, roll, p.sensor_lag[0], h)
    pitch, roll = chain_lean(x, load)
    foreign_sense(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def chain_drives(p: ChainNumbers, x: ChainState, age: int, h: float) -> None:
    """Move the motors along ramps of limited speed and acceleration."""
    for i in range(3):
        wanted = p.drive[0] * (x.queue[age, i] - x.position[i])
        wanted = min(max(wanted, -p.drive[1]), p.drive[1])
        most = h * p.drive[2]
        x.speed[i] += min(max(wanted - x.speed[i], -most), most)
        x.position[i] += h * x.speed[i]
        x.travel += h * abs(x.speed[i])


def chain_spans(p: ChainNumbers, x: ChainState) -> None:
    """Find length and gradient of each tendon at each joint."""
    h = (p.length[0] - x.s) / CHAIN_LINKS
    for k in range(CHAIN_LINKS):
        square = x.b[k, 0] * x.b[k, 0] + x.b[k, 1] * x.b[k, 1]
        beta = math.sqrt(square)
        C = math.cos(0.5 * beta)
        # sin(beta/2)/beta and the derivative of that by beta, over beta: series near the straight joint.
        S = math.sin(0.5 * beta) / beta if beta > 1e-3 else 0.5 - square / 48.0
        D = (0.5 * C - S) / square if beta > 1e-3 else -1.0 / 24.0
        for i in range(3):
            e1 = math.cos(2.0 * math.pi / 3.0 * i)
            e2 = math.sin(2.0 * math.pi / 3.0 * i)
            along = x.b[k, 0] * e1 + x.b[k, 1] * e2
            common = -0.5 * h * S - 2.0 * p.radius[0] * D * along
            x.spans[k, i, 0] = h * C - 2.0 * p.radius[0] * S * along
            x.spans[k, i, 1] = common * x.b[k, 0] - 2.0 * p.radius[0] * S * e1
            x.spans[k, i, 2] = common * x.b[k, 1] - 2.0 * p.radius[0] * S * e2
            x.spans[k, i, 3] = -C / CHAIN_LINKS


def chain_length(p: ChainNumbers, x: ChainState, i: int) -> float:
    """Return the length of tendon `i` [m]."""
    chain_spans(p, x)
    total = 0.0
    for k in range(CHAIN_LINKS):
        total += x.spans[k, i, 0]
    return total


def chain_kinematics(p: ChainNumbers, x: ChainState) -> None:
    """Find where the discs are and how they are turned, from the base to the platform."""
    h = (p.length[0] - x.s) / CHAIN_LINKS
    for j in range(12):
        x.tip[0, j] = 1.0 if j == 3 or j == 7 or j == 11 else 0.0
    for k in range(CHAIN_LINKS):
        R = tilt_rotation(x.b[k, 0], x.b[k, 1])
        for row in range(3):
            a = x.tip[k, 3 + 3 * row]
            b = x.tip[k, 4 + 3 * row]
            c = x.tip[k, 5 + 3 * row]
            for column in range(3):
                x.tip[k + 1, 3 + 3 * row + column] = a * R[column] + b * R[3 + column] + c * R[6 + column]
            # Half a link below the joint, half a link above it.
            x.tip[k + 1, row] = x.tip[k, row] + 0.5 * h * (c + x.tip[k + 1, 5 + 3 * row])


def chain_weight(p: ChainNumbers, x: ChainState, load: tuple) -> float:
    """Add the torques of weight and push to the joints; return their force along the compression."""
    payload, up, push1, push2, _ = load
    weight = FOREIGN_GRAVITY * (p.mass[0] + payload)
    f1 = push1 - weight * up[0]
    f2 = push2 - weight * up[1]
    f3 = -weight * up[2]
    last = CHAIN_LINKS
    c1 = x.tip[last, 0] + p.mass[1] * x.tip[last, 5]
    c2 = x.tip[last, 1] + p.mass[1] * x.tip[last, 8]
    c3 = x.tip[last, 2] + p.mass[1] * x.tip[last, 11]
    half = 0.5 * (p.length[0] - x.s) / CHAIN_LINKS
    along = 0.0
    for k in range(CHAIN_LINKS):
        a1 = x.tip[k, 5]
        a2 = x.tip[k, 8]
        a3 = x.tip[k, 11]
        along -= (a1 + x.tip[k + 1, 5]) * f1 + (a2 + x.tip[k + 1, 8]) * f2 + (a3 + x.tip[k + 1, 11]) * f3
        r1 = c1 - x.tip[k, 0] - half * a1
        r2 = c2 - x.tip[k, 1] - half * a2
        r3 = c3 - x.tip[k, 2] - half * a3
        # Torque about the joint, as the link below it sees it.
        m1 = r2 * f3 - r3 * f2
        m2 = r3 * f1 - r1 * f3
        m3 = r1 * f2 - r2 * f1
        t1 = x.tip[k, 3] * m1 + x.tip[k, 6] * m2 + x.tip[k, 9] * m3
        t2 = x.tip[k, 4] * m1 + x.tip[k, 7] * m2 + x.tip[k, 10] * m3
        t3 = x.tip[k, 5] * m1 + x.tip[k, 8] * m2 + x.tip[k, 11] * m3
        # To the rotation vector (-b2, b1, 0), by the transposed left Jacobian of SO(3): t - A v x t + C v x (v x t).
        v1 = -x.b[k, 1]
        v2 = x.b[k, 0]
        square = v1 * v1 + v2 * v2
        f = bend_functions(square)
        C = (1.0 - f[1]) / square if square > 1e-6 else 1.0 / 6.0
        n1 = v2 * t3
        n2 = -v1 * t3
        n3 = v1 * t2 - v2 * t1
        y1 = t1 - f[0] * n1 + C * v2 * n3
        y2 = t2 - f[0] * n2 - C * v1 * n3
        x.force[k, 0] += y2
        x.force[k, 1] -= y1
    return 0.5 * along / CHAIN_LINKS


def chain_tendon(p: ChainNumbers, x: ChainState, i: int, homing: bool) -> float:
    """Add the torques of tendon `i` to the joints; return its force along the compression."""
    length = 0.0
    slide = 0.0
    for k in range(CHAIN_LINKS):
        length += x.spans[k, i, 0]
        slide += x.spans[k, i, 1] * x.w[k, 0] + x.spans[k, i, 2] * x.w[k, 1] + x.spans[k, i, 3] * x.v
    stretch = length - x.free[i] + p.winch_radius[0] * x.position[i]
    tension = 0.0
    if stretch > 0.0:
        tension = max(0.0, p.tendon[0] * stretch + p.tendon[1] * (slide + p.winch_radius[0] * x.speed[i]))
    if homing:
        tension = p.pretension[0]
    x.tension[i] = tension
    mu = p.friction[0] * (1.0 + p.running_in[0] * math.exp(-x.travel / p.running_in[1]))
    if homing:
        mu = 0.0  # the chain is shaken until friction has no part in where it rests
    wrap = p.friction[1]
    along = 0.0
    for k in range(CHAIN_LINKS):
        # What slides up through disc k is pulled harder above it.
        tension *= math.exp(mu * wrap * math.tanh(slide / p.friction[2]))
        x.force[k, 0] -= tension * x.spans[k, i, 1]
        x.force[k, 1] -= tension * x.spans[k, i, 2]
        along -= tension * x.spans[k, i, 3]
        slide -= x.spans[k, i, 1] * x.w[k, 0] + x.spans[k, i, 2] * x.w[k, 1] + x.spans[k, i, 3] * x.v
        # The next disc bends the tendon by half the joint below it and half the one above.
        wrap = 0.5 * math.sqrt(x.b[k, 0] * x.b[k, 0] + x.b[k, 1] * x.b[k, 1])
        if k + 1 < CHAIN_LINKS:
            wrap += 0.5 * math.sqrt(x.b[k + 1, 0] * x.b[k + 1, 0] + x.b[k + 1, 1] * x.b[k + 1, 1])
    return along


def chain_body(p: ChainNumbers, x: ChainState, load: tuple, h: float, homing: bool) -> None:
    """Advance the joints by one substep."""
    for k in range(CHAIN_LINKS):
        for j in range(2):
            x.force[k, j] = -CHAIN_LINKS * p.stiffness[0] * (x.b[k, j] + p.creep[0] * (x.b[k, j] - x.e[k, j]))
    chain_spans(p, x)
    chain_kinematics(p, x)
    along = chain_weight(p, x, load) - p.axial[0] * x.s
    for i in range(3):
        along += chain_tendon(p, x, i, homing)
    mass = p.mass[0] + load[0]
    x.v = (mass * x.v + h * along) / (mass + h * p.axial[1])
    x.s += h * x.v
    # Inertia m c c' + j I and the dashpots, implicit: inverted by Sherman and Morrison.
    own = p.mass[2] + h * CHAIN_LINKS * p.damping[0]
    for j in range(2):
        moved = 0.0
        squares = 0.0
        platform = 0.0
        for k in range(CHAIN_LINKS):
            lever = p.mass[1] + p.length[0] * (CHAIN_LINKS - k - 0.5) / CHAIN_LINKS
            platform += lever * x.w[k, j]
            squares += lever * lever
        for k in range(CHAIN_LINKS):
            lever = p.mass[1] + p.length[0] * (CHAIN_LINKS - k - 0.5) / CHAIN_LINKS
            x.force[k, j] = p.mass[2] * x.w[k, j] + mass * lever * platform + h * x.force[k, j]
            moved += lever * x.force[k, j]
        moved *= mass / (own + mass * squares)
        for k in range(CHAIN_LINKS):
            lever = p.mass[1] + p.length[0] * (CHAIN_LINKS - k - 0.5) / CHAIN_LINKS
            x.w[k, j] = (x.force[k, j] - lever * moved) / own
            x.b[k, j] += h * x.w[k, j]
            # Homing waits until nothing creeps any more.
            part = 1.0 if homing else h / (p.creep[1] + h)
            x.e[k, j] += part * (x.b[k, j] - x.e[k, j])


def chain_lean(x: ChainState, load: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad]."""
    last = CHAIN_LINKS
    return foreign_tilt(x.tip[last, 5], x.tip[last, 8], x.tip[last, 11], load[4])


def energy(p: ChainNumbers, x: ChainState, inputs: np.ndarray) -> float:
    """Return kinetic and stored energy [J]."""
    payload, up, _, _, _ = foreign_load(inputs)
    chain_kinematics(p, x)
    mass = p.mass[0] + payload
    last = CHAIN_LINKS
    total = 0.5 * mass * x.v * x.v + 0.5 * p.axial[0] * x.s * x.s
    for row in range(3):
        total += FOREIGN_GRAVITY * mass * up[row] * (x.tip[last, row] + p.mass[1] * x.tip[last, 5 + 3 * row])
    for i in range(3):
        stretch = chain_length(p, x, i) - x.free[i] + p.winch_radius[0] * x.position[i]
        total += 0.5 * p.tendon[0] * max(stretch, 0.0) ** 2
    for j in range(2):
        platform = 0.0
        for k in range(CHAIN_LINKS):
            bent = x.b[k, j] ** 2 + p.creep[0] * (x.b[k, j] - x.e[k, j]) ** 2
            total += 0.5 * CHAIN_LINKS * p.stiffness[0] * bent + 0.5 * p.mass[2] * x.w[k, j] ** 2
            platform += (p.mass[1] + p.length[0] * (CHAIN_LINKS - k - 0.5) / CHAIN_LINKS) * x.w[k, j]
        total += 0.5 * mass * platform * platform
    return total
