"""The arrays of `_mpc_runtime`: assembled, changed, and as the linear system without limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot
from softneck.runtime import load_runtime

from . import _mpc_state_runtime as rt
from ._plant import remove_limits, runtime_of, units_of
from ._prediction import Matrices, Problem, disturbance_pole, pad_states, rest_states

if TYPE_CHECKING:
    import control

# Radians: a motor resolves 1.3e-4 rad, a soft limit is judged at 1e-6.
_QP_TOLERANCE = 1e-10
# Rows that the solver adds and drops in a sample; beyond them the plan of the sample before goes on.
_QP_ITERATIONS = 100
# An estimated payload trembles: co-contraction follows it slowly. Without a measurement the motors hold after a while.
_PAYLOAD_FILTER_S = _COAST_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuning:
    """Tuning of observer and reference filters, in scaled seconds.

    Attributes:
        trust: of the output-disturbance observer in what is measured, see `observer_gains`.
        reference_time: time constant of the reference filters.
        preview: samples that the reference is known ahead.
        payload_tautness: that a kilogram wishes for [1/kg]; 0: no payload is told.
        scale: what `scale_numbers` returns.
    """

    trust: float
    reference_time: float
    preview: int = 0
    payload_tautness: float = 0.0
    scale: tuple[float, ...] = ()


def assemble(problem: Problem, found: Matrices, tuning: Tuning) -> tuple[Matrix, ...]:
    """Return the arrays in the order of `MpcArrays`."""
    p, n = problem, problem.order
    plants, told = p.axes, tuning.payload_tautness > 0.0
    Ts = plants[0].sample_time
    AH = np.linalg.solve(found.H, found.A.T).T
    angle_at = 4.0
    constants = np.array([  # in the order of MPC_TS to MPC_NUMBERS
        Ts, p.rows, 1.0, n, p.dead_time, len(p.starts), p.slacks, tuning.preview,
        min(round(tuning.reference_time / Ts), tuning.preview), float(told), _QP_ITERATIONS, _QP_TOLERANCE,
        max(1, round(_COAST_S / Ts)), angle_at, angle_at + float(p.angles), 0.0, 0.0, *tuning.scale,
    ])  # fmt: skip
    keep = math.exp(-Ts / tuning.reference_time) if tuning.reference_time > 0.0 else 0.0
    payload = [*[0.0] * p.outputs, *([math.exp(-Ts / _PAYLOAD_FILTER_S), tuning.payload_tautness] if told else [0.0])]
    poles = np.array([disturbance_pole(plant) for plant in plants])
    made = {
        "constants": constants,
        "model_A": np.vstack([pad_states(plant, n)[0] for plant in plants]),
        # One input behind the other.
        "model_B": np.array([pad_states(plant, n)[1].T.ravel() for plant in plants]),
        "observer": observer_gains(poles, tuning.trust),
        "rest": np.array([rest_states(plant, n).T.ravel() for plant in plants]),
        "delays": np.array([float(plant.delay) for plant in plants]),
        "disturbances": np.array([payload]),
        "filters": np.full(p.outputs + 1, keep),
        "T": p.T,
        "starts": np.array(p.starts, dtype=np.float64),
        "K": -np.linalg.solve(found.H, found.F),
        "G": found.A @ AH.T,
        "AH": AH,
        "scale": np.array([max(1.0, float(np.abs(found.H).max()))]),
        **{name: getattr(found, name) for name in ("A", "E", "kinds", "H", "F")},
    }
    return tuple(made[name] for name in rt.MpcArrays.names())


def observer_gains(poles: Vector, trust: float) -> Matrix:
    """Return (plants, 3): gains on level and rate of the output disturbance, and the pole of its rate.

    Of a steady Kalman filter whose measurement noise is one and whose noise on the rate is `trust`: the model's own
    states are not corrected, so that one number says how much of what is measured is believed.
    `poles`: (plants,) of the rates. `trust`: > 0.
    """
    from scipy.linalg import solve_discrete_are

    rows = []
    C = np.array([[1.0, 0.0]])
    for a in poles:
        A = np.array([[1.0, 1.0], [0.0, a]])
        P = solve_discrete_are(A.T, C.T, np.diag([0.0, trust**2]), np.eye(1))
        gain = P @ C.T / (1.0 + P[0, 0])
        rows.append([gain[0, 0], gain[1, 0], a])
    return np.array(rows)


def observer_bandwidth(gains: Vector, sample_time: float) -> float:
    """Return how fast the slower pole of the observer's error is [rad/s], from a row of `observer_gains`."""
    A = np.array([[1.0, 1.0], [0.0, gains[2]]])
    error = A @ (np.eye(2) - np.outer(gains[:2], [1.0, 0.0]))
    slowest = float(np.abs(np.linalg.eigvals(error)).max())
    return -math.log(max(slowest, 1e-6)) / sample_time


def with_gains(arrays: tuple[Matrix, ...], trust: float) -> tuple[Matrix, ...]:
    """Return the arrays with another observer gain."""
    poles = rt.MpcArrays(arrays).observer[:, 2]
    return _with(arrays, observer=observer_gains(poles, trust))


def with_filter(arrays: tuple[Matrix, ...], reference_time: float) -> tuple[Matrix, ...]:
    """Return the arrays with other reference filters."""
    constants = rt.MpcArrays(arrays).constants.copy()
    Ts = float(constants[rt.MPC_TS])
    keep = math.exp(-Ts / reference_time) if reference_time > 0.0 else 0.0
    constants[rt.MPC_LEAD] = min(round(reference_time / Ts), constants[rt.MPC_AHEAD])
    return _with(arrays, constants=constants, filters=np.full_like(rt.MpcArrays(arrays).filters, keep))


def with_sample_time(arrays: tuple[Matrix, ...], sample_time: float) -> tuple[Matrix, ...]:
    """Return the arrays with a sample time [s] in place of the scaled one, as slew limits are a second's."""
    constants = rt.MpcArrays(arrays).constants.copy()
    constants[rt.MPC_TS] = sample_time
    return _with(arrays, constants=constants)


def _with(arrays: tuple[Matrix, ...], **changed: Matrix) -> tuple[Matrix, ...]:
    return tuple(changed.get(name, item) for name, item in zip(rt.MpcArrays.names(), arrays, strict=True))


# Far beyond anything: no limit acts.
_NO_LIMIT = 1e12
# Small against the reference's own bound, so that it stays linear; powers of two scale without rounding.
_UNIT_STEP = 2.0**-10


def lti(arrays: tuple[Matrix, ...], robot: Robot) -> control.StateSpace:
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
        outputs=list(robot.input_names), name="mpc",
    )  # fmt: skip


def _to_own(arrays: tuple[Matrix, ...], robot: Robot) -> Matrix | None:
    """Return the matrix from the redefined inputs of a coupled design to those of its robot; None if equal."""
    a = rt.MpcArrays(arrays)
    m, weights = a.T.shape[0] - 1, robot.weights()
    if a.model_B.shape[1] == a.model_A.shape[1] or weights is None:
        return None
    motors, _, inputs = units_of(arrays)
    return weights @ np.linalg.pinv(a.T[:m] * inputs[:, None] / motors)


def system(arrays: tuple[Matrix, ...]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, D of `lti` in scaled quantities."""
    # In the layout that blocks have: numba compiles the step again for another one.
    arrays = tuple(map(np.ascontiguousarray, remove_limits(arrays)))
    step = load_runtime(runtime_of(arrays)).step
    a = rt.MpcArrays(arrays)
    m, motors = a.T.shape[0] - 1, a.T.shape[1]
    flags = 2 * m + 1 + motors
    at, q = rt.MpcState.parts(a), a.constants
    numbers = np.arange(at["active"].stop)
    kept = np.concatenate([numbers[at[name]] for name in ("held", "filtered", "models", "offsets", "past", "coming")])
    # Tautness is the fifth where angles have no limit, else the sixth.
    soft = [_NO_LIMIT] * int(q[rt.MPC_TAUT_AT] - q[rt.MPC_ANGLE_AT])
    parameters = np.array([_NO_LIMIT, _NO_LIMIT, _NO_LIMIT, -_NO_LIMIT, *soft, -_NO_LIMIT])
    ahead = m if q[rt.MPC_AHEAD] > 0 else 0
    ports = flags + 2 + ahead + int(q[rt.MPC_PAYLOAD])

    def image(state_at: int, input_at: int) -> tuple[Vector, Vector]:
        state, u = np.zeros(numbers.size), np.zeros(ports)
        state[at["started"]] = 1.0
        u[flags : flags + 2] = 1.0
        if state_at >= 0:
            state[state_at] = _UNIT_STEP
        else:
            u[input_at if input_at < m else input_at + 1] = _UNIT_STEP  # co-contraction stands between them
            if input_at < m and ahead:
                u[flags + 2 + input_at] = _UNIT_STEP
        out = np.zeros(motors)
        step(arrays, parameters, state, u, out)
        return state[kept] / _UNIT_STEP, (a.T @ out)[:m] / _UNIT_STEP

    columns = [image(int(at), -1) for at in kept] + [image(-1, i) for i in range(2 * m)]
    states = np.array([state for state, _ in columns]).T
    outputs = np.array([out for _, out in columns]).T
    n = kept.size
    return states[:, :n], states[:, n:], outputs[:, :n], outputs[:, n:]
