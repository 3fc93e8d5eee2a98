"""Constant-curvature geometry as even functions of the bending vector, smooth through the straight neck.

The bending vector b = (b1, b2) points where the neck leans, b1 towards tendon 1, and its length beta is the
angle of the arc. With L the arc's length and c a height above the platform, along its normal, a point on
the platform's axis sits at

    horizontal = (L A + c B) b,    height = L B + c cos(beta),
    A = (1 - cos beta) / beta^2,   B = sin(beta) / beta,

and the tendon in direction e_i at radius a is a chord of length (Walker's and the lab's formula,
`l_i = 2 (L / beta - a cos(psi_i - psi)) sin(beta / 2)`)

    l_i = S (L - a b.e_i),         S = sin(beta / 2) / (beta / 2).
"""

import math


def bend_functions(square: float) -> tuple[float, float, float, float, float, float]:
    """Return (A, B, S, A'/beta, B'/beta, S'/beta) at beta^2 = `square`; primes are d/d beta."""
    if square < 0.01:
        # Series to beta^6: the first term left out is below 1e-12 here, and the closed forms lose digits.
        A = 0.5 + square * (-1.0 / 24.0 + square * (1.0 / 720.0 - square / 40320.0))
        B = 1.0 + square * (-1.0 / 6.0 + square * (1.0 / 120.0 - square / 5040.0))
        S = 1.0 + square * (-1.0 / 24.0 + square * (1.0 / 1920.0 - square / 322560.0))
        dA = -1.0 / 12.0 + square * (1.0 / 180.0 + square * (-1.0 / 6720.0 + square / 453600.0))
        dB = -1.0 / 3.0 + square * (1.0 / 30.0 + square * (-1.0 / 840.0 + square / 45360.0))
        dS = -1.0 / 12.0 + square * (1.0 / 480.0 + square * (-1.0 / 53760.0 + square / 11612160.0))
        return A, B, S, dA, dB, dS
    half = 0.5 * math.sqrt(square)
    sine = math.sin(half)
    cosine = math.cos(half)
    # Of the half angle alone: sin(beta) = 2 sin cos, and 1 - cos(beta) = 2 sin^2, which loses no digits.
    S = sine / half
    B = S * cosine
    A = 0.5 * S * S
    # Derivatives of the definitions above; divided by beta they are even, as A, B and S are.
    inverse = 1.0 / square
    dA = (B - 2.0 * A) * inverse
    dB = (1.0 - B) * inverse - A  # (cos(beta) - B) / beta^2
    dS = (cosine - S) * inverse
    return A, B, S, dA, dB, dS


def tilt_rotation(pitch: float, roll: float) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the rotation, row by row, that leans the vertical by the tilt vector (pitch, roll) [rad]."""
    # Rodrigues' formula about the horizontal axis (-roll, pitch): no yaw.
    square = pitch * pitch + roll * roll
    A, B, _, _, _, _ = bend_functions(square)
    cosine = math.cos(math.sqrt(square))
    return (
        1.0 - A * pitch * pitch,
        -A * pitch * roll,
        B * pitch,
        -A * pitch * roll,
        1.0 - A * roll * roll,
        B * roll,
        -B * pitch,
        -B * roll,
        cosine,
    )


def lean_angles(
    bend: tuple[float, float, float, float],
    f: tuple[float, float, float, float, float, float],
    R: tuple[float, float, float, float, float, float, float, float, float],
) -> tuple[float, float, float, float]:
    """Return (pitch, roll, pitch rate, roll rate) against the vertical, as an inclinometer defines them.

    With n the platform's normal, pitch = atan2(n1, n3) and roll = atan2(n2, n3). `bend` is the bending
    vector and its rate, `f` the bend functions there, `R` turns the neck's base into the world.
    """
    b1, b2, w1, w2 = bend
    A, B, _, _, dB, _ = f
    along = b1 * w1 + b2 * w2
    # The normal's rate as the base sees it: d beta/dt = b.w / beta, and the primes come divided by beta.
    k1 = B * w1 + dB * along * b1
    k2 = B * w2 + dB * along * b2
    k3 = -B * along
    n1, n2, n3 = lean_normal(b1, b2, A, B, R)
    v1 = R[0] * k1 + R[1] * k2 + R[2] * k3
    v2 = R[3] * k1 + R[4] * k2 + R[5] * k3
    v3 = R[6] * k1 + R[7] * k2 + R[8] * k3
    pitch_rate = (n3 * v1 - n1 * v3) / (n1 * n1 + n3 * n3)
    roll_rate = (n3 * v2 - n2 * v3) / (n2 * n2 + n3 * n3)
    return math.atan2(n1, n3), math.atan2(n2, n3), pitch_rate, roll_rate


def lean_normal(
    b1: float, b2: float, A: float, B: float, R: tuple[float, float, float, float, float, float, float, float, float]
) -> tuple[float, float, float]:
    """Return the platform's normal n in the world."""
    m1 = B * b1
    m2 = B * b2
    # As the base sees it; 1 - A beta^2 is cos(beta).
    m3 = 1.0 - A * (b1 * b1 + b2 * b2)
    return (R[0] * m1 + R[1] * m2 + R[2] * m3, R[3] * m1 + R[4] * m2 + R[5] * m3, R[6] * m1 + R[7] * m2 + R[8] * m3)
