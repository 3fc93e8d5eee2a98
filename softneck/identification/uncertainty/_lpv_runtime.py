"""Two lags whose gain and pole follow the inclination that they themselves make, linear between knots."""

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
    """Fill `outputs` (time, 2) in free run; the first `warm_up` rows start from `measured` (time, 2).

    `gains` and `poles` are (2, m), `delays` (2,) in samples, `inputs` (time, 2) theta_i and phi_i.
    """
    pitch, roll = measured[0, 0], measured[0, 1]
    if not np.isfinite(pitch):  # unknown: upright
        pitch = 0.0
    if not np.isfinite(roll):
        roll = 0.0
    for k in range(outputs.shape[0]):
        outputs[k, 0] = pitch
        outputs[k, 1] = roll
        if k < warm_up and np.isfinite(measured[k, 0]):
            pitch = measured[k, 0]
        if k < warm_up and np.isfinite(measured[k, 1]):
            roll = measured[k, 1]
        # Pitch and roll are atan2(n1, n3) and atan2(n2, n3) of the normal n: the squares of their tangents add up.
        tilt = math.atan(math.hypot(math.tan(pitch), math.tan(roll)))
        a0 = math.exp(-lpv_value(knots, poles[0], tilt) * sample_time)
        a1 = math.exp(-lpv_value(knots, poles[1], tilt) * sample_time)
        u0 = inputs[max(k - int(delays[0]), 0), 0]
        u1 = inputs[max(k - int(delays[1]), 0), 1]
        # Below pi/2, where the tangent ends, whatever a trial of gains and poles does.
        pitch = min(max(a0 * pitch + (1.0 - a0) * lpv_value(knots, gains[0], tilt) * u0, -1.5), 1.5)
        roll = min(max(a1 * roll + (1.0 - a1) * lpv_value(knots, gains[1], tilt) * u1, -1.5), 1.5)
