"""`foam`: a foam of three lobes that buckles and stiffens, shear-thinning loss, tendons in Bowden sheaths.

The foam has the elastic energy

    U = K b^2/2 + k3 (b_1^3 - 3 b_1 b_2^2)/3 - k4 |b|^4/4 + k6 |b|^6/6 + k_s s^2/2

of the bend b [rad] and compression s [m]: cells that buckle soften it, full ones stiffen it (Gibson and Ashby 1997,
ch. 5), and the lobes make it stiffer towards a tendon than away from one; it is symmetric under a third of a turn.
Its loss is that of a fluid which thins under shear, d |b'|^p, p < 1 (Ostwald and de Waele). Tendon i spans (L - s)(1
- |b|^2/6) - a b.e_i, a straight line between plates that an arc carries. Motors are far away: each tendon runs in a
sheath whose friction F z is a part of the tension and builds up over a way before it slides (Dahl 1976, AIAA J.
14:1675; Bowden cables: Agrawal et al. 2010, IEEE T-RO 26:914),

    z' = (y' - |y'| z) / x_s,   T_platform = T_winch (1 + F z),

y the tendon's way through the sheath. Rope that winds up thickens the drum, r(P) = r_0 + r_1 P. Three Maxwell branches
creep; the sheath's grease rubs less as it warms. The sensor rounds to 0.1 deg.
"""

import math

import numpy as np

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


class FoamNumbers(ForeignNumbers):
    """Numbers of the foam."""

    length = cells("1", "of the foam [m]")
    radius = cells("1", "of the tendons' holes [m]")
    stiffness = cells("4", "K [N m/rad], k3 [N m/rad^2], k4 [N m/rad^3], k6 [N m/rad^5]")
    loss = cells("3", "torque at 1 rad/s [N m], p [1], rate below which it is linear [rad/s]")
    branch = cells("3", "stiffness of the Maxwell branches, parts of K [1]")
    branch_time = cells("3", "their time constants [s]")
    axial = cells("2", "stiffness [N/m] and damping [N s/m] against compression")
    mass = cells("3", "platform [kg], its centre above the end [m], its own inertia [kg m^2]")
    tendon = cells("2", "stiffness with its sheath [N/m] and damping [N s/m]")
    sheath = cells("2", "largest part of the tension that friction takes [1], way over which it builds up [m]")
    grease = cells("2", "additional part of the friction while cold [1], way over which it goes [rad]")
    drum = cells("1", "r_1, what a turn by 1 rad adds to the radius [m/rad]")
    drive = cells("3", "gain [1/s], speed limit [rad/s], bandwidth of the speed loop [1/s]")
    sensor_lag = cells("1", "time constant of the attitude filter [s]")


FOAM = {
    "position_limit": (6.0, 0.0),
    "latency": (0.03, 0.2),
    "sensor_delay": (0.03, 0.1),
    "noise_std": (0.0009, 0.2),
    "rate_noise_std": (0.003, 0.2),
    "noise_quantum": (0.00175, 0.0),
    "pretension": (1.4, 0.15),
    "winch_radius": (0.0075, 0.0),
    "length": (0.095, 0.01),
    "radius": (0.046, 0.01),
    "stiffness": ((0.62, 0.25, 1.6, 12.0), 0.1),
    "loss": ((0.045, 0.7, 0.05), 0.1),
    "branch": ((0.3, 0.2, 0.15), 0.1),
    "branch_time": ((0.4, 3.0, 25.0), 0.1),
    "axial": ((430.0, 22.0), 0.1),
    "mass": ((0.18, 0.01, 2e-4), 0.05),
    "tendon": ((1400.0, 6.0), 0.1),
    "sheath": ((0.15, 0.0008), 0.1),
    "grease": ((0.4, 120.0), 0.1),
    "drum": (0.00012, 0.1),
    "drive": ((12.0, 13.0, 70.0), 0.05),
    "sensor_lag": (0.02, 0.1),
}


class FoamState(ForeignState):
    """The body, behind what all foreign necks keep."""

    b = cells("2", "bend [rad]")
    w = cells("2", "its rates [rad/s]")
    s = cells("", "compression [m]")
    v = cells("", "its rate [m/s]")
    e = cells("3, 2", "bend of the branches' dashpots [rad]")
    z = cells("3", "friction of the sheaths, -1 to 1")
    force = cells("3", "on the bend [N m], on s [N]")


def state_size(a: ForeignArrays) -> int:
    """Return the length of the state: the first vector that `step` names is that of its numbers."""
    return FoamState.size(a)


def initialise(a: ForeignArrays, p: FoamNumbers, x: FoamState, outputs: np.ndarray) -> None:
    """Home the tendons at their pretension and let the foam come to rest."""
    x[:] = 0.0
    load = foreign_load(np.zeros(8))
    for _ in range(8000):
        foam_body(p, x, load, 5e-4, True)
    for i in range(3):
        x.free[i] = foam_tendon(p, x, i)[0] - p.pretension[0] / p.tendon[0]
    pitch, roll = foam_lean(x, load)
    foreign_start(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def step(a: ForeignArrays, p: FoamNumbers, x: FoamState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    foreign_enqueue(p, x, inputs)
    load = foreign_load(inputs)
    h = a.setup[0] / a.substeps
    for i in range(a.substeps):
        foam_drives(p, x, foreign_age(a, p, i), h)
        foam_body(p, x, load, h, False)
        pitch, roll = foam_lean(x, load)
        foreign_lag(x, pitch, roll, p.sensor_lag[0], h)
    pitch, roll = foam_lean(x, load)
    foreign_sense(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def foam_drives(p: FoamNumbers, x: FoamState, age: int, h: float) -> None:
    """Move the motors."""
    for i in range(3):
        wanted = min(max(p.drive[0] * (x.queue[age, i] - x.position[i]), -p.drive[1]), p.drive[1])
        x.speed[i] = (x.speed[i] + h * p.drive[2] * wanted) / (1.0 + h * p.drive[2])
        x.position[i] += h * x.speed[i]
        x.travel += h * abs(x.speed[i])


def foam_tendon(p: FoamNumbers, x: FoamState, i: int) -> tuple[float, float, float, float]:
    """Return the span of tendon `i` [m] and its gradient to b1, b2 and s."""
    e1 = p.radius[0] * math.cos(2.0 * math.pi / 3.0 * i)
    e2 = p.radius[0] * math.sin(2.0 * math.pi / 3.0 * i)
    nearer = 1.0 - (x.b[0] * x.b[0] + x.b[1] * x.b[1]) / 6.0
    high = p.length[0] - x.s
    return (
        high * nearer - e1 * x.b[0] - e2 * x.b[1],
        -high * x.b[0] / 3.0 - e1,
        -high * x.b[1] / 3.0 - e2,
        -nearer,
    )


def foam_wound(p: FoamNumbers, position: float) -> float:
    """Return how much rope a drum has taken in [m]."""
    return position * (p.winch_radius[0] + 0.5 * p.drum[0] * position)


def foam_body(p: FoamNumbers, x: FoamState, load: tuple, h: float, homing: bool) -> None:
    """Advance the foam by one substep."""
    payload, up, push1, push2, _ = load
    mass = p.mass[0] + payload
    weight = FOREIGN_GRAVITY * mass
    lever = p.mass[1] + 0.5 * p.length[0]
    square = x.b[0] * x.b[0] + x.b[1] * x.b[1]
    # The centre of mass is at (lever b1, lever b2, const - (L/6 + c/2) |b|^2 - s): an arc's, to second order.
    sink = weight * up[2] * (p.length[0] / 3.0 + p.mass[1])
    even = -p.stiffness[0] + p.stiffness[2] * square - p.stiffness[3] * square * square
    odd = p.stiffness[1]
    x.force[0] = lever * (push1 - weight * up[0]) + (sink + even) * x.b[0] - odd * (x.b[0] * x.b[0] - x.b[1] * x.b[1])
    x.force[1] = lever * (push2 - weight * up[1]) + (sink + even) * x.b[1] + odd * 2.0 * x.b[0] * x.b[1]
    x.force[2] = weight * up[2] - p.axial[0] * x.s
    share = p.sheath[0] * (1.0 + p.grease[0] * math.exp(-x.travel / p.grease[1]))
    for i in range(3):
        span, d1, d2, ds = foam_tendon(p, x, i)
        # Through the sheath runs what the span takes; the drum's end is at rest beyond the elastic rope.
        way = d1 * x.w[0] + d2 * x.w[1] + ds * x.v
        wind = (p.winch_radius[0] + p.drum[0] * x.position[i]) * x.speed[i]
        stretch = span - x.free[i] + foam_wound(p, x.position[i])
        tension = max(0.0, p.tendon[0] * stretch + p.tendon[1] * (way + wind)) if stretch > 0.0 else 0.0
        if homing:
            tension = p.pretension[0]
        # Implicit: friction never passes its largest value, however fast the rope.
        x.z[i] = 0.0 if homing else (x.z[i] + h * way / p.sheath[1]) / (1.0 + h * abs(way) / p.sheath[1])
        x.tension[i] = tension
        pull = tension * (1.0 + share * x.z[i])
        x.force[0] -= pull * d1
        x.force[1] -= pull * d2
        x.force[2] -= pull * ds
    inertia = p.mass[2] + mass * lever * lever
    rate = math.sqrt(x.w[0] * x.w[0] + x.w[1] * x.w[1] + p.loss[2] * p.loss[2])
    damping = p.loss[0] * rate ** (p.loss[1] - 1.0)
    for j in range(2):
        for m in range(3):
            x.force[j] -= p.branch[m] * p.stiffness[0] * (x.b[j] - x.e[m, j])
            # Homing waits until nothing creeps any more.
            part = 1.0 if homing else h / (p.branch_time[m] + h)
            x.e[m, j] += part * (x.b[j] - x.e[m, j])
        x.w[j] = (inertia * x.w[j] + h * x.force[j]) / (inertia + h * damping)
        x.b[j] += h * x.w[j]
    x.v = (mass * x.v + h * x.force[2]) / (mass + h * p.axial[1])
    x.s += h * x.v


def foam_lean(x: FoamState, load: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad]."""
    beta = math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1])
    part = math.sin(beta) / beta if beta > 1e-9 else 1.0
    return foreign_tilt(part * x.b[0], part * x.b[1], math.cos(beta), load[4])


def energy(p: FoamNumbers, x: FoamState, inputs: np.ndarray) -> float:
    """Return kinetic and stored energy [J]; what a sheath's friction holds is left out."""
    payload, up, _, _, _ = foreign_load(inputs)
    mass = p.mass[0] + payload
    lever = p.mass[1] + 0.5 * p.length[0]
    square = x.b[0] * x.b[0] + x.b[1] * x.b[1]
    sunk = x.s + (p.length[0] / 6.0 + 0.5 * p.mass[1]) * square
    total = FOREIGN_GRAVITY * mass * (lever * (up[0] * x.b[0] + up[1] * x.b[1]) - up[2] * sunk)
    total += 0.5 * mass * x.v * x.v + 0.5 * p.axial[0] * x.s * x.s
    total += square * (0.5 * p.stiffness[0] - 0.25 * p.stiffness[2] * square + p.stiffness[3] * square * square / 6.0)
    total += p.stiffness[1] * (x.b[0] ** 3 - 3.0 * x.b[0] * x.b[1] ** 2) / 3.0
    inertia = p.mass[2] + mass * lever * lever
    for j in range(2):
        total += 0.5 * inertia * x.w[j] * x.w[j]
        for m in range(3):
            total += 0.5 * p.branch[m] * p.stiffness[0] * (x.b[j] - x.e[m, j]) ** 2
    for i in range(3):
        stretch = foam_tendon(p, x, i)[0] - x.free[i] + foam_wound(p, x.position[i])
        total += 0.5 * p.tendon[0] * max(0.0, stretch) ** 2
    return total
