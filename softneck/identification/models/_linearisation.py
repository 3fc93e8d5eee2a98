"""The derivatives of one step of an identified plant, and the linear system that it is near a state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import Matrix, SettingsError, Vector
from softneck.core._checks import finite_vector
from softneck.runtime import Block, State
from softneck.runtime._compile import load_tangent

if TYPE_CHECKING:
    import control

# Some 4 s at a time; what has not come to rest after 200 s never does.
_SETTLE, _TIMES = 200, 50
_REST = 1e-12


class Jacobian(NamedTuple):
    """What one step makes of small changes: `dx(k+1) = A dx(k) + B du(k)`, `dy(k+1) = C dx(k) + D du(k)`.

    Attributes:
        A: (n, n), in the order of the state's `values`.
        B: (n, motors), from the motors' set-points.
        C: (n_out, n), to the outputs that the step returns, in the order of the block's.
        D: (n_out, motors).
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix


def _motor_count(block: Block) -> int:
    """Return the number of motors: their set-points stand first among a plant's inputs."""
    return sum(port.name.startswith("motor_setpoint_") for port in block.inputs)


def jacobian(model: Any, state: State, inputs: ArrayLike) -> Jacobian:
    """Return the derivatives of `model.step(state, inputs)`; see `Model.jacobian`."""
    block = model.block()
    motors = _motor_count(block)
    n, n_out = state.values.size, len(block.outputs)
    u = np.full(len(block.inputs), np.nan)
    u[:motors] = finite_vector("inputs", inputs, motors)
    X, U = np.zeros((n, n + motors)), np.zeros((u.size, n + motors))
    X[:, :n] = np.eye(n)
    U[:motors, n:] = np.eye(motors)
    Y = np.zeros((n_out, n + motors))
    tangent = load_tangent(block.runtime)
    tangent(block.arrays, state.parameters, state.values.copy(), u, np.zeros(n_out), X, U, Y, n + motors)
    return Jacobian(X[:, :n], X[:, n:], Y[:, :n], Y[:, n:])


def linearised(model: Any, at: State | Mapping[str, float] | ArrayLike | None) -> control.StateSpace:
    """Return the linear system that `model` is near a state; see `Model.linearize`."""
    import control

    block = model.block()
    motors = _motor_count(block)
    load_tangent(block.runtime)  # a kind without derivatives need not come to rest first
    if isinstance(at, State):
        # The motors are told to stay where they are.
        outputs = len(block.inputs) - 2 * motors
        state, u = at, at.outputs[outputs : outputs + motors]
    else:
        u = _set_points(block, at)
        state = _rest(model, block, u)
    J = jacobian(model, state, u)
    # The last output, `validity`, is no part of the neck: a linear system has none.
    J = J._replace(C=J.C[:-1], D=J.D[:-1])
    n, n_out = J.A.shape[0], J.C.shape[0]
    # A step returns the outputs of the next sample; as states of their own they are those of the state's.
    A = np.block([[J.A, np.zeros((n, n_out))], [J.C, np.zeros((n_out, n_out))]])
    B, C = np.vstack([J.B, J.D]), np.hstack([np.zeros((n_out, n)), np.eye(n_out)])
    A, B, C = moved_through(A, B, C)
    return control.StateSpace(
        A, B, C, np.zeros((n_out, motors)), block.sample_time,
        inputs=[port.name for port in block.inputs[:motors]], outputs=[port.name for port in block.outputs[:-1]],
        name=model.kind,
    )  # fmt: skip


def _set_points(block: Block, at: Mapping[str, float] | ArrayLike | None) -> Vector:
    """Return the motors' set-points (motors,) that are asked for."""
    motors = _motor_count(block)
    names = [port.name for port in block.inputs[:motors]]
    if at is None:
        return np.zeros(motors)
    if isinstance(at, Mapping):
        given: Mapping[str, Any] = at
        unknown = sorted(set(given) - set(names))
        if unknown:
            raise SettingsError(f"`{unknown[0]}` is not a set-point; `at` takes {', '.join(names)}.")
        return finite_vector("at", [given.get(name, 0.0) for name in names], motors)
    return finite_vector("at", at, motors)


def _rest(model: Any, block: Block, u: Vector) -> State:
    """Return the state in which the model stands under the set-points `u`, run free until it does."""
    state = block.initial_state(use_measurement=0.0)
    rows = np.full((_SETTLE, len(block.inputs)), np.nan)
    rows[:, : u.size] = u
    for _ in range(_TIMES):
        state, outputs = block.run(state, rows)
        if np.isfinite(outputs).all() and np.ptp(outputs[-_SETTLE // 4 :, :-1], axis=0).max() <= _REST:
            return state
    raise SettingsError(
        f"the model of kind {model.kind} does not come to rest under the set-points {u.tolist()} rad within "
        f"{_SETTLE * _TIMES * block.sample_time:g} s; give `at` a state."
    )


def moved_through(A: Matrix, B: Matrix, C: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Return a system without the states that no input moves, or that no output shows."""
    kept = _reached(A, B) & _reached(A.T, C.T)
    return A[kept][:, kept], B[kept], C[:, kept]


def _reached(A: Matrix, B: Matrix) -> np.ndarray:
    """Return which states (n,) follow from those that `B` (n, m) moves, one sample after the other."""
    leads, reached = A != 0.0, np.count_nonzero(B, axis=1) > 0
    while True:
        more = reached | (np.count_nonzero(leads[:, reached], axis=1) > 0)
        if np.array_equal(more, reached):
            return reached
        reached = more
