"""The controller without limits, as the linear system that it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot
from softneck.runtime import load_runtime

from . import _mpc_state_runtime as rt
from ._scale import runtime_of, unbound, units_of

if TYPE_CHECKING:
    import control


# Far beyond anything: no limit acts.
_FREE = 1e12
# Small against the reference's own bound, so that it stays linear; powers of two scale without rounding.
_UNIT = 2.0**-10


def lti(arrays: tuple[Matrix, ...], robot: Robot, *, name: str = "mpc") -> control.StateSpace:
    """Return it from references and outputs to redefined inputs, of the neck theta_i and phi_i.

    Its matrices are what the runtime's own `step` does to unit vectors. With preview the reference counts as known only
    when it comes.
    """
    import control

    A, B, C, D = system(arrays)
    names = robot.outputs.names
    _, outputs, inputs = units_of(arrays)
    B, C, D = B / np.tile(outputs, 2), C * inputs[:, None], D * inputs[:, None] / np.tile(outputs, 2)
    turn = _to_own(arrays, robot)
    C, D = (C, D) if turn is None else (turn @ C, turn @ D)
    return control.StateSpace(
        A, B, C, D, float(rt.MpcArrays(arrays).constants[rt.MPC_TS]),
        inputs=[*(f"{output}_reference" for output in names), *names],
        outputs=list(robot.input_names), name=name,
    )  # fmt: skip


def _to_own(arrays: tuple[Matrix, ...], robot: Robot) -> Matrix | None:
    """Return what makes the redefined inputs of a coupled design those of its robot; None where they are."""
    a = rt.MpcArrays(arrays)
    m, weights = a.T.shape[0] - 1, robot.weights()
    if a.model_B.shape[1] == a.model_A.shape[1] or weights is None:
        return None
    motors, _, inputs = units_of(arrays)
    return weights @ np.linalg.pinv(a.T[:m] * inputs[:, None] / motors)


def system(arrays: tuple[Matrix, ...]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, D of `lti` in scaled quantities."""
    arrays = unbound(arrays)
    step = load_runtime(runtime_of(arrays)).step
    a = rt.MpcArrays(arrays)
    m, motors = a.T.shape[0] - 1, a.T.shape[1]
    flags = 2 * m + 1 + motors
    at, q = rt.MpcState.parts(a), a.constants
    numbers = np.arange(at["active"].stop)
    kept = np.concatenate([numbers[at[name]] for name in ("held", "filtered", "models", "offsets", "past", "coming")])
    # Tautness is the fifth where angles have no limit, else the sixth.
    soft = [_FREE] * int(q[rt.MPC_TAUT_AT] - q[rt.MPC_ANGLE_AT])
    parameters = np.array([_FREE, _FREE, _FREE, -_FREE, *soft, -_FREE])
    ahead = m if q[rt.MPC_AHEAD] > 0 else 0
    ports = flags + 2 + ahead + int(q[rt.MPC_PAYLOAD])

    def image(state_at: int, input_at: int) -> tuple[Vector, Vector]:
        state, u = np.zeros(numbers.size), np.zeros(ports)
        state[at["started"]] = 1.0
        u[flags : flags + 2] = 1.0
        if state_at >= 0:
            state[state_at] = _UNIT
        else:
            u[input_at if input_at < m else input_at + 1] = _UNIT  # co-contraction stands between them
            if input_at < m and ahead:
                u[flags + 2 + input_at] = _UNIT
        out = np.zeros(motors)
        step(arrays, parameters, state, u, out)
        return state[kept] / _UNIT, (a.T @ out)[:m] / _UNIT

    columns = [image(int(at), -1) for at in kept] + [image(-1, i) for i in range(2 * m)]
    states = np.array([state for state, _ in columns]).T
    outputs = np.array([out for _, out in columns]).T
    n = kept.size
    return states[:, :n], states[:, n:], outputs[:, :n], outputs[:, n:]
