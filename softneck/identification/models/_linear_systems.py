"""Linear models: their arrays, python-control systems, the form of the paper (Eq. 31), and linearisation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import Matrix, SettingsError, Vector, finite_vector, require_one_of, require_whole, to_si
from softneck.robot import Robot, is_set_point
from softneck.runtime import Block, State, load_tangent

if TYPE_CHECKING:
    import control


KINDS = ("rls", "oe")
STATE_SPACE = "softneck.identification.linear._state_space_runtime"


def transfer_function(model: Any, output: str, input: str | None, angle_unit: str = "rad") -> control.TransferFunction:
    """Return the discrete transfer function from `input` to `output`, with its exact dead time."""
    name = _checked_input(model, output, input)
    b, a, delay = _function(model, output, name)
    # The numerator b_1 z^(n-1-d)... has no negative power of z for n = max(na, nb + d).
    n = max(a.size, b.size + delay)
    below, above = np.zeros(n + 1), np.zeros(n + 1)
    below[: a.size + 1] = [1.0, *a]
    above[1 + delay : 1 + delay + b.size] = b
    return _named(model, (above, below, model.sample_time), name, output, angle_unit)


def _named(model: Any, G: tuple[Any, ...], name: str, output: str, angle_unit: str) -> control.TransferFunction:
    """Return a transfer function in SI, or of an angle in `angle_unit`, with the names of its signals."""
    import control

    require_one_of("angle_unit", angle_unit, ("rad", "deg"))
    angle = to_si(model.robot.outputs.unit)[1] == "rad"
    per_output = 180.0 / np.pi if angle_unit == "deg" and angle else 1.0
    return control.TransferFunction(per_output * G[0], *G[1:], inputs=[name], outputs=[output], name=f"G_{output}")


def to_state_space(system: Any) -> Any:
    """Return a `control` system of any size as state space, with the names of its signals.

    By scipy: python-control takes slycot where it is installed, whose rounding makes another design.
    """
    import control
    from scipy.linalg import block_diag

    if isinstance(system, control.StateSpace):
        return system
    inputs, outputs = np.eye(system.ninputs), np.eye(system.noutputs)
    try:
        parts: list[Any] = [
            control.ss(control.TransferFunction(above, below, system.dt), method="scipy")
            for row in zip(system.num, system.den, strict=True) for above, below in zip(*row, strict=True)
        ]  # fmt: skip
    except ValueError as error:
        raise SettingsError("a transfer function has more zeros than poles; it must be proper.") from error
    A = block_diag(*(part.A for part in parts))
    B = np.vstack([np.kron(inputs[[k % len(inputs)]], part.B) for k, part in enumerate(parts)])
    C = np.hstack([np.kron(outputs[:, [k // len(inputs)]], part.C) for k, part in enumerate(parts)])
    D = np.reshape([part.D for part in parts], (len(outputs), len(inputs)))
    return control.StateSpace(A, B, C, D, system.dt, inputs=system.input_labels, outputs=system.output_labels)


def state_space(model: Any) -> control.StateSpace:
    """Return one discrete state space of all outputs, over motors or redefined inputs as the model has them."""
    import control

    _require_linear(model.kind)
    robot = model.robot
    if "A" in model.arrays and ("offset" in model.arrays or "transfer_functions" not in model.findings):
        A, B, C, _ = system_of(model.arrays)
        A, B, C = _add_input_delay(A, B, C, int(model.arrays["delay"][0]))
        inputs = robot.set_points
    else:
        parts = [to_state_space(transfer_function(model, output, None)) for output in robot.outputs.names]
        joined: Any = control.append(*parts)
        A, B, C = np.asarray(joined.A), np.asarray(joined.B), np.asarray(joined.C)
        inputs = robot.input_names
    name, D = "neck" if robot.neck else "robot", np.zeros((len(C), B.shape[1]))
    return control.StateSpace(
        A, B, C, D, model.sample_time, inputs=list(inputs), outputs=list(robot.outputs.names), name=name
    )


def continuous_function(
    model: Any, output: str, input: str | None, angle_unit: str, pade: int
) -> control.TransferFunction:
    """Return the continuous-time transfer function that a zero-order hold discretizes to the model's."""
    import control
    from scipy.linalg import logm
    from scipy.signal import ss2tf

    name = _checked_input(model, output, input)
    require_whole("pade", pade, 0, 12)
    discrete = transfer_function(model, output, name)
    below, above = np.asarray(discrete.den[0][0]), np.trim_zeros(np.asarray(discrete.num[0][0]), "f")
    # Poles at zero are dead time, beyond the one sample that a strictly proper system has itself.
    at_zero = below.size - np.trim_zeros(below, "b").size
    delay = min(at_zero, below.size - above.size - 1) if above.size else 0
    S = to_state_space(control.TransferFunction(above, below[: below.size - delay], model.sample_time))
    poles = np.linalg.eigvals(S.A)
    if (np.abs(poles) < 1e-9).any() or ((np.abs(poles.imag) < 1e-12) & (poles.real <= 0.0)).any():
        raise SettingsError(
            f"{output} has no continuous-time form: a pole at zero or on the negative real axis. Lower its order."
        )
    n = S.A.shape[0]
    joint = np.eye(n + 1)
    joint[:n, :n], joint[:n, n:] = S.A, S.B
    L = np.real(logm(joint)) / model.sample_time
    above, below = ss2tf(L[:n, :n], L[:n, n:], S.C, S.D)
    G = control.TransferFunction(above[0], below)
    if pade > 0 and delay > 0:
        G = G * control.TransferFunction(*control.pade(delay * model.sample_time, pade))
    return _named(model, (np.asarray(G.num[0][0]), G.den), name, output, angle_unit)


def describe(model: Any) -> list[str]:
    """Describe each axis in the robot's units, in the paper's form `G = exp(-L s) K/(s + p)` where it has one pole."""
    if "A" in model.arrays and "transfer_functions" not in model.findings:
        poles = np.linalg.eigvals(model.arrays["A"])
        delay = model.arrays["delay"][0] * model.sample_time
        return [f"{poles.size} states, dead time {delay:.3g} s, poles {np.array2string(poles, precision=4)}"]
    return [_describe_axis(model, name) for name in model.robot.outputs.names]


def _describe_axis(model: Any, name: str) -> str:
    per, unit = model.robot.shown_gain
    a, b, delay = axis_functions(model)[name]
    numbers = one_pole(model.sample_time, a, b, delay)
    if numbers is None:
        poles, gain = np.roots([1.0, *a]), per * b.sum() / (1.0 + a.sum())
        return (
            f"{name}: discrete poles {np.array2string(poles, precision=4)}, "
            f"static gain {gain:.4g} {unit}, dead time {delay * model.sample_time:.3g} s"
        )
    K, p, L = numbers
    gain = per * K / p
    return f"{name}: G(s) = exp(-{L:.3g} s) {per * K:.4g}/(s + {p:.4g}) {unit}, static gain {gain:.4g}"


def continuous_parameters(
    sample_time: float, arrays: Mapping[str, Matrix], axis: int
) -> tuple[float, float, float] | None:
    """Return `one_pole` of an axis of arrays over redefined inputs; None for other arrays."""
    if "a" not in arrays:
        return None
    return one_pole(sample_time, arrays["a"][axis], arrays["b"][axis], int(arrays["delay"][axis]))


def one_pole(sample_time: float, a: Vector, b: Vector, delay: int) -> tuple[float, float, float] | None:
    """Return K [output/(input s)], pole p [1/s] and dead time L [s] of a first-order system; None for another order."""
    if a.size != 1 or b.size != 1 or not 0.0 < -a[0] < 1.0:
        return None
    p = -np.log(-a[0]) / sample_time
    return float(b[0] * p / (1.0 + a[0])), float(p), float(delay * sample_time)


def axis_functions(model: Any) -> dict[str, tuple[Vector, Vector, int]]:
    """Return a, b and dead time [samples] of each output from its redefined input, in SI; {} for models over motors."""
    found, arrays, names = model.findings.get("transfer_functions"), model.arrays, model.robot.outputs.names
    if found is not None:
        parts = {name: found[name] for name in names}
        return {name: (np.array(G["a"]), np.array(G["b"]), int(G["delay"])) for name, G in parts.items()}
    if "a" not in arrays:
        return {}
    return {name: (arrays["a"][i], arrays["b"][i], int(arrays["delay"][i])) for i, name in enumerate(names)}


def weights_of(model: Any) -> Matrix:
    """Return the weights (outputs, motors) of the motors in each output's direction, given or learned."""
    weights = model.robot.weights()
    if weights is not None:
        return weights
    found = model.findings.get("directions")
    if found is None:
        raise SettingsError(
            f"the model of kind `{model.kind}` has not learned the directions of robot {model.robot.label()}, "
            'which are "identified"; identify `oe` or `rls`, or give `directions.matrix`.'
        )
    return np.array(found, dtype=np.float64)


def redefined_input(robot: Robot, output: str) -> str:
    """Return the name of an output's redefined input, of a neck theta_i and phi_i."""
    return robot.input_names[robot.outputs.names.index(output)]


def _function(model: Any, output: str, name: str) -> tuple[Vector, Vector, int]:
    """Return numerator, denominator without its leading one, and dead time [samples] from any input to an output."""
    robot = model.robot
    axis, motor = robot.outputs.names.index(output), name in robot.set_points
    functions = axis_functions(model)
    if functions:
        a, b, delay = functions[output]
        # By Eq. 9-11 a redefined input moves its own output alone.
        weight = float(name == redefined_input(robot, output))
        if motor:
            weight = weights_of(model)[axis, robot.set_points.index(name)]
        return weight * b, a, delay
    A, B, C, _ = system_of(model.arrays)
    if motor:
        column = B[:, robot.set_points.index(name)]
    else:
        inverse = robot.redefinition(weights_of(model))[1]
        column = B @ inverse[:, [*robot.input_names, robot.cocontraction_name].index(name)]
    # c (zI - A)^-1 b = (det(zI - A + b c) - det(zI - A)) / det(zI - A).
    denominator = np.real(np.poly(A))
    numerator = np.real(np.poly(A - np.outer(column, C[axis]))) - denominator
    return numerator[1:], denominator[1:], int(model.arrays["delay"][0])


def _add_input_delay(A: Matrix, B: Matrix, C: Matrix, delay: int) -> tuple[Matrix, Matrix, Matrix]:
    """Add `delay` samples of the inputs as states."""
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


def _checked_input(model: Any, output: str, input: str | None) -> str:
    """Return the name of the input; raise SettingsError for an unknown input, output or nonlinear kind."""
    _require_linear(model.kind)
    robot = model.robot
    require_one_of("output", output, robot.outputs.names)
    name = redefined_input(robot, output) if input is None else robot.own(input)
    require_one_of("input", name, (*robot.input_names, robot.cocontraction_name, *robot.set_points))
    return name


def _require_linear(kind: str) -> None:
    if kind not in KINDS:
        raise SettingsError(f"a model of kind `{kind}` is not linear; use one of kind {', '.join(KINDS)}.")


# A model must come to rest within 50 simulations of 200 samples: 200 s at 20 ms.
_REST_ROWS, _REST_TRIALS = 200, 50
_REST_TOLERANCE = 1e-12


class Jacobian(NamedTuple):
    """`dx(k+1) = A dx(k) + B du(k)`, `dy(k+1) = C dx(k) + D du(k)`; states as in `values`, u the set-points."""

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix


def _motor_count(block: Block) -> int:
    """Return the number of motors, whose set-points are the first inputs of a plant."""
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


def linearize(model: Any, at: State | Mapping[str, float] | ArrayLike | None) -> control.StateSpace:
    """Linearize `model` at a state; see `Model.linearize`."""
    import control

    block = model.block()
    motors = _motor_count(block)
    load_tangent(block.runtime)  # refuse a kind without derivatives before the simulation to rest
    if isinstance(at, State):
        # The set-points are the present motor positions.
        outputs = len(block.inputs) - 2 * motors
        state, u = at, at.outputs[outputs : outputs + motors]
    else:
        u = _set_points(block, at, model.robot)
        state = _simulate_to_rest(model, block, u)
    J = jacobian(model, state, u)
    # A linear system has no `validity`, the last output.
    J = J._replace(C=J.C[:-1], D=J.D[:-1])
    n, n_out = J.A.shape[0], J.C.shape[0]
    # A step returns the outputs of the next sample; as additional states they become those of the present one.
    A = np.block([[J.A, np.zeros((n, n_out))], [J.C, np.zeros((n_out, n_out))]])
    B, C = np.vstack([J.B, J.D]), np.hstack([np.zeros((n_out, n)), np.eye(n_out)])
    A, B, C = remove_unreachable_states(A, B, C)
    names = [port.name for port in block.inputs[:motors]], [port.name for port in block.outputs[:-1]]
    D = np.zeros((n_out, motors))
    return control.StateSpace(A, B, C, D, model.sample_time, inputs=names[0], outputs=names[1], name=model.kind)


def _set_points(block: Block, at: Mapping[str, float] | ArrayLike | None, robot: Robot) -> Vector:
    """Return the set-points (motors,) from the argument `at` of `Model.linearize`."""
    motors = _motor_count(block)
    names = [port.name for port in block.inputs[:motors]]
    if at is None:
        return np.zeros(motors)
    if isinstance(at, Mapping):
        given: Mapping[str, Any] = {robot.own(name): value for name, value in at.items()}
        unknown = sorted(set(given) - set(names))
        if unknown:
            raise SettingsError(f"`{unknown[0]}` is not a set-point; `at` takes {', '.join(names)}.")
        return finite_vector("at", [given.get(name, 0.0) for name in names], motors)
    return finite_vector("at", at, motors)


def _simulate_to_rest(model: Any, block: Block, u: Vector) -> State:
    """Simulate the model under the set-points `u` until it is at rest; return that state."""
    state = block.initial_state(use_measurement=0.0)
    rows = np.full((_REST_ROWS, len(block.inputs)), np.nan)
    rows[:, : u.size] = u
    for _ in range(_REST_TRIALS):
        state, outputs = block.run(state, rows)
        if np.isfinite(outputs).all() and np.ptp(outputs[-_REST_ROWS // 4 :, :-1], axis=0).max() <= _REST_TOLERANCE:
            return state
    raise SettingsError(
        f"the model of kind {model.kind} does not come to rest under the set-points {u.tolist()} rad within "
        f"{_REST_ROWS * _REST_TRIALS * block.sample_time:g} s; give `at` a state."
    )


def remove_unreachable_states(A: Matrix, B: Matrix, C: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Remove the states that no input reaches or that reach no output."""
    kept = _reachable_states(A, B) & _reachable_states(A.T, C.T)
    return A[kept][:, kept], B[kept], C[:, kept]


def _reachable_states(A: Matrix, B: Matrix) -> np.ndarray:
    """Return a mask (n,) of the states that inputs reach through `B` (n, m) and any power of `A`."""
    leads, reached = A != 0.0, np.count_nonzero(B, axis=1) > 0
    while True:
        more = reached | (np.count_nonzero(leads[:, reached], axis=1) > 0)
        if np.array_equal(more, reached):
            return reached
        reached = more


# Largest history for the settling of an observer; a slower one starts before it has settled.
_MAX_SETTLING_SAMPLES = 200
# Noise for the Kalman gain of a model without a noise model, scaled. Of a neck: 0.3 rad on the inputs (slack,
# hysteresis) and 0.1 deg on the angles (the paper's inclinometer has 0.05 to 0.1).
_INPUT_NOISE, _OUTPUT_NOISE = 0.3, 0.0017


def lss_arrays(
    system: tuple[Matrix, Matrix, Matrix, Matrix],
    *,
    delay: int,
    drive: Matrix,
    source: int = 0,
    history: int | None = None,
) -> dict[str, Matrix]:
    """Return the runtime's arrays of `x+ = A x + B u(k-delay) + K (y - C x)`, `y = C x`, with n >= outputs.

    The states are transformed so that the first are the outputs y, and all states are (y, y, ...) at rest, which is how
    the runtime starts. `source` is 1 where u are motor positions; `history`: samples held when a run starts, by default
    as many as the observer needs to settle.
    """
    from scipy.linalg import null_space

    A, B, C, K = system
    n, outputs = A.shape[0], C.shape[0]
    # The states P with C P = I that move least in one sample.
    P, N = np.linalg.pinv(C), null_space(C)
    if N.shape[1]:
        D = A - np.eye(n)
        P = P - N @ np.linalg.lstsq(D @ N, D @ P)[0]
    other = N.T
    wanted = np.tile(np.eye(outputs), (n // outputs + 1, 1))[outputs:n]
    M = np.vstack([C, other + (wanted - other @ P) @ C])
    inverse = np.linalg.inv(M)
    if history is None:
        radius = float(np.abs(np.linalg.eigvals(A - K @ C)).max(initial=0.0))
        settles = np.log(1e-3) / np.log(radius) if 0.0 < radius < 1.0 else 1.0
        history = int(min(np.ceil(settles), _MAX_SETTLING_SAMPLES))
    length = max(history, delay + 1, -(-n // outputs), int(drive[:, 1].max(initial=0.0)), 1)
    return {
        "history": history_array(length, outputs),
        "drive": drive,
        "A": M @ A @ inverse,
        "B": M @ B,
        "K": M @ K,
        "delay": np.array([float(delay), float(source)]),
    }


def system_of(arrays: Mapping[str, Matrix]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, K of the arrays, without the dead time."""
    n = arrays["A"].shape[0]
    return arrays["A"], arrays["B"], np.eye(arrays["K"].shape[1], n), arrays["K"]


def history_array(length: int, outputs: int) -> Vector:
    """Return the array `history` of a model's file: its length, and the number of outputs where that is not two."""
    return np.array([float(length)] if outputs == 2 else [float(length), float(outputs)])


def varx_system(A: Matrix, B: Matrix) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return the dead-beat observer form of `y(k) = -sum A_i y(k-i) + sum B_i u(k-i)`, A (p, y, y), B (p, y, u)."""
    p, y = A.shape[:2]
    n = y * p
    F = np.zeros((n, n))
    F[: n - y, y:] = np.eye(n - y)
    K = -A.reshape(n, y)
    C = np.eye(y, n)
    return F + K @ C, B.reshape(n, B.shape[2]), C, K


def axes_system(a: list[Vector], b: list[Vector], directions: Matrix) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Join transfer functions over redefined inputs, `directions` (outputs, motors), to a system with a Kalman gain."""
    from scipy.linalg import block_diag

    parts = [_observer_form(*axis) for axis in zip(a, b, strict=True)]
    A, C = np.asarray(block_diag(*(F for F, _, _ in parts))), np.zeros((len(a), sum(len(F) for F, _, _ in parts)))
    B = np.vstack([np.outer(G, directions[axis]) for axis, (_, G, _) in enumerate(parts)])
    at = 0
    for axis, (F, _, _) in enumerate(parts):
        C[axis, at] = 1.0
        at += len(F)
    return A, B, C, np.asarray(block_diag(*(K[:, None] for _, _, K in parts)))


def _observer_form(a: Vector, b: Vector) -> tuple[Matrix, Vector, Vector]:
    """Return A (n, n), B (n,) and the gain K (n,) of one axis, its output the first state."""
    from scipy.linalg import solve_discrete_are

    n = max(a.size, b.size)
    F = np.eye(n, k=1)
    F[: a.size, 0] = -a
    G = np.zeros(n)
    G[: b.size] = b
    # 1e-12, far below the output noise, ensures that the equation has a solution.
    noise = _INPUT_NOISE**2 * np.outer(G, G) + 1e-12 * np.eye(n)
    P = np.asarray(solve_discrete_are(F.T, np.eye(n, 1), noise, _OUTPUT_NOISE**2 * np.eye(1)))
    return F, G, F @ P[:, 0] / (P[0, 0] + _OUTPUT_NOISE**2)
