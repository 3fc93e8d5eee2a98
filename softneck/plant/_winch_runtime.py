"""The neck with torques on its winches instead of set-points: what simulated drives turn.

The state is that of the virtual neck; the integrals of its three speed loops carry the torques, and its drives have
no bandwidth of their own, so that the differential equation stays one and the same.
"""

import numpy as np

from softneck.plant._mechanics_runtime import neck_constants, neck_load
from softneck.plant._neck_runtime import VirtualNeckArrays, VirtualNeckState, neck_runge_kutta, neck_sense

# No drive has so much torque [N m]: what limits it is the drive's business.
WINCH_NO_LIMIT = 1e3


def winch_constants(c: tuple) -> tuple:
    """Return the neck's constants `c` with drives that pass on the torque they are given."""
    d = c[5]
    # Neither bandwidth nor reset: a drive then asks for its integral, which never changes. Back-EMF and supply stay.
    passive = (d[0], d[1], 0.0, 0.0, WINCH_NO_LIMIT, d[5], d[6], d[7], d[8], d[9])
    return c[0], c[1], c[2], c[3], c[4], passive, c[6]


def winch_motion(x: tuple) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return positions [rad] and speeds [rad/s] of the winches from the continuous states."""
    _, _, _, _, _, _, _, _, p1, p2, p3, o1, o2, o3, _, _, _, _, _ = x
    return (p1, p2, p3), (o1, o2, o3)


def winch_advance(
    x: tuple,
    torques: tuple[float, float, float],
    free: tuple[float, float, float],
    c: tuple,
    load: tuple,
    h: float,
    count: int,
) -> tuple:
    """Return the continuous states `h` [s] later under constant `torques` [N m] of the motors at the winches.

    `c` is of `winch_constants`, `load` of `neck_load`; `count` Runge-Kutta steps are taken.
    """
    b1, b2, s, w1, w2, v, z1, z2, p1, p2, p3, o1, o2, o3, _, _, _, f1, f2 = x
    # Torques in the place of the integrals.
    x = (
        b1, b2, s, w1, w2, v, z1, z2, p1, p2, p3, o1, o2, o3, torques[0], torques[1], torques[2], f1, f2
    )  # fmt: skip
    for _ in range(count):
        # The command has no say without a bandwidth.
        x = neck_runge_kutta(x, h / count, (0.0, 0.0, 0.0), free, c, load)
    return x


def winch_sense(
    p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState, disturbance: np.ndarray, outputs: np.ndarray
) -> None:
    """Take one sample of the inclinometer and fill `outputs` (14,) as the neck's own step does.

    To be called once each sample time; `disturbance` is (payload, push x, push y, base tilt pitch and roll).
    """
    load = neck_load(
        parameters,
        float(disturbance[0]),
        float(disturbance[1]),
        float(disturbance[2]),
        float(disturbance[3]),
        float(disturbance[4]),
    )
    neck_sense(p, parameters, x, neck_constants(parameters), load, outputs)
