"""A coupled plant: every output answers to the redefined inputs of all axes. Also loops around all axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AXES, AxisPlant
from softneck.identification import to_state_space
from softneck.robot import TIME_CONSTANT, Directions, Motors, Outputs, Robot

from ._uncertain import UncertainAxis


@dataclass(frozen=True, slots=True, eq=False)
class CoupledAxis:
    """One output of a coupled plant: `x+ = A x + B v(k - delay)`, `y = x[0]`, v the redefined inputs of all axes.

    Attributes:
        A: (n, n).
        B: (n, outputs).
        axis: which of the redefined inputs is its own; at rest it answers to that alone.
        delay: samples beyond the one that A and B have themselves.
        sample_time: [s].
        second: how many seconds a scaled second is [s]; of the neck 1.
    """

    A: Matrix
    B: Matrix
    axis: int
    delay: int
    sample_time: float
    second: float = 1.0

    @property
    def order(self) -> int:
        """n, the number of states without the delay."""
        return self.A.shape[0]

    @property
    def denominator(self) -> Vector:
        """The characteristic polynomial (n + 1,) of A."""
        return np.real(np.poly(self.A))

    @property
    def static_gain(self) -> float:
        """Output over its own input in steady state."""
        return float(np.linalg.solve(np.eye(self.order) - self.A, self.B[:, self.axis])[0])

    @property
    def time_constant(self) -> float:
        """Of the slowest pole [s]."""
        radius = float(np.abs(np.linalg.eigvals(self.A)).max(initial=0.0))
        return -self.sample_time / math.log(max(radius, 1e-9))

    def observable_form(self) -> tuple[Matrix, Vector, Vector]:
        """Return A (n, n), B (n,) of its own input, C (n,), as of a plant that is not coupled."""
        return self.A, self.B[:, self.axis], np.eye(self.order)[0]

    def response(self, frequency: Vector, *, extra_delay: int = 0) -> Matrix:
        """Return the exact complex response (m, outputs) at `frequency` [rad/s] with `extra_delay` samples more."""
        z = np.exp(1j * np.asarray(frequency) * self.sample_time)
        states = np.linalg.solve(z[:, None, None] * np.eye(self.order) - self.A, self.B.astype(complex))
        return states[:, 0, :] * z[:, None] ** (-(self.delay + extra_delay))

    def with_min_delay(self, least: float) -> CoupledAxis:
        """Return the same plant with a minimum dead time `least` [s], in whole samples."""
        return replace(self, delay=max(self.delay, round(least / self.sample_time)))

    def lag(self) -> AxisPlant:
        """Return the lag of its slowest pole and static gain, which weights are chosen for: zeros may be slower."""
        pole = float(np.abs(np.linalg.eigvals(self.A)).max(initial=0.0))
        gain = self.static_gain * (1.0 - pole)
        return AxisPlant(np.array([gain]), np.array([1.0, -pole]), self.delay, self.sample_time, self.second)

    def with_faster_pole(self, pole: float) -> CoupledAxis:  # noqa: ARG002 - what is slow in it is no pole of one axis
        """Return itself."""
        return self


# What one output of a plant answers to: its own redefined input, or those of all.
AnyAxis = AxisPlant | CoupledAxis
AnyAxes = tuple[AnyAxis, ...]


def scale_gains(plants: AnyAxes, factor: float) -> AnyAxes:
    """Return all plants with their gains times `factor`."""
    return tuple(
        replace(plant, B=factor * plant.B)
        if isinstance(plant, CoupledAxis)
        else replace(plant, numerator=factor * plant.numerator)
        for plant in plants
    )


def input_matrix(plant: AnyAxis, axis: int, outputs: int) -> Matrix:
    """Return B (n, outputs) from the redefined inputs of all axes: of a plant of its own one column."""
    if isinstance(plant, CoupledAxis):
        return plant.B
    B = np.zeros((plant.order, outputs))
    B[:, axis] = plant.numerator
    return B


def realise(plants: AnyAxes, extra_delay: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B (states, outputs), C of all axes, inputs on their way as states."""
    from scipy.linalg import block_diag

    sides = [
        _realise_axis(plant, input_matrix(plant, axis, len(plants)), extra_delay) for axis, plant in enumerate(plants)
    ]
    A, C = (np.asarray(block_diag(*items)) for items in ([side[0] for side in sides], [side[2] for side in sides]))
    return A, np.vstack([side[1] for side in sides]), C


def _realise_axis(plant: AnyAxis, B0: Matrix, extra_delay: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B, C (1, states) of one output with a delay chain of its inputs."""
    n, delay = plant.order, plant.delay + extra_delay
    acting = np.flatnonzero(np.abs(B0).max(axis=0) > 0.0)
    k = acting.size
    A = np.zeros((n + k * delay, n + k * delay))
    B = np.zeros((n + k * delay, B0.shape[1]))
    A[:n, :n] = plant.observable_form()[0]
    if delay == 0:
        B[:n] = B0
    else:
        # Newest first; the oldest acts.
        A[:n, n + k * (delay - 1) :] = B0[:, acting]
        A[n + k :, n : n + k * (delay - 1)] = np.eye(k * (delay - 1))
        B[n + np.arange(k), acting] = 1.0
    return A, B, np.concatenate([[1.0], np.zeros(n + k * delay - 1)])[None, :]


def responses(plants: AnyAxes, frequency: Vector, extra_delay: int) -> Matrix:
    """Return the responses (m, outputs, outputs) of all axes to the redefined inputs of all."""
    count = len(plants)
    G = np.zeros((len(frequency), count, count), dtype=complex)
    for axis, plant in enumerate(plants):
        row = plant.response(frequency, extra_delay=extra_delay)
        G[:, axis, axis if row.ndim == 1 else slice(None)] = row
    return G


def close_loop(
    parts: tuple[Matrix, Matrix, Matrix, Matrix], plants: AnyAxes, extra_delay: int
) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B (from all references) and C (to all outputs) of the loop with its dead time in full.

    `parts`: A, B, C, D of the controller, from references and outputs to redefined inputs. `plants`: of all axes.
    `extra_delay`: samples added to their delay.
    """
    A, B, C, D = parts
    m = len(plants)
    Ap, Bp, Cp = realise(plants, extra_delay)
    top = np.hstack([Ap + Bp @ D[:, m:] @ Cp, Bp @ C])
    bottom = np.hstack([B[:, m:] @ Cp, A])
    return (np.vstack([top, bottom]), np.vstack([Bp @ D[:, :m], B[:, :m]]), np.hstack([Cp, np.zeros((m, A.shape[0]))]))


def radius(parts: tuple[Matrix, Matrix, Matrix, Matrix], plants: AnyAxes, extra_delay: int) -> float:
    """Return the spectral radius of the loop."""
    return float(np.abs(np.linalg.eigvals(close_loop(parts, plants, extra_delay)[0])).max())


def grid_response(A: Matrix, B: Matrix, C: Matrix, D: Matrix, z: np.ndarray) -> np.ndarray:
    """Return `C (z - A)^-1 B + D` (m, outputs, inputs) at each z (m,)."""
    n = len(A)
    if n == 0:
        return np.broadcast_to(D.astype(complex), (z.size, *D.shape))
    if z.size <= n:
        return C @ np.linalg.solve(z[:, None, None] * np.eye(n) - A, np.broadcast_to(B, (z.size, *B.shape))) + D
    from scipy.linalg import schur

    # A grid: one Schur form, then all points by back substitution, a tenth of the time of a solve at each.
    form: Any = schur(A, output="complex")
    triangle, basis = form
    right, states = basis.conj().T @ B, np.empty((n, B.shape[1], z.size), complex)
    for k in range(n - 1, -1, -1):
        later = np.tensordot(triangle[k, k + 1 :], states[k + 1 :], 1)
        states[k] = (right[k][:, None] + later) / (z - triangle[k, k])
    return np.moveaxis(np.tensordot(C @ basis, states, 1), -1, 0) + D


def sensitivity(
    parts: tuple[Matrix, Matrix, Matrix, Matrix], plants: AnyAxes, extra_delay: int, frequency: Vector
) -> float:
    """Return Ms: the largest singular value of (I - G C)^-1 at the outputs, over `frequency` [rad/s]."""
    A, B, C, D = parts
    m = len(plants)
    z = np.exp(1j * frequency * plants[0].sample_time)
    K = grid_response(A, B[:, m:], C, D[:, m:], z)
    if all(isinstance(plant, AxisPlant) for plant in plants):
        own = np.array([plant.response(frequency, extra_delay=extra_delay) for plant in plants]).T
        loop = own[:, :, None] * K
    else:
        loop = responses(plants, frequency, extra_delay) @ K
    S = np.linalg.inv(np.eye(m) - loop)
    return float(np.linalg.norm(S, ord=2, axis=(1, 2)).max())


# Of the largest number of its kind: what rounding leaves of a dead time, of a state that no output shows, of a gain.
_ZERO_TOLERANCE = 1e-10
_NECK_INPUTS = ("theta_i", "phi_i")


@dataclass(frozen=True, slots=True, eq=False)
class CoupledPlant:
    """A plant of n motors and m outputs; its redefined inputs are those that move one output each at rest.

    `rows`: one for each output. `robot`: whose plant it is. `redefinition`: T (outputs + 1, motors) and its inverse.
    `turn`: (outputs, outputs) from the robot's own redefined inputs to these; co-contraction is the robot's own.
    """

    rows: tuple[CoupledAxis, ...]
    robot: Robot
    redefinition: tuple[Matrix, Matrix]
    turn: Matrix

    @property
    def names(self) -> tuple[str, ...]:
        """The outputs."""
        return self.robot.outputs.names

    @property
    def sample_time(self) -> float:
        """[s]."""
        return self.rows[0].sample_time

    @property
    def own_rows(self) -> tuple[CoupledAxis, ...]:
        """The rows from the robot's own redefined inputs."""
        return tuple(replace(row, B=row.B @ self.turn) for row in self.rows)

    @property
    def own_redefinition(self) -> tuple[Matrix, Matrix]:
        """T of the robot's own redefined inputs, and its inverse."""
        return _rotate_redefinition(self.redefinition, np.linalg.inv(self.turn))

    @property
    def axes(self) -> Mapping[str, UncertainAxis]:
        """The rows by output."""
        rows: Any = self.rows
        return {name: UncertainAxis(row, (row,)) for name, row in zip(self.names, rows, strict=True)}


def coupled_plant(source: Any, *, robot: Robot | None = None) -> CoupledPlant | None:
    """Return the coupled plant of a `control` system of any size; None if each axis is a plant of its own.

    `source`: a discrete system from motors, or a neck's redefined inputs, to outputs; else whatever a design takes.
    `robot`: whose plant a `control` system is; None: a neck's, or one with the names of its signals. Raises
    SettingsError: a model that says nothing between its axes, or a system that no controller of this package can be
    for, in a line.
    """
    import control

    if isinstance(source, control.StateSpace | control.TransferFunction):
        system = to_state_space(source)
        neck = _is_neck(system) if robot is None else robot.input_names == _NECK_INPUTS
        if neck and (system.ninputs == 1 or not _is_coupled(system)):
            return None
        whose = robot or (Robot.preset() if neck else _make_robot(system))
        return _plant_from_system(system, whose, whose.weights(), takes_directions=robot is None and not neck)
    return None


def _is_neck(system: Any) -> bool:
    """Return whether a system is of a neck: without names scalar or of two inputs and outputs, else by its names."""
    size, inputs, outputs = (system.ninputs, system.noutputs), set(system.input_labels), set(system.output_labels)
    if size == (1, 1):
        return True
    if size == (2, 2) and all(name.startswith(("u[", "y[")) for name in inputs | outputs):
        return True
    known = [set(_NECK_INPUTS), set(Robot.preset().set_points)]
    # Half a neck's names is a mistake, which `uncertain_plant` says.
    return outputs == set(AXES) and (inputs in known or size == (2, 2))


def _is_coupled(system: Any) -> bool:
    """Return whether a neck's system has more than a plant for each axis."""
    labels = list(system.input_labels)
    if not set(labels) <= {*_NECK_INPUTS, *(label for label in labels if label.startswith("u["))}:
        return system.ninputs > len(AXES)
    A, B, C = _order_signals(system, Robot.preset())
    across = [np.array([C[i] @ np.linalg.matrix_power(A, k) @ B for k in range(len(A))]) for i in range(len(AXES))]
    largest = max(float(np.abs(part).max(initial=0.0)) for part in across)
    return any(
        float(np.abs(part[:, 1 - i]).max(initial=0.0)) > _ZERO_TOLERANCE * largest for i, part in enumerate(across)
    )


def _order_signals(system: Any, robot: Robot) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B, C of a system, inputs and outputs found by name where it has the robot's names."""
    A, B, C = (np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C))
    inputs, outputs = list(system.input_labels), list(system.output_labels)
    for wanted in (_NECK_INPUTS, robot.set_points):
        if set(inputs) == set(wanted):
            B = B[:, [inputs.index(name) for name in wanted]]
    if set(outputs) == set(robot.outputs.names):
        C = C[[outputs.index(name) for name in robot.outputs.names]]
    return A, B, C


def _make_robot(system: Any) -> Robot:
    """Return a robot of so many motors and outputs, named as the system's signals are."""

    def choose_names(labels: list[str], what: str) -> tuple[str, ...]:
        plain = all(label.isidentifier() for label in labels)
        return tuple(labels) if plain else tuple(f"{what}_{i + 1}" for i in range(len(labels)))

    return Robot(
        name="plant",
        motors=Motors(names=choose_names(list(system.input_labels), "motor"), unit="1"),
        outputs=Outputs(names=choose_names(list(system.output_labels), "output"), unit="1"),
        directions=Directions(kind="identified"),
    )


def _rotate_redefinition(redefinition: tuple[Matrix, Matrix], turn: Matrix) -> tuple[Matrix, Matrix]:
    """Return T and its inverse after the rotation `turn` of the redefined inputs."""
    (T, inverse), m = redefinition, len(turn)
    return np.vstack([turn @ T[:m], T[m:]]), np.hstack([inverse[:, :m] @ np.linalg.inv(turn), inverse[:, m:]])


def _plant_from_system(
    system: Any, robot: Robot, weights: Matrix | None, *, takes_directions: bool = False
) -> CoupledPlant:
    """Return the plant of a system; `named`: the robot has only the names of its signals."""
    dt = system.dt
    if dt is None or isinstance(dt, bool) or not dt > 0.0:
        raise SettingsError(
            f"the plant must say its sample time; its dt is {dt}. Give dt in seconds, or 0: a continuous plant is held "
            "for the robot's `sample_time_s`."
        )
    A, B, C = _order_signals(system, robot)
    _require_valid(A, B, C, np.asarray(system.D, dtype=np.float64))
    outputs, motors = len(robot.outputs.names), len(robot.motors.names)
    if weights is not None and (B.shape[1], len(C)) == (outputs, outputs) != (motors, outputs):
        B = B @ weights
    if (B.shape[1], len(C)) != (motors, outputs):
        raise SettingsError(
            f"the plant has {B.shape[1]} input(s) and {len(C)} output(s), robot {robot.label()} "
            f"{motors} motor(s) and {outputs}."
        )
    at_rest = C @ np.linalg.solve(np.eye(len(A)) - A, B)
    _require_independent(at_rest, robot)
    found: Any = at_rest / np.linalg.norm(at_rest, axis=1, keepdims=True) if weights is None else weights
    if takes_directions:
        robot = replace(robot, directions=Directions(kind="matrix", matrix=tuple(map(tuple, found.tolist()))))
    own = robot.redefinition(found)
    gains = at_rest @ own[1][:, : len(C)]
    turn = gains / np.linalg.norm(gains, axis=1, keepdims=True)
    T, inverse = _rotate_redefinition(own, turn)
    rows = tuple(_extract_axis(A, B @ inverse[:, : len(C)], c, axis, float(dt)) for axis, c in enumerate(C))
    radius = max(float(np.abs(np.linalg.eigvals(row.A)).max()) for row in rows)
    slowest = -dt / math.log(radius) if radius > 0.0 else 0.0
    second = (robot.time_constant_s or max(slowest, float(dt))) / TIME_CONSTANT
    rows = tuple(replace(row, second=second) for row in rows)
    return CoupledPlant(rows, robot, (T, inverse), turn)


def _require_valid(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> None:
    """Raise SettingsError for a plant that these controllers do not support."""
    if not all(np.isfinite(part).all() for part in (A, B, C, D)):
        raise SettingsError("the plant has entries that are not finite.")
    if D.any():
        raise SettingsError("the plant must be strictly proper (D = 0): an input acts one sample later.")
    radius = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    if radius >= 1.0:
        raise SettingsError(
            f"the plant is not stable (spectral radius {radius:.4f}), which limits of the motors ask for; "
            "`mixsyn` takes it."
        )


def _require_independent(at_rest: Matrix, robot: Robot) -> None:
    outputs, motors = at_rest.shape
    sizes = np.linalg.norm(at_rest, axis=1)
    dead = np.flatnonzero(sizes <= _ZERO_TOLERANCE * sizes.max(initial=0.0))
    if motors < outputs or dead.size or sizes.max(initial=0.0) == 0.0:
        what = f"`{robot.outputs.names[dead[0]]}` answers to none of them at rest" if dead.size else "they are too few"
        raise SettingsError(
            f"{motors} input(s) cannot bring {outputs} output(s) to references of their own: {what}. Leave outputs out."
        )


def _extract_axis(A: Matrix, B: Matrix, c: Vector, axis: int, dt: float) -> CoupledAxis:
    """Return one output with its dead time split off, in states of which it shows each, itself the first."""
    delay, size, row = 0, float(np.abs(c).max()) * float(np.abs(B).max()), c
    while delay < len(A) and float(np.abs(row @ B).max()) <= _ZERO_TOLERANCE * size:
        row, delay = row @ A, delay + 1
    Q = [row / np.linalg.norm(row)]
    scale = max(1.0, float(np.linalg.norm(A, 2)))
    while len(Q) < len(A):
        # Arnoldi of A': what it does not reach never shows in this output.
        basis = np.array(Q)
        further = A.T @ Q[-1]
        for _ in range(2):
            further = further - basis.T @ (basis @ further)
        if np.linalg.norm(further) <= _ZERO_TOLERANCE * scale:
            break
        Q.append(further / np.linalg.norm(further))
    basis = np.array(Q)
    return CoupledAxis(basis @ A @ basis.T, float(np.linalg.norm(row)) * basis @ B, axis, delay, dt)
