"""The controller without limits, as the linear system that it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_runtime

from . import _mpc_state_runtime as rt

if TYPE_CHECKING:
    import control


# Far beyond anything: no limit acts.
_FREE = 1e12
# Small against the reference's own bound, so that it stays linear; powers of two scale without rounding.
_UNIT = 2.0**-10


def lti(arrays: tuple[Matrix, ...], *, name: str = "mpc") -> control.StateSpace:
    """Return it from (pitch_reference, roll_reference, pitch, roll) to (theta_i, phi_i).

    Its matrices are what the runtime's own `step` does to unit vectors. With preview the reference counts as known
    only when it comes.
    """
    import control

    A, B, C, D = system(arrays)
    return control.StateSpace(
        A, B, C, D, float(rt.MpcArrays(arrays).constants[rt.MPC_TS]),
        inputs=["pitch_reference", "roll_reference", "pitch", "roll"], outputs=["theta_i", "phi_i"], name=name,
    )  # fmt: skip


def system(arrays: tuple[Matrix, ...]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, D of `lti`."""
    step = load_runtime("softneck.design.predictive._mpc_runtime").step
    a = rt.MpcArrays(arrays)
    at, q = rt.MpcState.parts(a), a.constants
    numbers = np.arange(at["active"].stop)
    kept = np.concatenate([numbers[at[name]] for name in ("held", "filtered", "models", "offsets", "past", "coming")])
    # Tautness is the fifth where angles have no limit, else the sixth.
    soft = [_FREE] * int(q[rt.MPC_TAUT_AT] - q[rt.MPC_ANGLE_AT])
    parameters = np.array([_FREE, _FREE, _FREE, -_FREE, *soft, -_FREE])
    ahead = 2 if q[rt.MPC_AHEAD] > 0 else 0
    ports = 10 + ahead + int(q[rt.MPC_DISTURBANCES])

    def image(state_at: int, input_at: int) -> tuple[Vector, Vector]:
        state, u = np.zeros(numbers.size), np.zeros(ports)
        state[at["started"]] = 1.0
        u[8:10] = 1.0
        if state_at >= 0:
            state[state_at] = _UNIT
        else:
            u[(0, 1, 3, 4)[input_at]] = _UNIT
            if input_at < 2 and ahead:
                u[10 + input_at] = _UNIT
        out = np.zeros(3)
        step(arrays, parameters, state, u, out)
        return state[kept] / _UNIT, (a.T @ out)[:2] / _UNIT

    columns = [image(int(at), -1) for at in kept] + [image(-1, i) for i in range(4)]
    states = np.array([state for state, _ in columns]).T
    outputs = np.array([out for _, out in columns]).T
    n = kept.size
    return states[:, :n], states[:, n:], outputs[:, :n], outputs[:, n:]
