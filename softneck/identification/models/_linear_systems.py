"""Linear kinds as python-control systems, and as the paper writes them (Eq. 31)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import Matrix, SettingsError, Vector, require_one_of, require_whole, to_si
from softneck.core._checks import finite_vector
from softneck.robot import Robot
from softneck.robot._channels import is_set_point
from softneck.robot._redefined import redefinition_of
from softneck.runtime import Block, State
from softneck.runtime._compile import load_tangent
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ._state_space import system_of

if TYPE_CHECKING:
    import control

KINDS = ("rls", "oe")
STATE_SPACE = "softneck.identification.linear._state_space_runtime"
AFFINE = "softneck.identification.linear._affine_runtime"
_OUTPUTS = ("pitch", "roll")
_REDEFINED = ("theta_i", "phi_i", "delta_i")
_MOTORS = ("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3")


def transfer_function(model: Any, output: str, input: str | None, angle_unit: str) -> control.TransferFunction:
    """Return the discrete transfer function from `input` to `output`, with its delay in full.

    Raises:
        SettingsError: the kind is not linear, or an unknown input, output or unit.
    """
    import control

    name, scale = _checked(model, output, input, angle_unit)
    axes = model.findings.get("transfer_functions")
    if not model.robot.is_neck:
        numerator, denominator, delay = _of_robot(model, output, name)
    elif axes is not None:
        numerator, denominator, delay = _of_findings(axes, _OUTPUTS.index(output), name)
    elif "A" in model.arrays:
        numerator, denominator, delay = _of_state_space(model.arrays, _OUTPUTS.index(output), name)
    else:
        numerator, denominator, delay = _of_axis(model.arrays, _OUTPUTS.index(output), name)
    # In powers of z: the numerator b_1 z^(n-1-d)... needs n = max(na, nb + d) so that no power is negative.
    a, b = denominator[1:], numerator
    n = max(a.size, b.size + delay)
    below, above = np.zeros(n + 1), np.zeros(n + 1)
    below[: a.size + 1] = denominator
    above[1 + delay : 1 + delay + b.size] = b
    return control.TransferFunction(
        scale * above, below, model.sample_time, inputs=[name], outputs=[output], name=f"G_{output}"
    )


def state_space(model: Any) -> control.StateSpace:
    """Return both outputs as one discrete state space, from the motors where the model has them as inputs."""
    import control

    _require_linear(model.kind)
    if not model.robot.is_neck or ("A" in model.arrays and "transfer_functions" not in model.findings):
        A, B, C, _ = system_of(model.arrays)
        A, B, C = _delayed(A, B, C, int(model.arrays["delay"][0]))
        inputs = list(model.robot.set_points)
    else:
        parts = [control.ss(transfer_function(model, output, None, "rad")) for output in _OUTPUTS]
        joined: Any = control.append(*parts)
        A, B, C = np.asarray(joined.A), np.asarray(joined.B), np.asarray(joined.C)
        inputs = list(_REDEFINED[:2])
    D = np.zeros((len(C), B.shape[1]))
    outputs, name = list(model.robot.outputs.names), "neck" if model.robot.is_neck else "robot"
    return control.StateSpace(A, B, C, D, model.sample_time, inputs=inputs, outputs=outputs, name=name)


def continuous_function(
    model: Any, output: str, input: str | None, angle_unit: str, pade: int
) -> control.TransferFunction:
    """Return the continuous-time transfer function behind samples held by a zero-order hold.

    Raises:
        SettingsError: a pole at zero or on the negative real axis, which no continuous system has.
    """
    import control

    name, scale = _checked(model, output, input, angle_unit)
    require_whole("pade", pade, 0, 12)
    b, a, delay = _continuous(model, output, name)
    G = control.TransferFunction(scale * b, a)
    if pade > 0 and delay > 0.0:
        G = G * control.TransferFunction(*control.pade(delay, pade))
    return control.TransferFunction(G.num, G.den, inputs=[name], outputs=[output], name=f"G_{output}")


def describe(model: Any) -> list[str]:
    """Return each axis in the paper's form, `G = exp(-L s) K/(s + p)`, in degrees, where it has one real pole."""
    if not model.robot.is_neck or ("A" in model.arrays and "transfer_functions" not in model.findings):
        poles = np.linalg.eigvals(model.arrays["A"])
        delay = model.arrays["delay"][0] * model.sample_time
        return [f"{poles.size} states, dead time {delay:.3g} s, poles {np.array2string(poles, precision=4)}"]
    return [_describe_axis(model, axis) for axis in (0, 1)]


def _describe_axis(model: Any, axis: int) -> str:
    name = _OUTPUTS[axis]
    numbers = continuous_parameters(model.sample_time, model.arrays, axis)
    if numbers is None:
        G: Any = transfer_function(model, name, None, "deg")
        poles = np.roots(np.trim_zeros(np.asarray(G.den[0][0]), "b"))
        gain = float(G.dcgain())
        delay = _dead_time(np.asarray(G.num[0][0]), np.asarray(G.den[0][0])) * model.sample_time
        return (
            f"{name}: discrete poles {np.array2string(poles, precision=4)}, "
            f"static gain {gain:.3f} deg/rad, dead time {delay:.2f} s"
        )
    K, p, L = numbers
    gain = np.degrees(K / p)
    return f"{name}: G(s) = exp(-{L:.2f} s) {np.degrees(K):.3f}/(s + {p:.3f}) deg/rad, static gain {gain:.3f}"


def continuous_parameters(
    sample_time: float, arrays: Mapping[str, Matrix], axis: int
) -> tuple[float, float, float] | None:
    """Return K [rad/(rad s)], pole p [1/s] and dead time L [s] of a one-pole axis; None for another order."""
    if "a" not in arrays:
        return None
    a, b = arrays["a"][axis], arrays["b"][axis]
    if a.size != 1 or b.size != 1 or not 0.0 < -a[0] < 1.0:
        return None
    p = -np.log(-a[0]) / sample_time
    return float(b[0] * p / (1.0 + a[0])), float(p), float(arrays["delay"][axis] * sample_time)


def _continuous(model: Any, output: str, name: str) -> tuple[Vector, Vector, float]:
    """Undo the zero-order hold: return numerator, denominator and dead time [s]."""
    import control
    from scipy.linalg import logm

    G = transfer_function(model, output, name, "rad")
    below, above = np.asarray(G.den[0][0]), np.trim_zeros(np.asarray(G.num[0][0]), "f")
    delay = _dead_time(above, below)
    S: Any = control.ss(control.TransferFunction(above, below[: below.size - delay], model.sample_time))
    poles = np.linalg.eigvals(S.A)
    if (np.abs(poles) < 1e-9).any() or ((np.abs(poles.imag) < 1e-12) & (poles.real <= 0.0)).any():
        raise SettingsError(
            f"{output} has no continuous-time form: a pole at zero or on the negative real axis. Lower its order."
        )
    n = S.A.shape[0]
    joint = np.eye(n + 1)
    joint[:n, :n], joint[:n, n:] = S.A, S.B
    L = np.real(logm(joint)) / model.sample_time
    continuous: Any = control.ss2tf(control.StateSpace(L[:n, :n], L[:n, n:], S.C, S.D))
    return np.asarray(continuous.num[0][0]), np.asarray(continuous.den[0][0]), delay * model.sample_time


def _dead_time(numerator: Vector, denominator: Vector) -> int:
    """Return the samples that poles at zero delay, beyond the one that a strictly proper system has itself."""
    above = np.trim_zeros(numerator, "f")
    at_zero = denominator.size - np.trim_zeros(denominator, "b").size
    return min(at_zero, denominator.size - above.size - 1) if above.size else 0


def redefined_input(robot: Robot, output: str) -> str:
    """Return what the redefined input of an output is called: of a neck theta_i and phi_i."""
    return _REDEFINED[_OUTPUTS.index(output)] if robot.is_neck else f"{output}_input"


def weights_of(model: Any) -> Matrix:
    """Return the weights (outputs, motors) of the motors in each output's direction, given or learned.

    Raises:
        SettingsError: the robot's directions are to be identified, and the model says nothing of them.
    """
    weights = model.robot.weights()
    if weights is None:
        found = model.findings.get("directions")
        if found is None:
            raise SettingsError(
                f"the model of kind `{model.kind}` says nothing of the directions of robot {model.robot.label()}, "
                'which are "identified"; identify `oe` or `rls`, or give `directions.matrix`.'
            )
        weights = np.array(found, dtype=np.float64)
    return weights


def _of_robot(model: Any, output: str, name: str) -> tuple[Vector, Vector, int]:
    """Return numerator, denominator and dead time to an output from a motor, or from its own redefined input."""
    axis = model.robot.outputs.names.index(output)
    if name in model.robot.set_points:
        return _of_motor(model.arrays, axis, model.robot.set_points.index(name))
    entry = model.findings.get("transfer_functions", {}).get(output)
    if entry is not None:  # one axis alone: the state space has the poles of all
        return np.array(entry["b"]), np.concatenate([[1.0], entry["a"]]), int(entry["delay"])
    inverse = redefinition_of(weights_of(model), model.robot.outputs.names)[1]
    return _of_column(model.arrays, axis, model.arrays["B"] @ inverse[:, axis])


def _of_findings(axes: Mapping[str, Any], axis: int, name: str) -> tuple[Vector, Vector, int]:
    """Return one axis of a model whose arrays hold both in one state space."""
    entry = axes[_OUTPUTS[axis]]
    arrays = {
        "redefinition": redefinition_matrix(TENDON_ANGLES),
        "a": np.array([entry["a"]] * 2),
        "b": np.array([entry["b"]] * 2),
        "delay": np.array([entry["delay"]] * 2),
    }
    return _of_axis(arrays, axis, name)


def _of_axis(arrays: Mapping[str, Matrix], axis: int, name: str) -> tuple[Vector, Vector, int]:
    weight = 1.0
    if name in _MOTORS:
        weight = float(arrays["redefinition"][axis, _MOTORS.index(name)])
    elif name != _REDEFINED[axis]:
        weight = 0.0  # what Eq. 9-11 neglect
    return weight * arrays["b"][axis], np.concatenate([[1.0], arrays["a"][axis]]), int(arrays["delay"][axis])


def _of_state_space(arrays: Mapping[str, Matrix], axis: int, name: str) -> tuple[Vector, Vector, int]:
    if name in _MOTORS:
        return _of_motor(arrays, axis, _MOTORS.index(name))
    b = arrays["B"] @ np.linalg.inv(redefinition_matrix(TENDON_ANGLES))[:, _REDEFINED.index(name)]
    return _of_column(arrays, axis, b)


def _of_motor(arrays: Mapping[str, Matrix], axis: int, motor: int) -> tuple[Vector, Vector, int]:
    """Return numerator, denominator and dead time of one output from one motor."""
    return _of_column(arrays, axis, arrays["B"][:, motor])


def _of_column(arrays: Mapping[str, Matrix], axis: int, b: Vector) -> tuple[Vector, Vector, int]:
    A, _, C, _ = system_of(arrays)
    # c (zI - A)^-1 b = (det(zI - A + b c) - det(zI - A)) / det(zI - A).
    denominator = np.real(np.poly(A))
    numerator = np.real(np.poly(A - np.outer(b, C[axis]))) - denominator
    return numerator[1:], denominator, int(arrays["delay"][0])


def _delayed(A: Matrix, B: Matrix, C: Matrix, delay: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return the system with `delay` samples of its inputs as states."""
    n, m = B.shape
    size = n + m * delay
    F, G, H = np.zeros((size, size)), np.zeros((size, m)), np.zeros((C.shape[0], size))
    F[:n, :n], H[:, :n] = A, C
    if delay == 0:
        return A, B, C
    F[:n, n : n + m] = B
    F[n : size - m, n + m :] = np.eye(size - n - m)
    G[size - m :] = np.eye(m)
    return F, G, H


def _checked(model: Any, output: str, input: str | None, angle_unit: str) -> tuple[str, float]:
    _require_linear(model.kind)
    robot = model.robot
    require_one_of("output", output, robot.outputs.names)
    require_one_of("angle_unit", angle_unit, ("rad", "deg"))
    if robot.is_neck:
        name = _REDEFINED[_OUTPUTS.index(output)] if input is None else input
        require_one_of("input", name, _REDEFINED + _MOTORS)
    else:
        name = redefined_input(robot, output) if input is None else robot.own(input)
        require_one_of("input", name, (redefined_input(robot, output), *robot.set_points))
    angle = to_si(robot.outputs.unit)[1] == "rad"
    return name, 180.0 / np.pi if angle_unit == "deg" and angle else 1.0


def _require_linear(kind: str) -> None:
    if kind not in KINDS:
        raise SettingsError(f"a model of kind `{kind}` is not linear; use one of kind {', '.join(KINDS)}.")


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
    return sum(is_set_point(port.name) for port in block.inputs)


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
