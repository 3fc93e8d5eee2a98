"""`column`: a platform in a gimbal on a silicone column, four Maxwell branches, softening, drives that give way.

The platform turns by theta, then phi, about a gimbal at height h_p that sinks by s; tendons are straight from base to
platform, l_i = |p_i(theta, phi, s) - a e_i|. The column is a generalised Maxwell body (Wiechert): beside its spring,
branches of stiffness g_m k and time constants from 0.1 to 40 s carry torque that creeps away (Prony series: Ferry
1980, ch. 3),

    torque = -k D (theta + sum g_m (theta - e_m)),   e_m' = (theta - e_m) / tau_m.

D = 1 - m (1 - exp(-beta_max / r)) is the softening by the largest bend so far (Mullins effect: Ogden and Roxburgh 1999,
Proc. R. Soc. A 455:2861). Braided tendons are soft at first (toe region): T = k_t x^2 / (x + x_t). Winches move at
gain (P* - P) less a part of their load, and not faster than the load leaves them: both sag under tension. The body is
symmetric under mirroring roll, not under a third of a turn.
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
    foreign_lag,
    foreign_load,
    foreign_outputs,
    foreign_sense,
    foreign_start,
    foreign_tilt,
)


class ColumnNumbers(ForeignNumbers):
    """Numbers of the column."""

    height = cells("2", "of the gimbal above the base, of the platform above the gimbal [m]")
    radius = cells("1", "of the tendons' holes [m]")
    stiffness = cells("1", "of the column against bending [N m/rad]")
    damping = cells("1", "viscous loss [N m s/rad]")
    branch = cells("4", "stiffness of the Maxwell branches, parts of the column's [1]")
    branch_time = cells("4", "their time constants [s]")
    softening = cells("2", "largest softening [1], bend over which it comes [rad]")
    axial = cells("2", "stiffness [N/m] and damping [N s/m] against compression")
    mass = cells("3", "platform [kg], its centre above the gimbal [m], its own inertia [kg m^2]")
    tendon = cells("3", "stiffness [N/m], toe [m], damping [N s/m]")
    drive = cells("4", "gain [1/s], speed limit [rad/s], sag [rad/s/N], load that stops it [N]")
    sensor_lag = cells("1", "time constant of the attitude filter [s]")


COLUMN = {
    "position_limit": (6.0, 0.0),
    "latency": (0.02, 0.2),
    "sensor_delay": (0.03, 0.1),
    "noise_std": (0.0012, 0.2),
    "rate_noise_std": (0.004, 0.2),
    "noise_quantum": (0.00087, 0.0),
    "pretension": (1.2, 0.15),
    "winch_radius": (0.0075, 0.0),
    "height": ((0.055, 0.05), 0.01),
    "radius": (0.045, 0.01),
    "stiffness": (0.75, 0.1),
    "damping": (0.03, 0.2),
    "branch": ((0.35, 0.25, 0.2, 0.15), 0.1),
    "branch_time": ((0.12, 0.9, 6.0, 35.0), 0.1),
    "softening": ((0.2, 0.15), 0.1),
    "axial": ((450.0, 25.0), 0.1),
    "mass": ((0.2, 0.06, 2e-4), 0.05),
    "tendon": ((2200.0, 0.0006, 4.0), 0.1),
    "drive": ((11.0, 12.0, 0.25, 25.0), 0.05),
    "sensor_lag": (0.015, 0.1),
}


class ColumnState(ForeignState):
    """The body, behind what all foreign necks keep."""

    b = cells("2", "angles of the gimbal [rad]")
    w = cells("2", "their rates [rad/s]")
    s = cells("", "compression [m]")
    v = cells("", "its rate [m/s]")
    e = cells("4, 2", "angles of the branches' dashpots [rad]")
    worst = cells("", "largest bend so far [rad]")
    force = cells("3", "on theta and phi [N m], on s [N]")


def state_size(a: ForeignArrays) -> int:
    """Return the length of the state: the first vector that `step` names is that of its numbers."""
    return ColumnState.size(a)


def initialise(a: ForeignArrays, p: ColumnNumbers, x: ColumnState, outputs: np.ndarray) -> None:
    """Home the tendons at their pretension and let the column come to rest."""
    x[:] = 0.0
    load = foreign_load(np.zeros(8))
    for _ in range(8000):
        column_body(p, x, load, 5e-4, True)
    # Stretch of the toe law at the pretension: k x^2 = T (x + t).
    ratio = p.pretension[0] / p.tendon[0]
    stretch = 0.5 * (ratio + math.sqrt(ratio * ratio + 4.0 * ratio * p.tendon[1]))
    for i in range(3):
        x.free[i] = column_tendon(p, x, i)[0] - stretch
    pitch, roll = column_lean(x, load)
    foreign_start(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def step(a: ForeignArrays, p: ColumnNumbers, x: ColumnState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    foreign_enqueue(p, x, inputs)
    load = foreign_load(inputs)
    h = a.setup[0] / a.substeps
    for i in range(a.substeps):
        column_drives(p, x, foreign_age(a, p, i), h)
        column_body(p, x, load, h, False)
        pitch, roll = column_lean(x, load)
        foreign_lag(x, pitch, roll, p.sensor_lag[0], h)
    pitch, roll = column_lean(x, load)
    foreign_sense(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def column_drives(p: ColumnNumbers, x: ColumnState, age: int, h: float) -> None:
    """Move the motors, which sag under the tendons' tension above that of homing."""
    for i in range(3):
        load = x.tension[i] - p.pretension[0]
        wanted = p.drive[0] * (x.queue[age, i] - x.position[i]) - p.drive[2] * load
        # Pulling, the load leaves less speed; letting go, it does not add any.
        fast = p.drive[1] * max(0.0, 1.0 - x.tension[i] / p.drive[3])
        x.speed[i] = min(max(wanted, -p.drive[1]), fast)
        x.position[i] += h * x.speed[i]
        x.travel += h * abs(x.speed[i])


def column_tendon(p: ColumnNumbers, x: ColumnState, i: int) -> tuple[float, float, float, float]:
    """Return the length of tendon `i` [m] and its gradient to theta, phi and s."""
    c = p.radius[0] * math.cos(2.0 * math.pi / 3.0 * i)
    d = p.radius[0] * math.sin(2.0 * math.pi / 3.0 * i)
    g = foreign_gimbal(x.b[0], x.b[1], (c, d, p.height[1]))
    r1 = g[0] - c
    r2 = g[1] - d
    r3 = g[2] + p.height[0] - x.s
    length = math.sqrt(r1 * r1 + r2 * r2 + r3 * r3)
    return (
        length,
        (r1 * g[3] + r2 * g[4] + r3 * g[5]) / length,
        (r1 * g[6] + r2 * g[7] + r3 * g[8]) / length,
        -r3 / length,
    )


def column_soft(p: ColumnNumbers, x: ColumnState) -> float:
    """Return what is left of the stiffness after the largest bend so far."""
    return 1.0 - p.softening[0] * (1.0 - math.exp(-x.worst / p.softening[1]))


def column_body(p: ColumnNumbers, x: ColumnState, load: tuple, h: float, homing: bool) -> None:
    """Advance the gimbal by one substep."""
    payload, up, push1, push2, _ = load
    mass = p.mass[0] + payload
    weight = FOREIGN_GRAVITY * mass
    f1 = push1 - weight * up[0]
    f2 = push2 - weight * up[1]
    f3 = -weight * up[2]
    g = foreign_gimbal(x.b[0], x.b[1], (0.0, 0.0, p.mass[1]))
    x.force[0] = f1 * g[3] + f2 * g[4] + f3 * g[5]
    x.force[1] = f1 * g[6] + f2 * g[7] + f3 * g[8]
    x.force[2] = -f3 - p.axial[0] * x.s
    for i in range(3):
        length, d1, d2, ds = column_tendon(p, x, i)
        stretch = length - x.free[i] + p.winch_radius[0] * x.position[i]
        rate = d1 * x.w[0] + d2 * x.w[1] + ds * x.v + p.winch_radius[0] * x.speed[i]
        tension = 0.0
        if stretch > 0.0:
            tension = max(0.0, p.tendon[0] * stretch * stretch / (stretch + p.tendon[1]) + p.tendon[2] * rate)
        if homing:
            tension = p.pretension[0]
        x.tension[i] = tension
        x.force[0] -= tension * d1
        x.force[1] -= tension * d2
        x.force[2] -= tension * ds
    soft = column_soft(p, x)
    inertia = p.mass[2] + mass * p.mass[1] * p.mass[1]
    for j in range(2):
        bent = x.b[j]
        for m in range(4):
            bent += p.branch[m] * (x.b[j] - x.e[m, j])
            # Homing waits until nothing creeps any more.
            part = 1.0 if homing else h / (p.branch_time[m] + h)
            x.e[m, j] += part * (x.b[j] - x.e[m, j])
        x.w[j] = (inertia * x.w[j] + h * (x.force[j] - p.stiffness[0] * soft * bent)) / (inertia + h * p.damping[0])
        x.b[j] += h * x.w[j]
    x.v = (mass * x.v + h * x.force[2]) / (mass + h * p.axial[1])
    x.s += h * x.v
    x.worst = max(x.worst, math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1]))


def column_lean(x: ColumnState, load: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad]."""
    g = foreign_gimbal(x.b[0], x.b[1], (0.0, 0.0, 1.0))
    return foreign_tilt(g[0], g[1], g[2], load[4])


def energy(p: ColumnNumbers, x: ColumnState, inputs: np.ndarray) -> float:
    """Return kinetic and stored energy [J]."""
    payload, up, _, _, _ = foreign_load(inputs)
    mass = p.mass[0] + payload
    inertia = p.mass[2] + mass * p.mass[1] * p.mass[1]
    g = foreign_gimbal(x.b[0], x.b[1], (0.0, 0.0, p.mass[1]))
    total = FOREIGN_GRAVITY * mass * (up[0] * g[0] + up[1] * g[1] + up[2] * (g[2] - x.s))
    total += 0.5 * mass * x.v * x.v + 0.5 * p.axial[0] * x.s * x.s
    soft = column_soft(p, x)
    for j in range(2):
        bent = x.b[j] * x.b[j]
        for m in range(4):
            bent += p.branch[m] * (x.b[j] - x.e[m, j]) ** 2
        total += 0.5 * inertia * x.w[j] * x.w[j] + 0.5 * p.stiffness[0] * soft * bent
    for i in range(3):
        stretch = max(0.0, column_tendon(p, x, i)[0] - x.free[i] + p.winch_radius[0] * x.position[i])
        toe = p.tendon[1]
        total += p.tendon[0] * (0.5 * stretch * stretch - toe * stretch + toe * toe * math.log(1.0 + stretch / toe))
    return total
