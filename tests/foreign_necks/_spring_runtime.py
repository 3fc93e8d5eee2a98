"""`spring`: a printed coil spring with Bouc-Wen hysteresis, drives with dead zone and backlash, Euler angles.

The bend b [rad] moves the platform as if it were small: tendon i, at direction e_i and radius a_i of its own (none sits
where the drawing has it), is l_i = (L - s)(1 - kappa |b|^2) - a_i b . e_i long. The spring's matrix K has its main axes
between the motors' (cross-coupling), and coils that touch stiffen it against compression. Each axis carries a torque
H_j z_j with

    z_j' = (b_j' - (beta |b_j'| |z_j|^(n-1) z_j + gamma b_j' |z_j|^n)) / r_j

(Bouc 1967; Wen 1976, J. Eng. Mech. 102:249; beta >= |gamma|: passive, Erlicher and Point 2004, C. R. Mecanique 332:51),
and a Maxwell branch that creeps. A motor stands still while its error is within the dead zone, which is wider while
the grease is cold. Between motor and winch there is play: a tendon that pulls draws the winch to the one end, a slack
one leaves it where the motor has pushed it. The sensor gives Euler angles of a filter of second order:
roll = asin(n_2), not the inclination.
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
    foreign_gimbal,
    foreign_load,
    foreign_outputs,
    foreign_resonant,
    foreign_sense,
    foreign_start,
    foreign_tilt,
)


class SpringNumbers(ForeignNumbers):
    """Numbers of the spring."""

    length = cells("2", "of the spring [m]; kappa, how a bend brings the ends together [1/rad^2]")
    angle = cells("3", "of the tendons [rad]")
    radius = cells("3", "of the tendons' holes [m]")
    stiffness = cells("3", "K11, K22 and K12 [N m/rad]")
    damping = cells("1", "viscous loss [N m s/rad]")
    creep = cells("2", "Maxwell branch: part of the stiffness [1], time constant [s]")
    hysteresis = cells("2", "H of both axes [N m]")
    yielding = cells("2", "r of both axes [rad]")
    wen = cells("3", "beta, gamma, n [1]")
    axial = cells("4", "stiffness [N/m], damping [N s/m], compression at which coils touch [m], stiffness then [N/m]")
    mass = cells("3", "platform [kg], its lever [m], its own inertia [kg m^2]")
    tendon = cells("2", "stiffness [N/m] and damping [N s/m]")
    drive = cells("3", "gain [1/s], speed limit [rad/s], bandwidth of the speed loop [1/s]")
    dead_zone = cells("3", "half width [rad], additional part while cold [1], way over which it goes [rad]")
    backlash = cells("3", "play [rad], pull that moves the winch in it [N], its speed per pull above that [rad/s/N]")
    sensor = cells("2", "bandwidth [rad/s] and damping [1] of the attitude filter")


SPRING = {
    "position_limit": (6.0, 0.0),
    "latency": (0.02, 0.2),
    "sensor_delay": (0.02, 0.1),
    "noise_std": (0.0006, 0.2),
    "rate_noise_std": (0.001, 0.2),
    "noise_quantum": (0.0, 0.0),
    "pretension": (1.6, 0.15),
    "winch_radius": (0.0075, 0.0),
    "length": ((0.1, 0.05), 0.01),
    "angle": ((0.05, 2.03, 4.25), 0.01),
    "radius": ((0.05, 0.047, 0.052), 0.02),
    "stiffness": ((0.75, 0.85, 0.07), 0.1),
    "damping": (0.05, 0.2),
    "creep": ((0.2, 8.0), 0.1),
    "hysteresis": ((0.02, 0.026), 0.1),
    "yielding": ((0.05, 0.06), 0.1),
    "wen": ((0.6, 0.4, 1.6), 0.0),
    "axial": ((420.0, 20.0, 0.022, 4000.0), 0.1),
    "mass": ((0.24, 0.05, 2e-4), 0.05),
    "tendon": ((1500.0, 4.0), 0.1),
    "drive": ((11.0, 14.0, 80.0), 0.05),
    "dead_zone": ((0.03, 0.5, 100.0), 0.1),
    "backlash": ((0.08, 0.4, 8.0), 0.1),
    "sensor": ((45.0, 0.8), 0.1),
}


class SpringState(ForeignState):
    """The body, behind what all foreign necks keep."""

    b = cells("2", "bend [rad]")
    w = cells("2", "its rates [rad/s]")
    s = cells("", "compression [m]")
    v = cells("", "its rate [m/s]")
    e = cells("2", "bend of the branch's dashpots [rad]")
    z = cells("2", "hysteresis, -1 to 1")
    winch = cells("3", "position of the winches [rad]")
    turning = cells("3", "their speed [rad/s]")
    force = cells("3", "on the bend [N m], on s [N]")


def state_size(a: ForeignArrays) -> int:
    """Return the length of the state: the first vector that `step` names is that of its numbers."""
    return SpringState.size(a)


def initialise(a: ForeignArrays, p: SpringNumbers, x: SpringState, outputs: np.ndarray) -> None:
    """Home the tendons at their pretension and let the spring come to rest."""
    x[:] = 0.0
    load = foreign_load(np.zeros(8))
    for i in range(3):
        # Homing pulls: every winch lies at the end of its play.
        x.winch[i] = -0.5 * p.backlash[0]
    for _ in range(8000):
        spring_body(p, x, load, 5e-4, True)
    for i in range(3):
        x.free[i] = spring_tendon(p, x, i)[0] + p.winch_radius[0] * x.winch[i] - p.pretension[0] / p.tendon[0]
    pitch, roll = spring_lean(x, load)
    foreign_start(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def step(a: ForeignArrays, p: SpringNumbers, x: SpringState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    foreign_enqueue(p, x, inputs)
    load = foreign_load(inputs)
    h = a.setup[0] / a.substeps
    for i in range(a.substeps):
        spring_drives(p, x, foreign_age(a, p, i), h)
        spring_body(p, x, load, h, False)
        pitch, roll = spring_lean(x, load)
        # asin(n_2) of a normal whose inclinations are pitch and roll.
        euler = math.atan(math.tan(roll) * math.cos(pitch))
        foreign_resonant(x, pitch, euler, p.sensor[0], p.sensor[1], h)
    pitch, roll = spring_lean(x, load)
    foreign_sense(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def spring_drives(p: SpringNumbers, x: SpringState, age: int, h: float) -> None:
    """Move motors with a dead zone, and winches within their play."""
    dead = p.dead_zone[0] * (1.0 + p.dead_zone[1] * math.exp(-x.travel / p.dead_zone[2]))
    half = 0.5 * p.backlash[0]
    for i in range(3):
        error = x.queue[age, i] - x.position[i]
        wanted = 0.0
        if abs(error) > dead:
            wanted = min(max(p.drive[0] * error, -p.drive[1]), p.drive[1])
        # Implicit in the speed.
        x.speed[i] = (x.speed[i] + h * p.drive[2] * wanted) / (1.0 + h * p.drive[2])
        x.position[i] += h * x.speed[i]
        x.travel += h * abs(x.speed[i])
        before = x.winch[i]
        drawn = before - h * p.backlash[2] * max(0.0, x.tension[i] - p.backlash[1])
        x.winch[i] = min(max(drawn, x.position[i] - half), x.position[i] + half)
        x.turning[i] = (x.winch[i] - before) / h


def spring_tendon(p: SpringNumbers, x: SpringState, i: int) -> tuple[float, float, float, float]:
    """Return the length of tendon `i` [m] and its gradient to b1, b2 and s."""
    e1 = p.radius[i] * math.cos(p.angle[i])
    e2 = p.radius[i] * math.sin(p.angle[i])
    square = x.b[0] * x.b[0] + x.b[1] * x.b[1]
    high = p.length[0] - x.s
    nearer = 1.0 - p.length[1] * square
    return (
        high * nearer - e1 * x.b[0] - e2 * x.b[1],
        -2.0 * p.length[1] * high * x.b[0] - e1,
        -2.0 * p.length[1] * high * x.b[1] - e2,
        -nearer,
    )


def spring_body(p: SpringNumbers, x: SpringState, load: tuple, h: float, homing: bool) -> None:
    """Advance the spring by one substep."""
    payload, up, push1, push2, _ = load
    mass = p.mass[0] + payload
    weight = FOREIGN_GRAVITY * mass
    lever = p.mass[1]
    # The centre of mass is at (lever b1, lever b2, const - lever |b|^2 / 2 - s).
    x.force[0] = lever * (push1 - weight * (up[0] - up[2] * x.b[0]))
    x.force[1] = lever * (push2 - weight * (up[1] - up[2] * x.b[1]))
    x.force[2] = weight * up[2] - p.axial[0] * x.s - p.axial[3] * max(0.0, x.s - p.axial[2])
    x.force[0] -= p.stiffness[0] * x.b[0] + p.stiffness[2] * x.b[1]
    x.force[1] -= p.stiffness[1] * x.b[1] + p.stiffness[2] * x.b[0]
    for i in range(3):
        length, d1, d2, ds = spring_tendon(p, x, i)
        stretch = length - x.free[i] + p.winch_radius[0] * x.winch[i]
        rate = d1 * x.w[0] + d2 * x.w[1] + ds * x.v + p.winch_radius[0] * x.turning[i]
        tension = max(0.0, p.tendon[0] * stretch + p.tendon[1] * rate) if stretch > 0.0 else 0.0
        if homing:
            tension = p.pretension[0]
        x.tension[i] = tension
        x.force[0] -= tension * d1
        x.force[1] -= tension * d2
        x.force[2] -= tension * ds
    inertia = p.mass[2] + mass * lever * lever
    for j in range(2):
        own = p.stiffness[j]
        x.force[j] -= p.creep[0] * own * (x.b[j] - x.e[j]) + p.hysteresis[j] * x.z[j]
        x.w[j] = (inertia * x.w[j] + h * x.force[j]) / (inertia + h * p.damping[0])
        x.b[j] += h * x.w[j]
        size = abs(x.z[j])
        lost = p.wen[0] * abs(x.w[j]) * size ** (p.wen[2] - 1.0) * x.z[j] + p.wen[1] * x.w[j] * size ** p.wen[2]
        x.z[j] += h * (x.w[j] - lost) / p.yielding[j]
        # Homing shakes the spring until nothing creeps or sticks any more.
        x.e[j] += (1.0 if homing else h / (p.creep[1] + h)) * (x.b[j] - x.e[j])
        if homing:
            x.z[j] = 0.0
    x.v = (mass * x.v + h * x.force[2]) / (mass + h * p.axial[1])
    x.s += h * x.v


def spring_lean(x: SpringState, load: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad]."""
    g = foreign_gimbal(x.b[0], x.b[1], (0.0, 0.0, 1.0))
    return foreign_tilt(g[0], g[1], g[2], load[4])


def energy(p: SpringNumbers, x: SpringState, inputs: np.ndarray) -> float:
    """Return kinetic and stored energy [J]."""
    payload, up, _, _, _ = foreign_load(inputs)
    mass = p.mass[0] + payload
    lever = p.mass[1]
    sunk = x.s + 0.5 * lever * (x.b[0] * x.b[0] + x.b[1] * x.b[1])
    total = FOREIGN_GRAVITY * mass * (lever * (up[0] * x.b[0] + up[1] * x.b[1]) - up[2] * sunk)
    total += 0.5 * mass * x.v * x.v + 0.5 * p.axial[0] * x.s * x.s
    total += 0.5 * p.axial[3] * max(0.0, x.s - p.axial[2]) ** 2 + p.stiffness[2] * x.b[0] * x.b[1]
    inertia = p.mass[2] + mass * lever * lever
    for j in range(2):
        bent = x.b[j] * x.b[j] + p.creep[0] * (x.b[j] - x.e[j]) ** 2
        total += 0.5 * inertia * x.w[j] * x.w[j] + 0.5 * p.stiffness[j] * bent
        total += 0.5 * p.hysteresis[j] * p.yielding[j] * x.z[j] * x.z[j]
    for i in range(3):
        stretch = spring_tendon(p, x, i)[0] - x.free[i] + p.winch_radius[0] * x.winch[i]
        total += 0.5 * p.tendon[0] * max(0.0, stretch) ** 2
    return total
