"""Redefined inputs of any robot, one for each output, and co-contraction, with their map to the motors.

For the neck these are Eq. 9 to 11. In general v = W P with the weights W of the robot's directions; the motors for v
are the ones of smallest norm, W^+ v. Co-contraction does not move the outputs: it is along the vector of W's null space
nearest to (1, .., 1), scaled to mean 1, so that co-contraction is the mean that it adds to the motors (for the neck Eq.
11). The other directions of the null space are held at zero; without a null space there is no co-contraction.
"""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, SettingsError

# Below this share of the largest singular value the motors cannot move a direction.
_MIN_SINGULAR_RATIO = 1e-6
# Tolerance for the part of (1, .., 1) in the null space.
_NULL_SPACE_TOLERANCE = 1e-9


def redefinition_of(weights: Matrix, names: tuple[str, ...]) -> tuple[Matrix, Matrix]:
    """Return T (outputs + 1, motors) to the redefined inputs and co-contraction, and T^-1 (motors, outputs + 1).

    Without a null space the last row and column are zero.

    Args:
        weights: (outputs, motors) of the motors in each output's direction.
        names: of the outputs, for the message.

    Raises:
        SettingsError: the motors cannot move all outputs independently.
    """
    _, s, Vh = np.linalg.svd(weights / np.linalg.norm(weights, axis=1, keepdims=True))
    outputs, motors = weights.shape
    if motors < outputs or s[outputs - 1] < _MIN_SINGULAR_RATIO * s[0]:
        raise SettingsError(
            f"{motors} motor(s) cannot move {', '.join(names)} independently; a controller needs directions that span "
            "all outputs."
        )
    ones = np.ones(motors)
    shared = Vh[outputs:].T @ (Vh[outputs:] @ ones)
    if np.linalg.norm(shared) > _NULL_SPACE_TOLERANCE * np.linalg.norm(ones):
        shared *= motors / shared.sum()
        back = shared / (shared @ shared)
    else:
        shared, back = np.zeros(motors), np.zeros(motors)
    if motors == outputs + 1 and np.abs(shared - 1.0).max() < _NULL_SPACE_TOLERANCE:
        # As in the paper, Eq. 9 to 11: exact means, and an inverse without the rounding of a decomposition.
        T = np.vstack([weights, np.full(motors, 1.0 / motors)])
        return T, np.linalg.inv(T)
    inverse = np.column_stack([np.linalg.pinv(weights), shared])
    # Rounding errors of motors that do not contribute.
    inverse[np.abs(inverse) < 1e-14 * np.abs(inverse).max(axis=0, initial=0.0)] = 0.0
    return np.vstack([weights, back]), inverse
