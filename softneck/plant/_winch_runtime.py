"""The neck with torques on its winches instead of set-points, for simulated drives.

The state is that of the virtual neck; the integrals of its speed loops carry the torques, and its drives have
no bandwidth of their own, so that the differential equation stays one and the same.
"""

import numpy as np

from softneck.plant._mechanics_runtime import neck_constants, neck_disturbed
from softneck.plant._neck_runtime import VirtualNeckArrays, VirtualNeckState, neck_runge_kutta, neck_sense
from softneck.runtime._sizes_runtime import MOTORS

# No drive has so much torque [N m]: what limits it is the drive's business.
WINCH_NO_LIMIT = 1e3


def winch_constants(c: tuple) -> tuple:
    """Return the neck's constants `c` with drives that pass on the torque they are given."""
    d = c[5]
    # Neither bandwidth nor reset: a drive then asks for its integral, which never changes. Back-EMF and supply stay.
    passive = (d[0], d[1], 0.0, 0.0, WINCH_NO_LIMIT, d[5], d[6], d[7], d[8], d[9])
    return c[0], c[1], c[2], c[3], c[4], passive, c[6]


def winch_motion(x: tuple) -> tuple[tuple, tuple]:
    """Return positions [rad] and speeds [rad/s] of the winches from the continuous states."""
    return tuple(x[8 + j] for j in range(MOTORS)), tuple(x[8 + MOTORS + j] for j in range(MOTORS))


def winch_advance(x: tuple, torques: tuple, free: tuple, c: tuple, load: tuple, h: float, count: int) -> tuple:
    """Return the continuous states `h` [s] later under constant `torques` [N m] of the motors at the winches.

    `c` is of `winch_constants`, `load` of `neck_load`; `count` Runge-Kutta steps are taken.
    """
    # Torques in the place of the integrals, behind which the two filtered angles stand.
    x = (
        *(x[i] for i in range(8 + 2 * MOTORS)),
        *(torques[j] for j in range(MOTORS)),
        x[8 + 3 * MOTORS],
        x[9 + 3 * MOTORS],
    )
    # The command has no say without a bandwidth.
    still = tuple(0.0 for _ in range(MOTORS))
    for _ in range(count):
        x = neck_runge_kutta(x, h / count, still, free, c, load)
    return x


def winch_sense(
    p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState, disturbance: np.ndarray, outputs: np.ndarray
) -> None:
    """Take one sample of the inclinometer and fill `outputs` as the neck's own step does.

    To be called once each sample time; `disturbance` is the block's inputs behind the set-points.
    """
    load = neck_disturbed(parameters, disturbance)
    neck_sense(p, parameters, x, neck_constants(parameters), load, outputs)
