"""What a sample of a predictive controller decided, read from its state, and its part of a loop that tells it."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import AXES
from softneck.loop import BlockPart
from softneck.runtime import load_functions

from . import _mpc_state_runtime as rt
from ._scale import runtime_of, units_of

ROW_NAMES = ("slew", "position", "slack", "angle", "angle", "tautness")
STATUS_NAMES = ("not started", "optimal", "softened", "previous plan", "holding")
_OF_MOTORS = (rt.MPC_ROW_MOVE, rt.MPC_ROW_POSITION, rt.MPC_ROW_TAUT)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MpcInfo:
    """What a sample's QP said.

    Attributes:
        status: "optimal", "softened" (a soft limit cannot be kept), "previous plan" (no answer in the budget),
            "holding" (disabled or without measurement) or "not started".
        iterations: rows added and dropped by the solver.
        residual: of the KKT conditions.
        slack: largest violation of a soft limit that is planned, scaled.
        active: names of the active limits.
        set_points: (N, motors) planned motor set-points from the next sample on [rad].
        angles: (N, outputs) pitch and roll that the nominal plant makes of them, each a dead time and a sample later
            [rad].
        reference: (N, outputs) what they are to be then [rad].
        previous_plan, softened: samples so far on which the previous plan went on, and a soft limit was not kept.
    """

    status: str
    iterations: int
    residual: float
    slack: float
    active: tuple[str, ...]
    set_points: Matrix
    angles: Matrix
    reference: Matrix
    previous_plan: int
    softened: int


def explain(arrays: tuple[Matrix, ...], state: Vector, names: tuple[str, ...] = AXES) -> MpcInfo:
    """Return what the sample that led to `state` decided; `names` are the outputs'."""
    a = rt.MpcArrays(arrays)
    now = {name: state[place] for name, place in rt.MpcState.parts(a).items()}
    functions = load_functions(runtime_of(arrays))
    age = int(now["age"].item())
    motors = a.T.shape[1]
    moves = np.zeros((int(a.constants[rt.MPC_ROWS] - a.constants[rt.MPC_PAST]), motors))
    for i, start in enumerate(a.starts.astype(int)):
        if start > age:
            moves[start - age - 1] = now["plan"][motors * i : motors * i + motors]
    theta = np.zeros(a.K.shape[1])
    functions.mpc_parameter(arrays, state, theta)
    # The state stands one sample on: what is held now was the plan's first move.
    set_points = now["held"] + np.cumsum(moves, axis=0)
    angles, reference = _predicted(a, theta, set_points)
    active = tuple(
        f"{ROW_NAMES[int(kind)]} {('upper', 'lower')[int(sign < 0)]} "
        + (("motor " + str(int(which) + 1)) if kind in _OF_MOTORS else names[int(which)])
        for (kind, which), sign in zip(a.kinds, now["active"], strict=True)
        if sign != 0.0 and kind != rt.MPC_ROW_SLACK
    )
    unit, outputs, _ = units_of(arrays)
    return MpcInfo(
        status=STATUS_NAMES[int(now["status"].item())],
        iterations=int(now["iterations"].item()),
        residual=now["residual"].item(),
        slack=now["slack"].item(),
        active=active,
        set_points=unit * set_points,
        angles=outputs * angles,
        reference=outputs * reference,
        previous_plan=int(now["shifted"].item()),
        softened=int(now["softened"].item()),
    )


def _predicted(a: rt.MpcArrays, theta: Vector, set_points: Matrix) -> tuple[Matrix, Matrix]:
    """Return predicted angles and references (N, outputs) of the nominal plant from theta on."""
    n, N, m = a.model_A.shape[1], set_points.shape[0], a.T.shape[0] - 1
    coupled = a.model_B.shape[1] > n
    now = {name: theta[place] for name, place in rt.MpcTheta.parts(a).items()}
    inputs = set_points @ a.T.T
    angles, reference = np.zeros((N, m)), np.zeros((N, m))
    for axis in range(m):
        A, B = a.model_A[axis * n : (axis + 1) * n], a.model_B[axis].reshape(-1, n).T
        v = inputs[:, :m] if coupled else inputs[:, axis : axis + 1]
        pole, delay = a.observer[axis, 2], int(a.delays[axis])
        level, rate = now["offsets"].reshape(-1, 2)[axis]
        x = now["models"].reshape(-1, n)[axis]
        reference[:, axis] = now["wanted"].reshape(m, -1)[axis, delay : delay + N]
        for i in range(N):
            x = A @ x + B @ v[i]
            angles[i, axis] = x[0] + level + rate * (1.0 - pole ** (delay + 1 + i)) / (1.0 - pole)
    return angles, reference


class PredictivePart(BlockPart):
    """A predictive controller that a loop steps; a `softneck.loop.Part` with `info` of its last sample.

    Attributes:
        took: how long the last sample took [s]; NaN before the first.
    """

    def __init__(self, controller: Any) -> None:
        """Adapt a controller."""
        super().__init__(controller.block())
        self._controller, self.took = controller, math.nan

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start; unknown parameters raise SettingsError."""
        self.took = math.nan
        return super().start(time, parameters)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        begin = clock.perf_counter()
        outputs = super().advance(time, inputs)
        self.took = clock.perf_counter() - begin
        return outputs

    @property
    def info(self) -> Any:
        """What the last sample decided."""
        return self._controller.explain(self._state)
