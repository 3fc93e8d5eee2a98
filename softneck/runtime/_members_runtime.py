"""Members of a composed runtime; a bundle replaces these functions (see `_bundle`).

The arrays of the members follow those that the outer module declares.
"""

import numpy as np


def member_count() -> int:
    """Return the number of members."""
    raise NotImplementedError


def member_size(arrays: object, member: int) -> int:
    """Return the length of a member's state."""
    raise NotImplementedError


def member_initialise(
    arrays: object, member: int, parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray
) -> None:
    """Fill a member's state and outputs at t_0."""
    raise NotImplementedError


def member_step(
    arrays: object, member: int, parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Advance a member by one sample."""
    raise NotImplementedError


def member_tangent(
    arrays: object,
    member: int,
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
    state_rows: np.ndarray,
    inputs_rows: np.ndarray,
    outputs_rows: np.ndarray,
    moved: int,
) -> None:
    """Advance a member by one sample, with the derivatives of its state and outputs along `moved` directions."""
    raise NotImplementedError
