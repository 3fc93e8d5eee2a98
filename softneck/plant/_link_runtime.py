"""The soft link: elastic with stiffening, viscous, hysteretic, with gravity and pushes on its platform.

Generalised coordinates are the bending vector b [rad] and the axial compression s [m]. All forces are
generalised: torques on b [N m], a force on s [N].
"""

import math

# The compressed link rests on itself: a wall this many times as stiff as the link itself.
LINK_WALL_RATIO = 50.0


def link_elastic(
    x: tuple[float, float, float, float, float, float],
    c: tuple[float, float, float, float, float, float, float, float, float, float, float],
) -> tuple[float, float, float]:
    """Return the link's own elastic and viscous forces on (b1, b2, s).

    `x` is (b1, b2, s, their rates); `c` is (k1, k2, k12, cubic bending stiffness, bending damping, rest b1,
    rest b2, axial stiffness, cubic axial stiffness, axial damping, compression limit).
    """
    b1, b2, s, w1, w2, v = x
    k1, k2, k12, k3, damping, r1, r2, axial, axial3, axial_damping, limit = c
    stiffening = k3 * (b1 * b1 + b2 * b2)
    force = -axial * s - axial3 * s * s * s - axial_damping * v
    if s > limit:  # zero at the limit: the force has no jump
        force -= LINK_WALL_RATIO * axial * (s - limit)
    return (
        -k1 * (b1 - r1) - k12 * (b2 - r2) - stiffening * b1 - damping * w1,
        -k2 * (b2 - r2) - k12 * (b1 - r1) - stiffening * b2 - damping * w2,
        force,
    )


def link_hysteresis(z1: float, z2: float, w1: float, w2: float, reach: float) -> tuple[float, float]:
    """Return the rates of the hysteresis vector z [rad]: Dahl's model, z' = w - |w| z / reach.

    The torque is -H z / reach. |z| never leaves `reach`; the element only stores and dissipates
    (Dahl 1968; it is Bouc-Wen with n = 1, beta = 1, gamma = 0, here isotropic in two directions).
    """
    # One rate for both directions, by the length of w: that is what makes it isotropic.
    rate = math.sqrt(w1 * w1 + w2 * w2) / reach
    return w1 - rate * z1, w2 - rate * z2


def link_weight(
    b: tuple[float, float, float],
    f: tuple[float, float, float, float, float, float],
    up: tuple[float, float, float],
    load: tuple[float, float, float, float],
) -> tuple[float, float, float]:
    """Return the forces of gravity and push on (b1, b2, s).

    `b` is (b1, b2, length of the arc [m]), `f` the bend functions, `up` the vertical in the base's frame,
    `load` is (weight [N], moment of weight = sum of weight times height above the platform [N m],
    push x [N], push y [N]). Gravity is -grad of weight . (L A + c B) b + height; the push acts on the
    platform's centre.
    """
    b1, b2, length = b
    A, B, _, dA, dB, _ = f
    weight, moment, push1, push2 = load
    # Minus the gradient of up . ((L A + c B) b, L B + c cos beta), summed over the weights.
    side = weight * length * A + moment * B
    turn = weight * length * dA + moment * dB
    sink = up[2] * (weight * length * dB - moment * B)  # d cos(beta) / db = -B b
    # Gravity acts against `up`; its horizontal part leans the platform like a push does.
    lean = turn * (up[0] * b1 + up[1] * b2) + sink
    # The push acts on the link's end: no c, and B has no part in it.
    pushed = length * dA * (push1 * b1 + push2 * b2)
    force1 = -side * up[0] - lean * b1 + length * A * push1 + pushed * b1
    force2 = -side * up[1] - lean * b2 + length * A * push2 + pushed * b2
    # Along s the arc gets shorter, dL = -ds: weight presses the link together.
    along = weight * (A * (up[0] * b1 + up[1] * b2) + up[2] * B) - A * (push1 * b1 + push2 * b2)
    return force1, force2, along
