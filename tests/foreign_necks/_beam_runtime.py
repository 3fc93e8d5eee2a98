"""`beam`: a finite beam element with displacement and slope of its own, Preisach hysteresis, drives short of power.

The tip's displacement d and slope t are independent (Euler-Bernoulli, cubic shape functions), in both planes:

    [F]   EI [ 12  -6 L ] [d]          u = (0.6 d^2 - 0.1 L d t + L^2 t^2 / 15) / L
    [M] = -- [-6 L 4 L^2] [t] ,
          L^3

with u how far the bend lowers the tip: weight and tendons act through it (geometric stiffness: Przemieniecki 1968,
ch. 15). Tendons run straight from base to platform. The slope meets a torque H (t / t_s - m), with m from -1 to 1 the
mean of 136 relays per plane that switch up at alpha and down at beta <= alpha, more of them where alpha - beta is
small (Preisach 1935; Mayergoyz 1991, ch. 1): fibres that follow the bend late. They remember every reversal that was
not wiped out, and a closed loop of t costs energy, as m lags. Two Maxwell branches creep. The dashpot of each plane
is in proportion to its stiffness. Motors have a speed loop of second order and less speed the more they pull; rubbing
falls as the printed layers wear in. The sensor's filter is of second order.
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

# Thresholds of the relays along each side of the triangle beta <= alpha.
BEAM_GRID = 16


class BeamNumbers(ForeignNumbers):
    """Numbers of the beam."""

    length = cells("1", "of the beam [m]")
    angle = cells("3", "of the tendons [rad]")
    radius = cells("1", "of the tendons' holes [m]")
    bending = cells("2", "EI of both planes [N m^2]")
    loss = cells("1", "dashpots, per stiffness [s]")
    creep = cells("4", "Maxwell branches: parts of the stiffness [1], time constants [s]")
    preisach = cells("3", "H [N m], largest threshold t_s [rad], breadth of the density over alpha - beta [rad]")
    wear = cells("2", "additional part of the hysteresis while new [1], way over which it goes [rad]")
    axial = cells("2", "stiffness [N/m] and damping [N s/m] against compression")
    mass = cells("3", "platform [kg], its centre above the tip [m], its own inertia [kg m^2]")
    tendon = cells("2", "stiffness [N/m] and damping [N s/m]")
    drive = cells("4", "gain [1/s], speed limit [rad/s], bandwidth of the speed loop [1/s], load that stops it [N]")
    sensor = cells("2", "bandwidth [rad/s] and damping [1] of the attitude filter")


BEAM = {
    "position_limit": (6.0, 0.0),
    "latency": (0.02, 0.2),
    "sensor_delay": (0.03, 0.1),
    "noise_std": (0.0009, 0.2),
    "rate_noise_std": (0.002, 0.2),
    "noise_quantum": (0.0, 0.0),
    "pretension": (1.5, 0.15),
    "winch_radius": (0.008, 0.0),
    "length": (0.115, 0.01),
    "angle": ((0.0, 2.11, 4.17), 0.005),
    "radius": (0.05, 0.01),
    "bending": ((0.062, 0.07), 0.1),
    "loss": (0.07, 0.2),
    "creep": ((0.2, 0.12, 1.5, 25.0), 0.1),
    "preisach": ((0.08, 0.4, 0.2), 0.1),
    "wear": ((0.3, 200.0), 0.1),
    "axial": ((450.0, 25.0), 0.1),
    "mass": ((0.2, 0.012, 2.5e-4), 0.05),
    "tendon": ((1600.0, 5.0), 0.1),
    "drive": ((12.0, 14.0, 60.0, 22.0), 0.05),
    "sensor": ((40.0, 0.8), 0.1),
}


class BeamState(ForeignState):
    """The body, behind what all foreign necks keep."""

    d = cells("2", "displacement of the tip [m]")
    t = cells("2", "slope of the tip [rad]")
    dd = cells("2", "rate of d [m/s]")
    dt = cells("2", "rate of t [rad/s]")
    s = cells("", "compression [m]")
    v = cells("", "its rate [m/s]")
    ed = cells("2, 2", "displacement of the branches' dashpots [m]")
    et = cells("2, 2", "their slope [rad]")
    relay = cells("2, 136", "1 and -1")
    share = cells("136", "of each relay in m; they add up to 1")
    m = cells("2", "mean of the relays")
    force = cells("5", "on d [N], on t [N m], on s [N]")


def state_size(a: ForeignArrays) -> int:
    """Return the length of the state: the first vector that `step` names is that of its numbers."""
    return BeamState.size(a)


def initialise(a: ForeignArrays, p: BeamNumbers, x: BeamState, outputs: np.ndarray) -> None:
    """Home the tendons at their pretension and let the beam come to rest."""
    x[:] = 0.0
    beam_relays(p, x)
    load = foreign_load(np.zeros(8))
    for _ in range(8000):
        beam_body(p, x, load, 5e-4, True)
    for i in range(3):
        x.free[i] = beam_tendon(p, x, i)[0] - p.pretension[0] / p.tendon[0]
    pitch, roll = beam_lean(x, load)
    foreign_start(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def step(a: ForeignArrays, p: BeamNumbers, x: BeamState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    foreign_enqueue(p, x, inputs)
    load = foreign_load(inputs)
    h = a.setup[0] / a.substeps
    for i in range(a.substeps):
        beam_drives(p, x, foreign_age(a, p, i), h)
        beam_body(p, x, load, h, False)
        pitch, roll = beam_lean(x, load)
        foreign_resonant(x, pitch, roll, p.sensor[0], p.sensor[1], h)
    pitch, roll = beam_lean(x, load)
    foreign_sense(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def beam_relays(p: BeamNumbers, x: BeamState) -> None:
    """Share the torque out and demagnetise: up below the line alpha = -beta, down above it."""
    total = 0.0
    at = 0
    for i in range(BEAM_GRID):
        for j in range(i + 1):
            wide = (i - j) * 2.0 * p.preisach[1] / (BEAM_GRID - 1)
            x.share[at] = math.exp(-wide / p.preisach[2])
            total += x.share[at]
            # On the line itself every second one is up: the mean is 0.
            up = i + j < BEAM_GRID - 1 or (i + j == BEAM_GRID - 1 and i % 2 == 0)
            for axis in range(2):
                x.relay[axis, at] = 1.0 if up else -1.0
            at += 1
    for k in range(at):
        x.share[k] /= total
    for axis in range(2):
        for k in range(at):
            x.m[axis] += x.share[k] * x.relay[axis, k]


def beam_switch(p: BeamNumbers, x: BeamState, axis: int) -> None:
    """Switch the relays of one plane."""
    cell = 2.0 * p.preisach[1] / (BEAM_GRID - 1)
    m = 0.0
    at = 0
    for i in range(BEAM_GRID):
        # Half a cell apart, so that the narrowest relay has a loop as well.
        alpha = -p.preisach[1] + (i + 0.25) * cell
        for j in range(i + 1):
            if x.t[axis] >= alpha:
                x.relay[axis, at] = 1.0
            elif x.t[axis] <= -p.preisach[1] + (j - 0.25) * cell:
                x.relay[axis, at] = -1.0
            m += x.share[at] * x.relay[axis, at]
            at += 1
    x.m[axis] = m


def beam_drives(p: BeamNumbers, x: BeamState, age: int, h: float) -> None:
    """Move the motors."""
    for i in range(3):
        fast = p.drive[1] * max(0.0, 1.0 - x.tension[i] / p.drive[3])
        wanted = min(max(p.drive[0] * (x.queue[age, i] - x.position[i]), -p.drive[1]), fast)
        x.speed[i] = (x.speed[i] + h * p.drive[2] * wanted) / (1.0 + h * p.drive[2])
        x.position[i] += h * x.speed[i]
        x.travel += h * abs(x.speed[i])


def beam_lowered(p: BeamNumbers, x: BeamState) -> float:
    """Return how far bending lowers the tip [m]."""
    L = p.length[0]
    u = 0.0
    for j in range(2):
        u += (0.6 * x.d[j] * x.d[j] - 0.1 * L * x.d[j] * x.t[j] + L * L * x.t[j] * x.t[j] / 15.0) / L
    return u


def beam_tendon(p: BeamNumbers, x: BeamState, i: int) -> tuple[float, float, float, float, float, float]:
    """Return the length of tendon `i` [m] and its gradient to d1, d2, t1, t2 and s."""
    L = p.length[0]
    a1 = p.radius[0] * math.cos(p.angle[i])
    a2 = p.radius[0] * math.sin(p.angle[i])
    g = foreign_gimbal(x.t[0], x.t[1], (a1, a2, 0.0))
    r1 = x.d[0] + g[0] - a1
    r2 = x.d[1] + g[1] - a2
    r3 = L - x.s - beam_lowered(p, x) + g[2]
    length = math.sqrt(r1 * r1 + r2 * r2 + r3 * r3)
    # What bending lowers comes off the third part.
    return (
        length,
        (r1 - r3 * (1.2 * x.d[0] / L - 0.1 * x.t[0])) / length,
        (r2 - r3 * (1.2 * x.d[1] / L - 0.1 * x.t[1])) / length,
        (r1 * g[3] + r2 * g[4] + r3 * (g[5] + 0.1 * x.d[0] - 2.0 * L * x.t[0] / 15.0)) / length,
        (r1 * g[6] + r2 * g[7] + r3 * (g[8] + 0.1 * x.d[1] - 2.0 * L * x.t[1] / 15.0)) / length,
        -r3 / length,
    )


def beam_body(p: BeamNumbers, x: BeamState, load: tuple, h: float, homing: bool) -> None:
    """Advance the element by one substep."""
    payload, up, push1, push2, _ = load
    L = p.length[0]
    mass = p.mass[0] + payload
    weight = FOREIGN_GRAVITY * mass
    f1 = push1 - weight * up[0]
    f2 = push2 - weight * up[1]
    f3 = -weight * up[2]
    g = foreign_gimbal(x.t[0], x.t[1], (0.0, 0.0, p.mass[1]))
    x.force[0] = f1 - f3 * (1.2 * x.d[0] / L - 0.1 * x.t[0])
    x.force[1] = f2 - f3 * (1.2 * x.d[1] / L - 0.1 * x.t[1])
    x.force[2] = f1 * g[3] + f2 * g[4] + f3 * (g[5] + 0.1 * x.d[0] - 2.0 * L * x.t[0] / 15.0)
    x.force[3] = f1 * g[6] + f2 * g[7] + f3 * (g[8] + 0.1 * x.d[1] - 2.0 * L * x.t[1] / 15.0)
    x.force[4] = -f3 - p.axial[0] * x.s
    for i in range(3):
        length, d1, d2, d3, d4, d5 = beam_tendon(p, x, i)
        stretch = length - x.free[i] + p.winch_radius[0] * x.position[i]
        rate = d1 * x.dd[0] + d2 * x.dd[1] + d3 * x.dt[0] + d4 * x.dt[1] + d5 * x.v + p.winch_radius[0] * x.speed[i]
        tension = max(0.0, p.tendon[0] * stretch + p.tendon[1] * rate) if stretch > 0.0 else 0.0
        if homing:
            tension = p.pretension[0]
        x.tension[i] = tension
        x.force[0] -= tension * d1
        x.force[1] -= tension * d2
        x.force[2] -= tension * d3
        x.force[3] -= tension * d4
        x.force[4] -= tension * d5
    rubbing = p.preisach[0] * (1.0 + p.wear[0] * math.exp(-x.travel / p.wear[1]))
    inertia = p.mass[2] + mass * p.mass[1] * p.mass[1]
    for j in range(2):
        k = p.bending[j] / (L * L * L)
        d = x.d[j]
        t = x.t[j]
        for m in range(2):
            d += p.creep[m] * (x.d[j] - x.ed[m, j])
            t += p.creep[m] * (x.t[j] - x.et[m, j])
            # Homing waits until nothing creeps any more.
            part = 1.0 if homing else h / (p.creep[2 + m] + h)
            x.ed[m, j] += part * (x.d[j] - x.ed[m, j])
            x.et[m, j] += part * (x.t[j] - x.et[m, j])
        if not homing:
            beam_switch(p, x, j)
            x.force[2 + j] -= rubbing * (x.t[j] / p.preisach[1] - x.m[j])
        c1 = mass * x.dd[j] + h * (x.force[j] - k * (12.0 * d - 6.0 * L * t))
        c2 = inertia * x.dt[j] + h * (x.force[2 + j] - k * (4.0 * L * L * t - 6.0 * L * d))
        # Dashpots implicit: (M + h eta K) v = c, two by two.
        n = h * p.loss[0] * k
        m11 = mass + 12.0 * n
        m12 = -6.0 * L * n
        m22 = inertia + 4.0 * L * L * n
        determinant = m11 * m22 - m12 * m12
        x.dd[j] = (m22 * c1 - m12 * c2) / determinant
        x.dt[j] = (m11 * c2 - m12 * c1) / determinant
        x.d[j] += h * x.dd[j]
        x.t[j] += h * x.dt[j]
    x.v = (mass * x.v + h * x.force[4]) / (mass + h * p.axial[1])
    x.s += h * x.v


def beam_lean(x: BeamState, load: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad]."""
    g = foreign_gimbal(x.t[0], x.t[1], (0.0, 0.0, 1.0))
    return foreign_tilt(g[0], g[1], g[2], load[4])


def energy(p: BeamNumbers, x: BeamState, inputs: np.ndarray) -> float:
    """Return kinetic and stored energy [J]; what the relays hold is left out."""
    payload, up, _, _, _ = foreign_load(inputs)
    L = p.length[0]
    mass = p.mass[0] + payload
    inertia = p.mass[2] + mass * p.mass[1] * p.mass[1]
    g = foreign_gimbal(x.t[0], x.t[1], (0.0, 0.0, p.mass[1]))
    high = g[2] - x.s - beam_lowered(p, x)
    total = FOREIGN_GRAVITY * mass * (up[0] * (x.d[0] + g[0]) + up[1] * (x.d[1] + g[1]) + up[2] * high)
    total += 0.5 * mass * x.v * x.v + 0.5 * p.axial[0] * x.s * x.s
    for j in range(2):
        k = p.bending[j] / (L * L * L)
        total += 0.5 * mass * x.dd[j] * x.dd[j] + 0.5 * inertia * x.dt[j] * x.dt[j]
        total += beam_bent(k, L, x.d[j], x.t[j])
        for m in range(2):
            total += p.creep[m] * beam_bent(k, L, x.d[j] - x.ed[m, j], x.t[j] - x.et[m, j])
    for i in range(3):
        stretch = beam_tendon(p, x, i)[0] - x.free[i] + p.winch_radius[0] * x.position[i]
        total += 0.5 * p.tendon[0] * max(0.0, stretch) ** 2
    return total


def beam_bent(k: float, L: float, d: float, t: float) -> float:
    """Return the energy of an element with EI / L^3 = k [J]."""
    return k * (6.0 * d * d - 6.0 * L * d * t + 2.0 * L * L * t * t)
