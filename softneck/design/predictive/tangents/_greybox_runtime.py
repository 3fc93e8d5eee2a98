"""Kind `greybox` with what the planned moves make of its angles; `tangent` is the derivative of `step` in free run.

`rows`: those of b, z, s, sensor and its line of tilts, as in the state.
"""

import math

import numpy as np

from softneck.design.predictive.tangents._shared_runtime import tangent_motors
from softneck.identification.structured._greybox_runtime import initialise as initialise
from softneck.identification.structured._greybox_runtime import state_size as state_size
from softneck.identification.structured._greybox_runtime import step as step
from softneck.identification.structured._neck_equations_runtime import (
    _LARGEST_BEND,
    _SUBSTEPS,
    NECK_ASYMMETRY,
    NECK_AXIAL_RATE,
    NECK_COMPLIANCE,
    NECK_DRIVE_RATE,
    NECK_FRICTION,
    NECK_FRICTION_ANGLE,
    NECK_GAIN,
    NECK_LEVER,
    NECK_PRETENSION,
    NECK_REST,
    NECK_SENSOR_RATE,
    NECK_STATES,
    NECK_STIFFENING,
    NECK_STIFFNESS,
    NECK_TWIST,
    neck_limit,
)


def tangent_pulls(
    neck: np.ndarray, m: np.ndarray, x: np.ndarray, M: np.ndarray, X: np.ndarray, pulls: np.ndarray
) -> int:
    """Fill the rows of both pulls and of their total, in `pulls` (3, 1 + nz), values first; return the taut tendons."""
    pulls[:] = 0.0
    taut = 0
    for j in range(3):
        angle = neck[NECK_TWIST] + 2.0943951023931953 * j
        c, s = math.cos(angle), math.sin(angle)
        stretch = neck[NECK_PRETENSION] + m[j] - neck[NECK_LEVER] * (c * x[0] + s * x[1]) - x[4]
        if stretch > 0.0:
            taut += 1
            moved = M[j] - neck[NECK_LEVER] * (c * X[0] + s * X[1]) - X[4]
            for row in range(3):
                share = c if row == 0 else (s if row == 1 else 1.0)
                pulls[row, 0] += share * stretch
                pulls[row, 1:] += share * moved
    return taut


def tangent_bend(
    neck: np.ndarray,
    dt: float,
    taut: int,
    x: np.ndarray,
    X: np.ndarray,
    pulls: np.ndarray,
    d: np.ndarray,
    D: np.ndarray,
) -> None:
    """Fill the bend's move `d` (2,) of a substep and its rows `D`."""
    squared = x[0] * x[0] + x[1] * x[1]
    loss = neck[NECK_STIFFENING] * squared
    lossy = 2.0 * neck[NECK_STIFFENING] * (x[0] * X[0] + x[1] * X[1])
    rate = neck[NECK_STIFFNESS] + 3.0 * loss + 0.5 * taut * neck[NECK_GAIN] * neck[NECK_LEVER] + neck[NECK_FRICTION]
    below = 1.0 + dt * rate
    for axis in range(2):
        stiff = neck[NECK_STIFFNESS] * (1.0 + (neck[NECK_ASYMMETRY] if axis == 0 else -neck[NECK_ASYMMETRY]))
        f = neck[NECK_GAIN] * pulls[axis, 0] - stiff * (x[axis] - neck[NECK_REST + axis]) - loss * x[axis]
        f -= neck[NECK_FRICTION] * x[2 + axis]
        d[axis] = dt * f / below
        moved = neck[NECK_GAIN] * pulls[axis, 1:] - (stiff + loss) * X[axis] - x[axis] * lossy
        moved = moved - neck[NECK_FRICTION] * X[2 + axis]
        D[axis] = dt / below * moved - 3.0 * dt * d[axis] / below * lossy


def tangent_substep(
    neck: np.ndarray, dt: float, targets: np.ndarray, m: np.ndarray, x: np.ndarray, aims: np.ndarray, M: np.ndarray,
    X: np.ndarray,
) -> None:  # fmt: skip
    """Move motors `m` and neck `x` by one substep of `neck_advance`, and their rows `M` and `X` with them."""
    keep = math.exp(-neck[NECK_DRIVE_RATE] * dt)
    for j in range(3):
        limit = neck_limit(neck, x, j)
        m[j] = keep * m[j] + (1.0 - keep) * targets[j]
        M[j] = keep * M[j] + (1.0 - keep) * aims[j]
        if m[j] > limit:
            angle = neck[NECK_TWIST] + 2.0943951023931953 * j
            m[j] = limit
            M[j] = neck[NECK_LEVER] * (math.cos(angle) * X[0] + math.sin(angle) * X[1]) + X[4]
    pulls = np.empty((3, 1 + X.shape[1]))
    taut = tangent_pulls(neck, m, x, M, X, pulls)
    d, D = np.empty(2), np.empty((2, X.shape[1]))
    tangent_bend(neck, dt, taut, x, X, pulls, d, D)
    for axis in range(2):
        x[axis] += d[axis]
        X[axis] += D[axis]
    size = math.sqrt(x[0] * x[0] + x[1] * x[1])
    if size > _LARGEST_BEND:
        along = (x[0] * X[0] + x[1] * X[1]) / (size * size)
        for axis in range(2):
            X[axis] = _LARGEST_BEND / size * (X[axis] - x[axis] * along)
            x[axis] *= _LARGEST_BEND / size
    far = math.sqrt(d[0] * d[0] + d[1] * d[1])
    forget = 1.0 + far / neck[NECK_FRICTION_ANGLE]
    # A neck that stands still may start either way; below 1e-12 rad a substep is rounding, and no direction.
    lost = (d[0] * D[0] + d[1] * D[1]) / (math.sqrt(far * far + 1e-24) * neck[NECK_FRICTION_ANGLE])
    for axis in range(2):
        x[2 + axis] = (x[2 + axis] + d[axis]) / forget
        X[2 + axis] = (X[2 + axis] + D[axis] - x[2 + axis] * lost) / forget
    axial, soft = neck[NECK_AXIAL_RATE], neck[NECK_COMPLIANCE]
    share = dt * axial / (1.0 + dt * axial * (1.0 + soft * taut))
    x[4] += share * (soft * (pulls[2, 0] - 3.0 * neck[NECK_PRETENSION]) - x[4])
    X[4] += share * (soft * pulls[2, 1:] - X[4])


def tangent_sense(neck: np.ndarray, sample_time: float, x: np.ndarray, X: np.ndarray) -> None:
    """Move the rows of tilts and sensor on, as `neck_sense` does; `x` (5 at least) is the neck before it."""
    size = math.sqrt(x[0] * x[0] + x[1] * x[1])
    part, curve = 1.0, -1.0 / 3.0
    if size > 1e-9:
        part = math.sin(size) / size
        curve = (math.cos(size) - part) / (size * size)
    cosine = math.cos(size)
    lines = (X.shape[0] - NECK_STATES) // 2
    keep = math.exp(-neck[NECK_SENSOR_RATE] * sample_time)
    along = x[0] * X[0] + x[1] * X[1]
    for axis in range(2):
        a = part * x[axis]
        # Of atan2(a, cos |b|).
        moved = cosine * (part * X[axis] + curve * x[axis] * along) + a * part * along
        seen = moved / (a * a + cosine * cosine)
        first = NECK_STATES + axis * lines
        if lines > 0:
            tilt = seen
            seen = X[first + lines - 1].copy()
            for i in range(lines - 1, 0, -1):
                X[first + i] = X[first + i - 1]
            X[first] = tilt
        X[5 + axis] = keep * X[5 + axis] + (1.0 - keep) * seen


def tangent(
    arrays: tuple[np.ndarray, ...],
    k: int,
    before: np.ndarray,
    state: np.ndarray,
    line: np.ndarray,
    rows: np.ndarray,
    slopes: np.ndarray,
) -> None:
    """Move `line` and `rows` on over [t_k, t_k+1) and fill `slopes` (2, nz) of pitch and roll at t_k+1.

    before, state: the model's state at t_k and, after its step, at t_k+1.
    """
    h = int(arrays[0][0])
    tangent_motors(arrays, k, line)
    x = before[8 * h + 13 : 8 * h + 18].copy()
    m = state[3 * h : 3 * h + 3].copy()
    M = line[8 * k + 3 : 8 * k + 6].copy()
    targets, aims = np.empty(3), np.zeros((3, line.shape[1]))
    for j in range(3):
        back = int(arrays[1][j, 1]) - 1
        targets[j] = state[3 * back + j]
        if k - back >= 0:
            aims[j] = line[8 * (k - back) + j]
    for _ in range(_SUBSTEPS):
        tangent_substep(arrays[2], arrays[3][1] / _SUBSTEPS, targets, m, x, aims, M, rows)
    tangent_sense(arrays[2], arrays[3][1], x, rows)
    line[8 * k + 11 : 8 * k + 14] = M
    slopes[0] = rows[5]
    slopes[1] = rows[6]
