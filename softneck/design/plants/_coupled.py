"""A coupled plant of any size, out of a state space: outputs that answer to the redefined inputs of all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AXES
from softneck.robot import TIME_CONSTANT, Directions, Motors, Outputs, Robot

from ._coupled_axis import CoupledAxis
from ._uncertain import UncertainAxis

# Of the largest number of its kind: what rounding leaves of a dead time, of a state that no output shows, of a gain.
_ROUNDING = 1e-10
_NECK_INPUTS = ("theta_i", "phi_i")


@dataclass(frozen=True, slots=True, eq=False)
class CoupledPlant:
    """A plant of n motors and m outputs; its redefined inputs are those that move one output each at rest.

    Attributes:
        rows: one for each output.
        robot: whose plant it is.
        redefinition: T (outputs + 1, motors) and its inverse.
        turn: (outputs, outputs) from the robot's own redefined inputs to these; co-contraction is the robot's own.
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
        return _turned(self.redefinition, np.linalg.inv(self.turn))

    @property
    def axes(self) -> Mapping[str, UncertainAxis]:
        """The rows by output."""
        rows: Any = self.rows
        return {name: UncertainAxis(row, (row,)) for name, row in zip(self.names, rows, strict=True)}


def coupled_plant(source: Any, *, robot: Robot | None = None) -> CoupledPlant | None:
    """Return the coupled plant of a `control` system of any size; None for what is a plant for each axis.

    Args:
        source: a discrete system from motors, or a neck's redefined inputs, to outputs; else whatever a design takes.
        robot: whose plant a `control` system is; None: a neck's, or one with the names of its signals.

    Raises:
        SettingsError: a model that says nothing between its axes, or a system that no controller of this package can be
            for, in a line.
    """
    import control

    if isinstance(source, control.StateSpace | control.TransferFunction):
        system: Any = control.ss(source)
        neck = _is_necks(system) if robot is None else robot.input_names == _NECK_INPUTS
        if neck and (system.ninputs == 1 or not _crosses(system)):
            return None
        whose = robot or (Robot.preset() if neck else _robot(system))
        return _coupled(system, whose, whose.weights(), named=robot is None and not neck)
    return None


def _is_necks(system: Any) -> bool:
    """Return whether a system is of a neck: without names scalar or of two inputs and outputs, else by its names."""
    size, inputs, outputs = (system.ninputs, system.noutputs), set(system.input_labels), set(system.output_labels)
    if size == (1, 1):
        return True
    if size == (2, 2) and all(name.startswith(("u[", "y[")) for name in inputs | outputs):
        return True
    known = [set(_NECK_INPUTS), set(Robot.preset().set_points)]
    # Half a neck's names is a mistake, which `uncertain_plant` says.
    return outputs == set(AXES) and (inputs in known or size == (2, 2))


def _crosses(system: Any) -> bool:
    """Return whether a neck's system has more than a plant for each axis."""
    labels = list(system.input_labels)
    if not set(labels) <= {*_NECK_INPUTS, *(label for label in labels if label.startswith("u["))}:
        return system.ninputs > len(AXES)
    A, B, C = _sorted(system, Robot.preset())
    across = [np.array([C[i] @ np.linalg.matrix_power(A, k) @ B for k in range(len(A))]) for i in range(len(AXES))]
    largest = max(float(np.abs(part).max(initial=0.0)) for part in across)
    return any(float(np.abs(part[:, 1 - i]).max(initial=0.0)) > _ROUNDING * largest for i, part in enumerate(across))


def _sorted(system: Any, robot: Robot) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B, C of a system, inputs and outputs found by name where it has the robot's names."""
    A, B, C = (np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C))
    inputs, outputs = list(system.input_labels), list(system.output_labels)
    for wanted in (_NECK_INPUTS, robot.set_points):
        if set(inputs) == set(wanted):
            B = B[:, [inputs.index(name) for name in wanted]]
    if set(outputs) == set(robot.outputs.names):
        C = C[[outputs.index(name) for name in robot.outputs.names]]
    return A, B, C


def _robot(system: Any) -> Robot:
    """Return a robot of so many motors and outputs, named as the system's signals are."""

    def named(labels: list[str], what: str) -> tuple[str, ...]:
        plain = all(label.isidentifier() for label in labels)
        return tuple(labels) if plain else tuple(f"{what}_{i + 1}" for i in range(len(labels)))

    return Robot(
        name="plant",
        motors=Motors(names=named(list(system.input_labels), "motor"), unit="1"),
        outputs=Outputs(names=named(list(system.output_labels), "output"), unit="1"),
        directions=Directions(kind="identified"),
    )


def _turned(redefinition: tuple[Matrix, Matrix], turn: Matrix) -> tuple[Matrix, Matrix]:
    """Return T and its inverse with `turn` behind the redefined inputs of all axes."""
    (T, inverse), m = redefinition, len(turn)
    return np.vstack([turn @ T[:m], T[m:]]), np.hstack([inverse[:, :m] @ np.linalg.inv(turn), inverse[:, m:]])


def _coupled(system: Any, robot: Robot, weights: Matrix | None, *, named: bool = False) -> CoupledPlant:
    """Return the plant of a system; `named`: the robot has nothing but the names of its signals."""
    dt = system.dt
    if dt is None or isinstance(dt, bool) or not dt > 0.0:
        raise SettingsError(
            f"the plant must say its sample time; its dt is {dt}. Give dt in seconds, or 0: a continuous plant is held "
            "for the robot's `sample_time_s`."
        )
    A, B, C = _sorted(system, robot)
    _check(A, B, C, np.asarray(system.D, dtype=np.float64))
    outputs, motors = len(robot.outputs.names), len(robot.motors.names)
    if weights is not None and (B.shape[1], len(C)) == (outputs, outputs) != (motors, outputs):
        B = B @ weights
    if (B.shape[1], len(C)) != (motors, outputs):
        raise SettingsError(
            f"the plant has {B.shape[1]} input(s) and {len(C)} output(s), robot {robot.label()} "
            f"{motors} motor(s) and {outputs}."
        )
    at_rest = C @ np.linalg.solve(np.eye(len(A)) - A, B)
    _require_apart(at_rest, robot)
    found: Any = at_rest / np.linalg.norm(at_rest, axis=1, keepdims=True) if weights is None else weights
    if named:
        robot = replace(robot, directions=Directions(kind="matrix", matrix=tuple(map(tuple, found.tolist()))))
    own = robot.redefinition(found)
    gains = at_rest @ own[1][:, : len(C)]
    turn = gains / np.linalg.norm(gains, axis=1, keepdims=True)
    T, inverse = _turned(own, turn)
    rows = tuple(_row(A, B @ inverse[:, : len(C)], c, axis, float(dt)) for axis, c in enumerate(C))
    radius = max(float(np.abs(np.linalg.eigvals(row.A)).max()) for row in rows)
    slowest = -dt / math.log(radius) if radius > 0.0 else 0.0
    second = (robot.time_constant_s or max(slowest, float(dt))) / TIME_CONSTANT
    rows = tuple(replace(row, second=second) for row in rows)
    return CoupledPlant(rows, robot, (T, inverse), turn)


def _check(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> None:
    """Raise SettingsError for what no such controller is for."""
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


def _require_apart(at_rest: Matrix, robot: Robot) -> None:
    outputs, motors = at_rest.shape
    sizes = np.linalg.norm(at_rest, axis=1)
    dead = np.flatnonzero(sizes <= _ROUNDING * sizes.max(initial=0.0))
    if motors < outputs or dead.size or sizes.max(initial=0.0) == 0.0:
        what = f"`{robot.outputs.names[dead[0]]}` answers to none of them at rest" if dead.size else "they are too few"
        raise SettingsError(
            f"{motors} input(s) cannot bring {outputs} output(s) to references of their own: {what}. Leave outputs out."
        )


def _row(A: Matrix, B: Matrix, c: Vector, axis: int, dt: float) -> CoupledAxis:
    """Return one output with its dead time split off, in states of which it shows each, itself the first."""
    delay, size, row = 0, float(np.abs(c).max()) * float(np.abs(B).max()), c
    while delay < len(A) and float(np.abs(row @ B).max()) <= _ROUNDING * size:
        row, delay = row @ A, delay + 1
    Q = [row / np.linalg.norm(row)]
    scale = max(1.0, float(np.linalg.norm(A, 2)))
    while len(Q) < len(A):
        # Arnoldi of A': what it does not reach never shows in this output.
        basis = np.array(Q)
        further = A.T @ Q[-1]
        for _ in range(2):
            further = further - basis.T @ (basis @ further)
        if np.linalg.norm(further) <= _ROUNDING * scale:
            break
        Q.append(further / np.linalg.norm(further))
    basis = np.array(Q)
    return CoupledAxis(basis @ A @ basis.T, float(np.linalg.norm(row)) * basis @ B, axis, delay, dt)
