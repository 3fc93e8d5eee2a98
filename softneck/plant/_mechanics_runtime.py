"""The neck's differential equation: link, tendons, their drives, attitude filter.

Its 19 states (10 + 3 n with n tendons) are the parts of `NeckBody` before the free lengths; for speed they go from
function to function as a tuple in that order. Inertia is constant: that of a platform on a link bent by small angles,
M (L0/2 + c)^2 + J; how it changes with the bend is left out, as the neck is overdamped. A robot of one output bends in
one plane: its second bend stays zero.
"""

import math

import numpy as np

from softneck.plant._drive_runtime import drive_rates
from softneck.plant._geometry_runtime import bend_functions, lean_angles, lean_normal, tilt_rotation
from softneck.plant._index_runtime import (
    NECK_ATTACHMENT_RADIUS,
    NECK_AXIAL_DAMPING,
    NECK_AXIAL_STIFFENING,
    NECK_AXIAL_STIFFNESS,
    NECK_BENDING_DAMPING,
    NECK_BENDING_STIFFENING,
    NECK_BENDING_STIFFNESS,
    NECK_COMPRESSION_LIMIT,
    NECK_CURRENT_LIMIT,
    NECK_GEAR_EFFICIENCY,
    NECK_GEAR_FRICTION,
    NECK_GEAR_RATIO,
    NECK_GUIDE_FRICTION,
    NECK_GUIDE_SPEED,
    NECK_HYSTERESIS_ANGLE,
    NECK_HYSTERESIS_TORQUE,
    NECK_LINK_LENGTH,
    NECK_LINK_MASS,
    NECK_MOTOR_RESISTANCE,
    NECK_PAYLOAD_HEIGHT,
    NECK_PLATFORM_HEIGHT,
    NECK_PLATFORM_MASS,
    NECK_PLATFORM_RADIUS,
    NECK_POSITION_GAIN,
    NECK_PRETENSION,
    NECK_REST_PITCH,
    NECK_REST_ROLL,
    NECK_ROTOR_INERTIA,
    NECK_SENSOR_LAG,
    NECK_SPEED_BANDWIDTH,
    NECK_SPEED_INTEGRAL_TIME,
    NECK_SPEED_LIMIT,
    NECK_STIFFNESS_ANGLE,
    NECK_STIFFNESS_ASYMMETRY,
    NECK_SUPPLY_VOLTAGE,
    NECK_TENDON_ANGLE,
    NECK_TENDON_DAMPING,
    NECK_TENDON_STIFFNESS,
    NECK_TORQUE_CONSTANT,
    NECK_WINCH_RADIUS,
)
from softneck.plant._link_runtime import LINK_WALL_RATIO, link_elastic, link_hysteresis, link_weight
from softneck.plant._tendon_runtime import tendon_chord, tendon_tension
from softneck.runtime._layout import StateVector, cells, value
from softneck.runtime._sizes_runtime import MOTORS, OUTPUTS

NECK_GRAVITY = 9.80665
# Winch speed over which the gear's Coulomb friction is smoothed [rad/s]; numerical.
NECK_GEAR_EDGE = 0.2
# Runge-Kutta 4 is stable to 2.78 along both axes; half of that keeps the fastest modes accurate enough.
NECK_STABLE = 1.4
NECK_MOST_SUBSTEPS = 2000


class NeckBody(StateVector):
    """The continuous states, in the order of `neck_rates`, and the tendons' lengths, which stay."""

    motors = value("setup", written=True)
    b = cells("2", "bending vector, towards where the neck leans [rad]")
    s = cells("", "compression of the link [m]")
    w = cells("2", "rates of b [rad/s]")
    v = cells("", "rate of s [m/s]")
    z = cells("2", "hysteresis [rad]")
    position = cells("motors", "of the winches [rad]")
    speed = cells("motors", "of the winches [rad/s]")
    integral = cells("motors", "of the drives' speed loops: torque at the winch [N m]")
    filtered = cells("2", "pitch and roll behind the attitude filter [rad]")
    free = cells("motors", "unstretched lengths of the tendons at winch position zero [m]")


def neck_constants(q: np.ndarray) -> tuple:
    """Return (link, hysteresis, tendon, geometry, directions, drive, filter) from the parameters."""
    k = float(q[NECK_BENDING_STIFFNESS])
    # K = k diag(1 + alpha, 1 - alpha) in planes turned by the angle.
    asymmetry = float(q[NECK_STIFFNESS_ASYMMETRY])
    double = 2.0 * float(q[NECK_STIFFNESS_ANGLE])
    link = (
        k * (1.0 + asymmetry * math.cos(double)),
        k * (1.0 - asymmetry * math.cos(double)),
        k * asymmetry * math.sin(double),
        float(q[NECK_BENDING_STIFFENING]),
        float(q[NECK_BENDING_DAMPING]),
        float(q[NECK_REST_PITCH]),
        float(q[NECK_REST_ROLL]),
        float(q[NECK_AXIAL_STIFFNESS]),
        float(q[NECK_AXIAL_STIFFENING]),
        float(q[NECK_AXIAL_DAMPING]),
        float(q[NECK_COMPRESSION_LIMIT]),
    )
    hysteresis = (float(q[NECK_HYSTERESIS_TORQUE]), float(q[NECK_HYSTERESIS_ANGLE]))
    tendon = (
        float(q[NECK_TENDON_STIFFNESS]),
        float(q[NECK_TENDON_DAMPING]),
        float(q[NECK_GUIDE_FRICTION]),
        float(q[NECK_GUIDE_SPEED]),
    )
    geometry = (float(q[NECK_LINK_LENGTH]), float(q[NECK_ATTACHMENT_RADIUS]))
    directions = tuple((math.cos(q[NECK_TENDON_ANGLE + j]), math.sin(q[NECK_TENDON_ANGLE + j])) for j in range(MOTORS))
    rest = (float(q[NECK_WINCH_RADIUS]), float(q[NECK_SENSOR_LAG]), float(q[NECK_PRETENSION]))
    return link, hysteresis, tendon, geometry, directions, neck_drive(q), rest


def neck_drive(q: np.ndarray) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Return the constants of `drive_rates` at the winch."""
    ratio = float(q[NECK_GEAR_RATIO])
    constant = float(q[NECK_TORQUE_CONSTANT])
    per_ampere = constant * ratio * float(q[NECK_GEAR_EFFICIENCY])  # torque at the winch [N m/A]
    resistance = float(q[NECK_MOTOR_RESISTANCE])
    return (
        float(q[NECK_POSITION_GAIN]),
        float(q[NECK_SPEED_LIMIT]),
        float(q[NECK_SPEED_BANDWIDTH]),
        1.0 / float(q[NECK_SPEED_INTEGRAL_TIME]),
        float(q[NECK_CURRENT_LIMIT]) * per_ampere,
        float(q[NECK_SUPPLY_VOLTAGE]) / resistance * per_ampere,  # stall torque at full supply
        constant * ratio / resistance * per_ampere,  # back-EMF: torque that each rad/s takes of it
        float(q[NECK_ROTOR_INERTIA]) * ratio * ratio,  # the rotor's, seen through the gear
        float(q[NECK_GEAR_FRICTION]),
        NECK_GEAR_EDGE,
    )


def neck_load(
    q: np.ndarray, payload: float, push_x: float, push_y: float, base_pitch: float, base_roll: float
) -> tuple:
    """Return (weight and push, vertical in the base's frame, base rotation, bending inertia, axial mass)."""
    # A quarter of the link's mass at its end has the gravity moment of the whole; its inertia differs by 25 %.
    platform = float(q[NECK_PLATFORM_MASS])
    link = 0.25 * float(q[NECK_LINK_MASS])
    carried = max(payload, 0.0)
    # A negative payload could make mass or inertia negative.
    height = float(q[NECK_PLATFORM_HEIGHT])
    above = float(q[NECK_PAYLOAD_HEIGHT])
    half = 0.5 * float(q[NECK_LINK_LENGTH])
    mass = platform + link + carried
    weight = (NECK_GRAVITY * mass, NECK_GRAVITY * (platform * height + carried * above), push_x, push_y)
    R = tilt_rotation(base_pitch, base_roll)
    # A thin disc about its diameter.
    disc = 0.25 * platform * float(q[NECK_PLATFORM_RADIUS]) ** 2
    # Straight up, the platform moves by L0/2 + c for each rad of b: A = 1/2 and B = 1.
    inertia = platform * (half + height) ** 2 + link * half**2 + carried * (half + above) ** 2 + disc
    # Third row of R: the vertical, as the base sees it.
    return weight, (R[6], R[7], R[8]), R, inertia, mass


def neck_disturbed(q: np.ndarray, disturbance: np.ndarray) -> tuple:
    """Return the load under `disturbance`: payload [kg], push [N] and tilt of the base [rad] along each output."""
    push_y, base_roll = 0.0, 0.0
    if OUTPUTS > 1:
        push_y, base_roll = float(disturbance[2]), float(disturbance[4])
    return neck_load(
        q, float(disturbance[0]), float(disturbance[1]), push_y, float(disturbance[1 + OUTPUTS]), base_roll
    )


def neck_rates(x: tuple, command: tuple, free: tuple, c: tuple, load: tuple) -> tuple:
    """Return the time derivatives of the states; `command` [rad] and `free` [m] have one entry for each motor."""
    b1, b2, s, w1, w2, v, z1, z2 = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
    f1, f2 = x[8 + 3 * MOTORS], x[9 + 3 * MOTORS]
    link, hysteresis, tendon, geometry, directions, drive, rest = c
    winch = rest[0]
    body = (b1, b2, s, w1, w2, v)
    f = bend_functions(b1 * b1 + b2 * b2)
    q1, q2, qs = link_elastic(body, link)
    # The arc is L0 - s long.
    g1, g2, gs = link_weight((b1, b2, geometry[0] - s), f, load[1], load[0])
    # Behind the link's eight come positions, speeds and integrals of the drives.
    chords = tuple(tendon_chord(body, f, directions[j], geometry) for j in range(MOTORS))
    # Coulomb friction of guides and gears, each smoothed over its speed.
    sliding, turning = tendon[3], drive[9]
    signs = tanh_each(
        (*(chords[j][1] / sliding for j in range(MOTORS)), *(x[8 + MOTORS + j] / turning for j in range(MOTORS)))
    )
    pulls = tuple(neck_pull(chords[j], x[8 + j], x[8 + MOTORS + j], free[j], signs[j], c) for j in range(MOTORS))
    force1, force2, force = q1 + g1, q2 + g2, qs + gs
    for j in range(MOTORS):
        force1 += pulls[j][1]
        force2 += pulls[j][2]
        force += pulls[j][3]
    stuck = hysteresis[0] / hysteresis[1]  # H / z_r
    dz1, dz2 = link_hysteresis(z1, z2, w1, w2, hysteresis[1])
    inertia = load[3]
    # The tendon's torque r T stands against the drive's.
    driven = tuple(
        drive_rates(
            (x[8 + j], x[8 + MOTORS + j], x[8 + 2 * MOTORS + j]),
            command[j],
            winch * pulls[j][0],
            signs[MOTORS + j],
            drive,
        )
        for j in range(MOTORS)
    )
    n1, n2, n3 = lean_normal(b1, b2, f[0], f[1], load[2])
    return (
        w1,
        w2,
        v,
        (force1 - stuck * z1) / inertia,
        (force2 - stuck * z2) / inertia if OUTPUTS > 1 else 0.0,
        force / load[4],
        dz1,
        dz2,
        *(x[8 + MOTORS + j] for j in range(MOTORS)),
        *(driven[j][0] for j in range(MOTORS)),
        *(driven[j][1] for j in range(MOTORS)),
        (math.atan2(n1, n3) - f1) / rest[1],
        (math.atan2(n2, n3) - f2) / rest[1],
    )


def tanh_each(values: tuple) -> tuple:
    """Return the hyperbolic tangent of each; C has them side by side."""
    return tuple(math.tanh(values[j]) for j in range(2 * MOTORS))


def neck_pull(
    chord: tuple[float, float, float, float, float],
    position: float,
    speed: float,
    free: float,
    sliding: float,
    c: tuple,
) -> tuple[float, float, float, float]:
    """Return (tension at the winch [N], its forces on b1, b2 and s) of one tendon."""
    winch = c[6][0]
    length, slide, g1, g2, gs = chord
    # Stretch l - l0 + r P and its rate; the guide feels the tendon slide past it, the winch's turning not included.
    at_winch, at_platform = tendon_tension(length - free + winch * position, slide + winch * speed, sliding, c[2])
    # A tendon shortens if it can: forces are minus its tension along the length's gradient.
    return at_winch, -at_platform * g1, -at_platform * g2, -at_platform * gs


def neck_tensions(x: tuple, free: tuple, c: tuple) -> tuple:
    """Return the tensions at the winches [N] in the continuous states `x`."""
    body = (x[0], x[1], x[2], x[3], x[4], x[5])
    f = bend_functions(x[0] * x[0] + x[1] * x[1])
    chords = tuple(tendon_chord(body, f, c[4][j], c[3]) for j in range(MOTORS))
    # The guides' friction shows at the platform alone.
    return tuple(neck_pull(chords[j], x[8 + j], x[8 + MOTORS + j], free[j], 0.0, c)[0] for j in range(MOTORS))


def neck_lean(x: NeckBody, load: tuple) -> tuple[float, float, float, float]:
    """Return (pitch, roll, pitch rate, roll rate) against the vertical."""
    return lean_angles((x.b[0], x.b[1], x.w[0], x.w[1]), bend_functions(x.b[0] * x.b[0] + x.b[1] * x.b[1]), load[2])


def neck_rest(q: np.ndarray, c: tuple) -> tuple:
    """Return (b1, b2, s, free length of each tendon) at rest: all tensions at the pretension, no payload.

    A fixed point: bending from the link's stiffness, compression by Newton. It contracts while the
    pretension and the weights stay below the load that buckles the link, which `NeckParameters` checks.
    """
    link = c[0]
    pretension = c[6][2]
    load = neck_load(q, 0.0, 0.0, 0.0, 0.0, 0.0)
    b1 = link[5]
    b2 = link[6] if OUTPUTS > 1 else 0.0
    s = 0.0
    for _ in range(200):
        body = (b1, b2, s, 0.0, 0.0, 0.0)
        f = bend_functions(b1 * b1 + b2 * b2)
        q1, q2, qs = link_elastic(body, link)
        g1, g2, gs = link_weight((b1, b2, c[3][0] - s), f, load[1], load[0])
        q1 += g1
        q2 += g2
        qs += gs
        for i in range(MOTORS):
            _, _, t1, t2, ts = tendon_chord(body, f, c[4][i], c[3])
            q1 -= pretension * t1
            q2 -= pretension * t2
            qs -= pretension * ts
        # Newton along s. Along b the link's own stiffness does: weights and tendons only weaken it, below buckling.
        slope = link[7] + 3.0 * link[8] * s * s
        if s > link[10]:
            slope += LINK_WALL_RATIO * link[7]
        # K^-1 q, each row by its Schur complement.
        k1 = link[0] + 3.0 * link[3] * (b1 * b1 + b2 * b2)
        k2 = link[1] + 3.0 * link[3] * (b1 * b1 + b2 * b2)
        if OUTPUTS > 1:
            b1 += (q1 - link[2] / k2 * q2) / (k1 - link[2] * link[2] / k2)
            k2 = link[1] + 3.0 * link[3] * (b1 * b1 + b2 * b2)
            b2 += (q2 - link[2] / k1 * q1) / (k2 - link[2] * link[2] / k1)
        else:
            b1 += q1 / k1
        s += qs / slope
    f = bend_functions(b1 * b1 + b2 * b2)
    body = (b1, b2, s, 0.0, 0.0, 0.0)
    # So long that the pretension alone stretches them.
    stretch = pretension / c[2][0]
    return (b1, b2, s, *(tendon_chord(body, f, c[4][j], c[3])[0] - stretch for j in range(MOTORS)))


def neck_substeps(c: tuple, load: tuple, sample_time: float, wanted: int) -> int:
    """Return substeps per sample: `wanted`, or more where the stiffest mode asks for it."""
    link, hysteresis, tendon, geometry, _, drive, rest = c
    winch = rest[0]
    # The highest tension to reckon with: what a drive can pull at its current limit, and half of it again.
    pull = 1.5 * max(drive[4] / winch, rest[2])
    # Guides at their steepest, where tanh has slope 1, are dampers too; all tendons pull.
    loss = MOTORS * (tendon[1] + tendon[2] * pull / tendon[3])
    arm = geometry[1] ** 2
    # Bounds, not values: 3 k3 is the cube's slope at 1 rad, H / z_r the hysteresis' at a turn.
    stiffness = (
        max(link[0], link[1]) + abs(link[2]) + 3.0 * link[3] + hysteresis[0] / hysteresis[1] + MOTORS * tendon[0] * arm
    )
    # d / J bounds an overdamped mode, the root of k / J an undamped one, their sum both.
    bending = (link[4] + loss * arm) / load[3] + math.sqrt(stiffness / load[3])
    # As if the link rested on its wall.
    wall = link[7] * (1.0 + LINK_WALL_RATIO) + 3.0 * link[8] * link[10] ** 2 + MOTORS * tendon[0]
    axial = (link[9] + loss) / load[4] + math.sqrt(wall / load[4])
    inertia = drive[7]
    # The gear's friction at its steepest, as the guides' above.
    damped = tendon[1] * winch * winch / inertia + drive[8] / (drive[9] * inertia)
    driven = drive[2] + damped + math.sqrt(tendon[0] * winch * winch / inertia)
    fastest = max(max(bending, axial), max(driven, 1.0 / rest[1]))
    needed = math.ceil(sample_time * fastest / NECK_STABLE)
    # Capped: a neck that asks for more is simulated no finer.
    return min(max(wanted, needed), NECK_MOST_SUBSTEPS)
