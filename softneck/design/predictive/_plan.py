"""Trajectories of the motors' set-points that are planned before anything moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import (
    Matrix,
    SettingsError,
    Vector,
    require_between,
    require_finite,
    require_positive,
    require_whole,
)
from softneck.identification import Model
from softneck.loop import RecordingReference, Reference
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..linear._ports import MAX_MOTOR, require_taut
from ._optimal import OptimalControl, Task

# Kinks leave a solution without the last digits: a cost that changes by less than this, five times in a row, is one.
# Rows are linear, so no step breaks them meanwhile.
_ENOUGH = {
    "acceptable_tol": 1e3, "acceptable_obj_change_tol": 1e-3, "acceptable_iter": 5, "acceptable_constr_viol_tol": 1e-6,
}  # fmt: skip
# Tautness is kept under the angles that the round before led to, this much more [rad], until it holds under its own.
_ROUNDS, _BACK_OFF = 8, 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanSettings:
    """What a planned trajectory must keep, and what it costs beside the errors of pitch and roll, squared [rad^2].

    Attributes:
        spacing: of the points between which set-points are straight lines [s].
        position_limit, slew_limit, least_position: of each motor [rad], [rad/s], [rad].
        minimum_tautness: least motor position beyond that at which a tendon follows the neck [rad], see `MpcSettings`;
            None for no limit.
        tautness_lever: motor angle that one radian of neck takes up [rad/rad].
        move_weight: on the moves of each motor from sample to sample, squared.
        cocontraction_weight: on the error of co-contraction, squared.
        iterations: of ipopt, at most.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    spacing: float = 0.1
    position_limit: float = 6.0
    slew_limit: float = 12.5
    least_position: float = -6.0
    minimum_tautness: float | None = None
    tautness_lever: float = 6.93
    move_weight: float = 1e-3
    cocontraction_weight: float = 1e-3
    iterations: int = 100
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())

    def __post_init__(self) -> None:
        require_between("spacing", self.spacing, 1e-3, 10.0, "s")
        require_between("position_limit", self.position_limit, 0.01, MAX_MOTOR, "rad")
        require_between("slew_limit", self.slew_limit, 0.01, 1000.0, "rad/s")
        require_taut(self.least_position, -MAX_MOTOR, self.position_limit)
        require_between("tautness_lever", self.tautness_lever, 0.0, 100.0, "rad/rad")
        if self.minimum_tautness is not None:
            require_finite("minimum_tautness", self.minimum_tautness, "rad")
        for name in ("move_weight", "cocontraction_weight"):
            require_positive(name, getattr(self, name))
        require_whole("iterations", self.iterations, 1, 10_000)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Plan:
    """A planned trajectory, from rest.

    Attributes:
        time: (N,) [s], from 0.
        set_points: (N, 3) of the motors, each held until the next [rad].
        angles: (N, 2) pitch and roll that the model predicts at `time` [rad].
        tautness: least of all tendons and samples [rad].
        status: what ipopt says of its last solution; "Solved_To_Acceptable_Level" at kinks.
        cocontraction: (N,) delta_i of the set-points [rad].
    """

    time: Vector
    set_points: Matrix
    angles: Matrix
    tautness: float
    status: str
    cocontraction: Vector

    def reference(self) -> RecordingReference:
        """Return the angles and the co-contraction as a loop's reference: one that the neck can follow."""
        pitch, roll = self.angles.T
        return RecordingReference(time=self.time, pitch=pitch, roll=roll, cocontraction=self.cocontraction)


def plan(model: Model, reference: Reference, *, duration: float, settings: PlanSettings | None = None) -> Plan:
    """Return the trajectory from rest whose predicted angles are nearest to `reference`, within all limits.

    Args:
        model: any that `model.casadi()` writes.
        reference: pitch, roll and co-contraction at a time, as a loop takes it; what cannot be reached is approached.
        duration: [s].
        settings: limits and weights.

    Raises:
        SettingsError: limits that contradict each other, or a model that searches a set.
    """
    s, Ts, block = settings or PlanSettings(), model.sample_time, model.block()
    require_between("duration", duration, 2.0 * Ts, 600.0, "s")
    N, hold = round(duration / Ts), max(1, round(s.spacing / Ts))
    time, T = Ts * np.arange(N), redefinition_matrix(np.array(s.tendon_angles))
    now, ahead = (np.array([reference(float(t + late)) for t in time]) for late in (0.0, Ts))
    problem, spread = _problem(model, s, N, hold)
    n = spread.shape[1]
    # A tilt of the neck towards a tendon lets it loose by as much.
    loosened = s.tautness_lever * T[:2]
    taut = -np.inf if s.minimum_tautness is None else s.minimum_tautness
    slew, endless = np.full(n, s.slew_limit * Ts * hold), np.full(3 * N, np.inf)
    rest = block.initial_state(use_measurement=0.0, noise_std=0.0)
    z, angles, set_points, status, tautness = np.zeros(n), ahead[:, :2], np.zeros((N, 3)), "", -np.inf
    for _ in range(_ROUNDS):
        least = (taut + _BACK_OFF + angles @ loosened).ravel()
        z, status = problem.solve(Task(
            start=rest.values, offset=np.zeros(3 * N), target=ahead[:, :2].ravel(),
            asked=np.concatenate([np.zeros(n), np.sqrt(s.cocontraction_weight) * now[:, 2]]),
            low=np.concatenate([-slew, least]), high=np.concatenate([slew, endless]),
            least=np.full(n, max(-s.position_limit, s.least_position)), most=np.full(n, s.position_limit), guess=z,
        ))  # fmt: skip
        set_points = (spread @ z).reshape(N, 3)
        angles = block.run(rest, np.hstack([set_points, np.full((N, len(block.inputs) - 3), np.nan)]))[1][:, :2]
        tautness = float((set_points - angles @ loosened).min())
        if status.startswith("Infeasible") or tautness >= taut:
            break
    else:
        status = "Infeasible"
    if status.startswith("Infeasible"):
        raise SettingsError(
            f"no trajectory from rest was found that keeps a tautness of {taut:g} rad; lower `minimum_tautness`, or "
            "ask for slower angles or more co-contraction."
        )
    return Plan(
        time=time, set_points=set_points, angles=np.vstack([rest.outputs[:2], angles[:-1]]), tautness=tautness,
        status=status, cocontraction=set_points @ T[2],
    )  # fmt: skip


def _problem(model: Model, s: PlanSettings, N: int, hold: int) -> tuple[OptimalControl, Matrix]:
    """Return the problem over the motors' places z at the points, and (3 N, nz) which make the set-points of z."""
    K = -(-N // hold)
    places = (np.arange(N) + 1.0) / hold
    # Straight lines from rest through the points 1..K.
    spread = np.kron(np.maximum(0.0, 1.0 - np.abs(places[:, None] - np.arange(1.0, K + 1.0))), np.eye(3))
    moves = np.kron(np.eye(K) - np.eye(K, k=-1), np.eye(3))
    level = np.kron(np.eye(N), redefinition_matrix(np.array(s.tendon_angles))[2:]) @ spread
    problem = OptimalControl(
        model, spread=spread, weights=np.ones(2 * N), Q=np.zeros((3 * (K + N), 2 * N)), G=np.vstack([moves, spread]),
        R=np.vstack([np.sqrt(s.move_weight / hold) * moves, np.sqrt(s.cocontraction_weight) * level]),
        options={"max_iter": s.iterations, **_ENOUGH},
    )  # fmt: skip
    return problem, spread
