"""The equations of kind `greybox`: a bent link between tendons, whose drives stall, seen by a slow sensor.

Lengths of tendon are in radians of motor, tensions in radians of stretch, so that no stiffness appears twice.

- drive: m_j lags its delayed set-point, and stops where its tension reaches `pull_limit`;
- stretch: x_j = pretension + m_j - lever (e_j . b) - s, tension T_j = max(0, x_j): a tendon only pulls;
- bend: b' = gain sum T_j e_j - stiffness (1 +- asymmetry) (b - rest) - stiffening |b|^2 b - friction z;
- compression: s' = axial_rate (compliance (sum (T_j - pretension)) - s);
- hysteresis (Dahl): z' = b' - |b'| z / friction_angle, so |z| <= friction_angle;
- tilt: pitch = atan2(sin|b| b_1/|b|, cos|b|), roll likewise, through a dead time and a first-order lag.

e_j points to tendon j: of a neck 120 deg apart, of another robot as its file says; with one output all lie in a plane.

Bend and compression are taken half implicitly (Rosenbrock, one stage), stable for any rates, and |b| is kept below
1.2 rad: no input moves the output further.
"""

import math

import numpy as np

from softneck.runtime._layout import StateVector, cells, rest

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
NECK_STATES = 7
# A stalled drive gives way as the bend does: 4 ms at 20 ms follow that closely enough.
_SUBSTEPS = 5
_LARGEST_BEND = 1.2


class NeckState(StateVector):
    """What the equations remember."""

    b = cells("2", "bend [rad]")
    z = cells("2", "hysteresis [rad]")
    s = cells("", "compression [rad]")
    sensor = cells("2", "what the sensor says [rad]")
    tilts = rest("the dead time's line: tilts of pitch, newest first, then those of roll [rad]")


def neck_cosine(neck: np.ndarray, j: int) -> float:
    """Return e_j along the first axis, as mounted."""
    if neck.shape[0] == NECK_SIZE:
        return math.cos(neck[NECK_TWIST] + 2.0943951023931953 * j)  # 120 deg apart (Eq. 5)
    sine = NECK_TENDONS + (neck.shape[0] - NECK_TENDONS) // 2
    return math.cos(neck[NECK_TWIST]) * neck[NECK_TENDONS + j] - math.sin(neck[NECK_TWIST]) * neck[sine + j]


def neck_sine(neck: np.ndarray, j: int) -> float:
    """Return e_j along the second axis, as mounted."""
    if neck.shape[0] == NECK_SIZE:
        return math.sin(neck[NECK_TWIST] + 2.0943951023931953 * j)
    sine = NECK_TENDONS + (neck.shape[0] - NECK_TENDONS) // 2
    return math.sin(neck[NECK_TWIST]) * neck[NECK_TENDONS + j] + math.cos(neck[NECK_TWIST]) * neck[sine + j]


def neck_limit(neck: np.ndarray, x: NeckState, j: int) -> float:
    """Return the motor position at which tendon j reaches the pull limit."""
    toward = neck_cosine(neck, j) * x.b[0] + neck_sine(neck, j) * x.b[1]
    # x_j = pull_limit, solved for m_j.
    return neck[NECK_PULL_LIMIT] - neck[NECK_PRETENSION] + neck[NECK_LEVER] * toward + x.s


def neck_advance(neck: np.ndarray, sample_time: float, targets: np.ndarray, m: np.ndarray, x: NeckState) -> None:
    """Move the motors `m` (motors,) towards `targets`, and bend, hysteresis and compression in `x`, by one sample."""
    dt = sample_time / _SUBSTEPS
    keep = math.exp(-neck[NECK_DRIVE_RATE] * dt)  # exact for a target that is held
    for _ in range(_SUBSTEPS):
        for j in range(m.shape[0]):
            # Where the neck moves away a stalled drive gives way: the limit may fall below m.
            m[j] = min(keep * m[j] + (1.0 - keep) * targets[j], neck_limit(neck, x, j))
        pull0 = 0.0
        pull1 = 0.0
        total = 0.0
        taut = 0
        for j in range(m.shape[0]):
            c = neck_cosine(neck, j)
            s = neck_sine(neck, j)
            stretch = neck[NECK_PRETENSION] + m[j] - neck[NECK_LEVER] * (c * x.b[0] + s * x.b[1]) - x.s
            if stretch > 0.0:  # a slack tendon neither pulls nor adds to `rate`
                pull0 += stretch * c
                pull1 += stretch * s
                total += stretch
                taut += 1
        squared = x.b[0] * x.b[0] + x.b[1] * x.b[1]
        loss = neck[NECK_STIFFENING] * squared
        k0 = neck[NECK_STIFFNESS] * (1.0 + neck[NECK_ASYMMETRY])
        k1 = neck[NECK_STIFFNESS] * (1.0 - neck[NECK_ASYMMETRY])
        f0 = neck[NECK_GAIN] * pull0 - k0 * (x.b[0] - neck[NECK_REST]) - loss * x.b[0] - neck[NECK_FRICTION] * x.z[0]
        f1 = (
            neck[NECK_GAIN] * pull1 - k1 * (x.b[1] - neck[NECK_REST + 1]) - loss * x.b[1] - neck[NECK_FRICTION] * x.z[1]
        )
        # Minus the slope of f over b, one number for both directions: the cube's at its steepest, and half of each taut
        # tendon, as e e' of all three add up to 3/2.
        share = 0.5 if neck.shape[0] == NECK_SIZE else neck[NECK_SHARE]
        rate = (
            neck[NECK_STIFFNESS] + 3.0 * loss + share * taut * neck[NECK_GAIN] * neck[NECK_LEVER] + neck[NECK_FRICTION]
        )
        d0 = dt * f0 / (1.0 + dt * rate)  # one stage: (1 + dt rate) d = dt f
        d1 = dt * f1 / (1.0 + dt * rate)
        x.b[0] += d0
        x.b[1] += d1
        size = math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1])
        # Both by one factor: the neck keeps leaning where it leant.
        if size > _LARGEST_BEND:
            x.b[0] *= _LARGEST_BEND / size
            x.b[1] *= _LARGEST_BEND / size
        # Implicit in z: it cannot leave |z| <= friction_angle.
        forget = 1.0 + math.sqrt(d0 * d0 + d1 * d1) / neck[NECK_FRICTION_ANGLE]
        x.z[0] = (x.z[0] + d0) / forget
        x.z[1] = (x.z[1] + d1) / forget
        axial = neck[NECK_AXIAL_RATE]
        rise = axial * (neck[NECK_COMPLIANCE] * (total - m.shape[0] * neck[NECK_PRETENSION]) - x.s)
        # Its slope again: s itself, and each taut tendon, which gets looser as the link gives way.
        x.s += dt * rise / (1.0 + dt * axial * (1.0 + neck[NECK_COMPLIANCE] * taut))


def neck_sense(neck: np.ndarray, sample_time: float, x: NeckState) -> None:
    """Push the tilt of now into the dead time's line behind the states, and move the sensor on."""
    size = math.sqrt(x.b[0] * x.b[0] + x.b[1] * x.b[1])
    part = math.sin(size) / size if size > 1e-9 else 1.0  # sin x / x: the straight neck divides by nothing
    line = x.tilts
    lines = line.shape[0] // 2
    keep = math.exp(-neck[NECK_SENSOR_RATE] * sample_time)
    for axis in range(2):
        tilt = math.atan2(part * x.b[axis], math.cos(size))
        first = axis * lines
        # Out comes the tilt of `lines` samples ago, before that of now goes in.
        seen = tilt
        if lines > 0:
            seen = line[first + lines - 1]
            for i in range(lines - 1, 0, -1):
                line[first + i] = line[first + i - 1]
            line[first] = tilt
        x.sensor[axis] = keep * x.sensor[axis] + (1.0 - keep) * seen  # exact for what is held over the sample
