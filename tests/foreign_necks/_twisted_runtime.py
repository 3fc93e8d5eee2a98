"""`twisted`: a helical print that twists as it is pressed, tendons out of place, Iwan's sliders, a turned sensor.

A gimbal at height h_p turns by theta and phi, and above it the platform by the twist psi about its own axis; it sinks
by s. The elastic energy couples all: K12 theta phi between the axes, K_s s psi between compression and twist (a helix
unwinds: Love 1927, ch. 19). Tendons, at angles and radii of their own, pull at holes that turn with psi, so that each
also twists; the centre of mass is beside the axis. Each axis carries four sliders in parallel, springs k_m that slip
at +-f_m = k_m y_m (Iwan 1966, J. Appl. Mech. 33:893): stiffness falls in steps, and each reversal takes twice as far.
Two Maxwell branches creep. Worm gears sag under load and stand still in a dead zone; sliders weaken as they run in.
The sensor's axes turn with psi and its filter lags 60 ms: it gives Euler angles of a platform that has yawed.
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


class TwistedNumbers(ForeignNumbers):
    """Numbers of the helix."""

    height = cells("2", "of the gimbal above the base, of the platform above the gimbal [m]")
    angle = cells("3", "of the tendons [rad]")
    radius = cells("3", "of the tendons' holes [m]")
    stiffness = cells("3", "of theta, of phi, between them [N m/rad]")
    twist = cells("3", "stiffness [N m/rad], damping [N m s/rad], coupling to the compression [N]")
    damping = cells("1", "viscous loss of theta and phi [N m s/rad]")
    creep = cells("4", "Maxwell branches: parts of the stiffness [1], time constants [s]")
    slider = cells("4", "stiffness of the sliders [N m/rad]")
    slip = cells("4", "angle at which they slip [rad]")
    running_in = cells("2", "additional part of the sliders while new [1], way over which it goes [rad]")
    axial = cells("2", "stiffness [N/m] and damping [N s/m] against compression")
    mass = cells("5", "platform [kg], its centre from the gimbal (x, y, z) [m], its own inertia [kg m^2]")
    tendon = cells("2", "stiffness [N/m] and damping [N s/m]")
    drive = cells("4", "gain [1/s], speed limit [rad/s], sag [rad/s/N], dead zone [rad]")
    sensor_lag = cells("1", "time constant of the attitude filter [s]")


TWISTED = {
    "position_limit": (6.0, 0.0),
    "latency": (0.02, 0.2),
    "sensor_delay": (0.02, 0.1),
    "noise_std": (0.0015, 0.2),
    "rate_noise_std": (0.004, 0.2),
    "noise_quantum": (0.0, 0.0),
    "pretension": (1.3, 0.15),
    "winch_radius": (0.0075, 0.0),
    "height": ((0.06, 0.048), 0.01),
    "angle": ((0.08, 1.98, 4.3), 0.01),
    "radius": ((0.05, 0.046, 0.052), 0.02),
    "stiffness": ((0.75, 0.9, 0.1), 0.1),
    "twist": ((1.2, 0.08, 2.5), 0.1),
    "damping": (0.06, 0.2),
    "creep": ((0.2, 0.1, 2.0, 20.0), 0.1),
    "slider": ((0.3, 0.2, 0.12, 0.08), 0.1),
    "slip": ((0.01, 0.03, 0.08, 0.2), 0.1),
    "running_in": ((0.4, 200.0), 0.1),
    "axial": ((420.0, 25.0), 0.1),
    "mass": ((0.22, 0.004, -0.003, 0.058, 2e-4), 0.05),
    "tendon": ((1600.0, 5.0), 0.1),
    "drive": ((13.0, 12.0, 0.15, 0.02), 0.05),
    "sensor_lag": (0.06, 0.1),
}


class TwistedState(ForeignState):
    """The body, behind what all foreign necks keep."""

    b = cells("3", "theta, phi, psi [rad]")
    w = cells("3", "their rates [rad/s]")
    s = cells("", "compression [m]")
    v = cells("", "its rate [m/s]")
    e = cells("2, 2", "angles of the branches' dashpots [rad]")
    z = cells("4, 2", "stretch of the sliders' springs [rad]")
    force = cells("4", "on theta, phi and psi [N m], on s [N]")


def state_size(a: ForeignArrays) -> int:
    """Return the length of the state: the first vector that `step` names is that of its numbers."""
    return TwistedState.size(a)


def initialise(a: ForeignArrays, p: TwistedNumbers, x: TwistedState, outputs: np.ndarray) -> None:
    """Home the tendons at their pretension and let the helix come to rest."""
    x[:] = 0.0
    load = foreign_load(np.zeros(8))
    for _ in range(8000):
        twisted_body(p, x, load, 5e-4, True)
    for i in range(3):
        x.free[i] = twisted_tendon(p, x, i)[0] - p.pretension[0] / p.tendon[0]
    pitch, roll = twisted_lean(x, load)
    seen1, seen2 = twisted_seen(x, pitch, roll)
    foreign_start(a, p, x, seen1, seen2)
    x.lean[0] = pitch
    x.lean[1] = roll
    foreign_outputs(x, x.s, outputs)


def step(a: ForeignArrays, p: TwistedNumbers, x: TwistedState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    foreign_enqueue(p, x, inputs)
    load = foreign_load(inputs)
    h = a.setup[0] / a.substeps
    for i in range(a.substeps):
        twisted_drives(p, x, foreign_age(a, p, i), h)
        twisted_body(p, x, load, h, False)
        pitch, roll = twisted_lean(x, load)
        seen1, seen2 = twisted_seen(x, pitch, roll)
        foreign_lag(x, seen1, seen2, p.sensor_lag[0], h)
    pitch, roll = twisted_lean(x, load)
    foreign_sense(a, p, x, pitch, roll)
    foreign_outputs(x, x.s, outputs)


def twisted_drives(p: TwistedNumbers, x: TwistedState, age: int, h: float) -> None:
    """Move the motors: dead zone, and sag under the tension above that of homing."""
    for i in range(3):
        error = x.queue[age, i] - x.position[i]
        wanted = 0.0
        if abs(error) > p.drive[3]:
            wanted = p.drive[0] * error - p.drive[2] * (x.tension[i] - p.pretension[0])
        x.speed[i] = min(max(wanted, -p.drive[1]), p.drive[1])
        x.position[i] += h * x.speed[i]
        x.travel += h * abs(x.speed[i])


def twisted_hole(p: TwistedNumbers, x: TwistedState, i: int) -> tuple[float, float]:
    """Return where the hole of tendon `i` is on the platform after the twist [m]."""
    return p.radius[i] * math.cos(p.angle[i] + x.b[2]), p.radius[i] * math.sin(p.angle[i] + x.b[2])


def twisted_tendon(p: TwistedNumbers, x: TwistedState, i: int) -> tuple[float, float, float, float, float]:
    """Return the length of tendon `i` [m] and its gradient to theta, phi, psi and s."""
    h1, h2 = twisted_hole(p, x, i)
    g = foreign_gimbal(x.b[0], x.b[1], (h1, h2, p.height[1]))
    # A quarter turn on is how the hole moves with psi; the gimbal is linear in the point.
    n = foreign_gimbal(x.b[0], x.b[1], (-h2, h1, 0.0))
    r1 = g[0] - p.radius[i] * math.cos(p.angle[i])
    r2 = g[1] - p.radius[i] * math.sin(p.angle[i])
    r3 = g[2] + p.height[0] - x.s
    length = math.sqrt(r1 * r1 + r2 * r2 + r3 * r3)
    return (
        length,
        (r1 * g[3] + r2 * g[4] + r3 * g[5]) / length,
        (r1 * g[6] + r2 * g[7] + r3 * g[8]) / length,
        (r1 * n[0] + r2 * n[1] + r3 * n[2]) / length,
        -r3 / length,
    )


def twisted_centre(p: TwistedNumbers, x: TwistedState) -> tuple[float, float]:
    """Return where the centre of mass is beside the platform's axis after the twist [m]."""
    c = math.cos(x.b[2])
    s = math.sin(x.b[2])
    return p.mass[1] * c - p.mass[2] * s, p.mass[1] * s + p.mass[2] * c


def twisted_body(p: TwistedNumbers, x: TwistedState, load: tuple, h: float, homing: bool) -> None:
    """Advance the platform by one substep."""
    payload, up, push1, push2, _ = load
    mass = p.mass[0] + payload
    weight = FOREIGN_GRAVITY * mass
    f1 = push1 - weight * up[0]
    f2 = push2 - weight * up[1]
    f3 = -weight * up[2]
    c1, c2 = twisted_centre(p, x)
    g = foreign_gimbal(x.b[0], x.b[1], (c1, c2, p.mass[3]))
    n = foreign_gimbal(x.b[0], x.b[1], (-c2, c1, 0.0))
    K = p.stiffness
    x.force[0] = f1 * g[3] + f2 * g[4] + f3 * g[5] - K[0] * x.b[0] - K[2] * x.b[1]
    x.force[1] = f1 * g[6] + f2 * g[7] + f3 * g[8] - K[1] * x.b[1] - K[2] * x.b[0]
    x.force[2] = f1 * n[0] + f2 * n[1] + f3 * n[2] - p.twist[0] * x.b[2] - p.twist[2] * x.s
    x.force[3] = -f3 - p.axial[0] * x.s - p.twist[2] * x.b[2]
    for i in range(3):
        length, d1, d2, d3, d4 = twisted_tendon(p, x, i)
        stretch = length - x.free[i] + p.winch_radius[0] * x.position[i]
        rate = d1 * x.w[0] + d2 * x.w[1] + d3 * x.w[2] + d4 * x.v + p.winch_radius[0] * x.speed[i]
        tension = max(0.0, p.tendon[0] * stretch + p.tendon[1] * rate) if stretch > 0.0 else 0.0
        if homing:
            tension = p.pretension[0]
        x.tension[i] = tension
        x.force[0] -= tension * d1
        x.force[1] -= tension * d2
        x.force[2] -= tension * d3
        x.force[3] -= tension * d4
    rubbing = 1.0 + p.running_in[0] * math.exp(-x.travel / p.running_in[1])
    inertia = p.mass[4] + mass * p.mass[3] * p.mass[3]
    for j in range(2):
        for m in range(2):
            x.force[j] -= p.creep[m] * K[j] * (x.b[j] - x.e[m, j])
            # Homing waits until nothing creeps or sticks any more.
            part = 1.0 if homing else h / (p.creep[2 + m] + h)
            x.e[m, j] += part * (x.b[j] - x.e[m, j])
        for m in range(4):
            x.force[j] -= rubbing * p.slider[m] * x.z[m, j]
        x.w[j] = (inertia * x.w[j] + h * x.force[j]) / (inertia + h * p.damping[0])
        x.b[j] += h * x.w[j]
        for m in range(4):
            stretched = min(max(x.z[m, j] + h * x.w[j], -p.slip[m]), p.slip[m])
            x.z[m, j] = 0.0 if homing else stretched
    x.w[2] = (p.mass[4] * x.w[2] + h * x.force[2]) / (p.mass[4] + h * p.twist[1])
    x.b[2] += h * x.w[2]
    x.v = (mass * x.v + h * x.force[3]) / (mass + h * p.axial[1])
    x.s += h * x.v


def twisted_lean(x: TwistedState, load: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad]."""
    g = foreign_gimbal(x.b[0], x.b[1], (0.0, 0.0, 1.0))
    return foreign_tilt(g[0], g[1], g[2], load[4])


def twisted_seen(x: TwistedState, pitch: float, roll: float) -> tuple[float, float]:
    """Return the Euler angles that a sensor sees which yaws by the twist [rad]."""
    n1 = math.tan(pitch)
    n2 = math.tan(roll)
    size = math.sqrt(1.0 + n1 * n1 + n2 * n2)
    c = math.cos(x.b[2])
    s = math.sin(x.b[2])
    return math.atan(c * n1 + s * n2), math.asin((c * n2 - s * n1) / size)


def energy(p: TwistedNumbers, x: TwistedState, inputs: np.ndarray) -> float:
    """Return kinetic and stored energy [J]."""
    payload, up, _, _, _ = foreign_load(inputs)
    mass = p.mass[0] + payload
    inertia = p.mass[4] + mass * p.mass[3] * p.mass[3]
    c1, c2 = twisted_centre(p, x)
    g = foreign_gimbal(x.b[0], x.b[1], (c1, c2, p.mass[3]))
    total = FOREIGN_GRAVITY * mass * (up[0] * g[0] + up[1] * g[1] + up[2] * (g[2] - x.s))
    total += 0.5 * mass * x.v * x.v + 0.5 * p.axial[0] * x.s * x.s + p.twist[2] * x.s * x.b[2]
    total += 0.5 * p.mass[4] * x.w[2] * x.w[2] + 0.5 * p.twist[0] * x.b[2] * x.b[2] + p.stiffness[2] * x.b[0] * x.b[1]
    rubbing = 1.0 + p.running_in[0] * math.exp(-x.travel / p.running_in[1])
    for j in range(2):
        total += 0.5 * inertia * x.w[j] * x.w[j] + 0.5 * p.stiffness[j] * x.b[j] * x.b[j]
        for m in range(2):
            total += 0.5 * p.creep[m] * p.stiffness[j] * (x.b[j] - x.e[m, j]) ** 2
        for m in range(4):
            total += 0.5 * rubbing * p.slider[m] * x.z[m, j] ** 2
    for i in range(3):
        stretch = twisted_tendon(p, x, i)[0] - x.free[i] + p.winch_radius[0] * x.position[i]
        total += 0.5 * p.tendon[0] * max(0.0, stretch) ** 2
    return total
