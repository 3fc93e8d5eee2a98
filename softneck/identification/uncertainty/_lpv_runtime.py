"""Lags of one or two angles whose gain and pole follow the inclination that they make, linear between knots."""

import math

import numpy as np


def lpv_value(knots: np.ndarray, values: np.ndarray, at: float) -> float:
    """Return `values` (m,) linear between `knots` (m,), constant beyond."""
    m = knots.shape[0]
    if m == 1 or at <= knots[0]:
        return float(values[0])
    for i in range(1, m):
        if at <= knots[i]:
            part = (at - knots[i - 1]) / (knots[i] - knots[i - 1])
            return float((1.0 - part) * values[i - 1] + part * values[i])
    return float(values[m - 1])


def lpv_simulate(
    knots: np.ndarray,
    gains: np.ndarray,
    poles: np.ndarray,
    delays: np.ndarray,
    sample_time: float,
    inputs: np.ndarray,
    measured: np.ndarray,
    warm_up: int,
    outputs: np.ndarray,
) -> None:
    """Fill `outputs` (time, n) in free run; the first `warm_up` rows start from `measured` (time, n).

    `gains` and `poles` are (n, m), `delays` (n,) in samples, `inputs` (time, n) theta_i and phi_i.
    """
    n = outputs.shape[1]
    angles = np.zeros(2)  # a robot of one angle has no roll
    for axis in range(n):
        if np.isfinite(measured[0, axis]):  # unknown: upright
            angles[axis] = measured[0, axis]
    for k in range(outputs.shape[0]):
        for axis in range(n):
            outputs[k, axis] = angles[axis]
            if k < warm_up and np.isfinite(measured[k, axis]):
                angles[axis] = measured[k, axis]
        # Pitch and roll are atan2(n1, n3) and atan2(n2, n3) of the normal n: the squares of their tangents add up.
        tilt = math.atan(math.hypot(math.tan(angles[0]), math.tan(angles[1])))
        for axis in range(n):
            a = math.exp(-lpv_value(knots, poles[axis], tilt) * sample_time)
            u = inputs[max(k - int(delays[axis]), 0), axis]
            # Below pi/2, where the tangent ends, whatever a trial of gains and poles does.
            ahead = a * angles[axis] + (1.0 - a) * lpv_value(knots, gains[axis], tilt) * u
            angles[axis] = min(max(ahead, -1.5), 1.5)
