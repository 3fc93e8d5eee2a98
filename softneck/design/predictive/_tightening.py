"""Soft limits that are tightened until the true ones hold, found by trials over the uncertain plant's samples.

The back-off is the largest violation of the whole loop, its solver, limits and dead time included, while measurements
are wrong within a bound; what the trials still violate is added until nothing is left. Chance-constrained control takes
such back-offs from samples (Koller, Ricardez-Sandoval and Biegler 2018; Paulson and Mesbah 2018).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AxisPlant
from softneck.runtime import load_runtime

from . import _mpc_state_runtime as rt
from ._arrays import with_back_off
from ._tuning import Pair

# What is asked for, in limits, each for so long [s]: the limit, the other one, beyond it, rest.
_LEVELS = (1.0, -1.0, 1.4, 0.0)
_HOLD = 1.5
_ORIENTATIONS = (0.0, 0.25 * math.pi, 0.5 * math.pi, 1.25 * math.pi)
# Where only tautness is limited, steps are this large [rad]: the lab's 15 deg.
_TILT = math.radians(15.0)
# Of limits, to be called kept [rad]; a tenth of what an inclinometer resolves.
_KEPT = math.radians(1e-3)
# A little more than was violated, so that the next round ends it.
_EXTRA = 1.1
_ROUNDS = 10
_SEED = 13


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitTrial:
    """What the limits are tried with.

    Attributes:
        parameters: position, slew, lead and least position limits of the block.
        angle_limit, minimum_tautness: soft limits [rad], None for none.
        tautness_lever: [rad/rad].
        measurement_bound: largest error of a measured angle [rad].
    """

    parameters: tuple[float, float, float, float]
    angle_limit: float | None
    minimum_tautness: float | None
    tautness_lever: float
    measurement_bound: float


def tightened(
    arrays: tuple[Matrix, ...], plants: list[Pair], trial: LimitTrial
) -> tuple[tuple[Matrix, ...], dict[str, float]]:
    """Return the arrays with the least back-off that was found to keep the limits, and that back-off [rad].

    Raises:
        SettingsError: none does; the angles' own limit would be used up, or tautness beyond what motors reach.
    """
    if trial.angle_limit is None and trial.minimum_tautness is None:
        raise SettingsError("`tightening` needs a soft limit: give `angle_limit` or `minimum_tautness`.")
    angle = taut = 0.0
    for _ in range(_ROUNDS):
        found = with_back_off(arrays, angle, taut)
        beyond = np.max([excess(found, pair, trial) for pair in plants], axis=0)
        if beyond.max() <= _KEPT:
            return found, {"angle": angle, "tautness": taut}
        angle += _EXTRA * max(0.0, float(beyond[0]))
        taut += _EXTRA * max(0.0, float(beyond[1]))
        if angle >= 0.5 * (trial.angle_limit or math.inf) or taut >= trial.parameters[0]:
            break
    raise SettingsError(
        f"no tightening keeps the soft limits on all {len(plants)} plants (reached {math.degrees(angle):.2g} deg and "
        f"{taut:.2g} rad of back-off); widen them, or ask for less `bandwidth` or `max_sensitivity`."
    )


def excess(arrays: tuple[Matrix, ...], plants: Pair, trial: LimitTrial) -> tuple[float, float]:
    """Return by how much [rad] angles and tautness pass their limits in all trials with one plant; below zero is room.

    A motor is taken to be where its set-point was a dead time before: in drives most of the dead time is theirs.
    """
    rng = np.random.default_rng(_SEED)
    worst = (-math.inf, -math.inf)
    for orientation in _ORIENTATIONS:
        angles, motors = closed_loop(arrays, plants, trial, orientation, rng)
        lever = trial.tautness_lever * rt.MpcArrays(arrays).T[:2].T
        beyond = -math.inf if trial.angle_limit is None else float(np.abs(angles).max()) - trial.angle_limit
        slack = -math.inf
        if trial.minimum_tautness is not None:
            slack = trial.minimum_tautness - float((motors - angles @ lever.T).min())
        worst = max(worst[0], beyond), max(worst[1], slack)
    return worst


def closed_loop(
    arrays: tuple[Matrix, ...], plants: Pair, trial: LimitTrial, orientation: float, rng: np.random.Generator
) -> tuple[Matrix, Matrix]:
    """Return the true angles (time, 2) and motors (time, 3) of one trial."""
    runtime, a = load_runtime("softneck.design.predictive._mpc_runtime"), rt.MpcArrays(arrays)
    Ts, H = plants[0].sample_time, int(a.constants[rt.MPC_AHEAD])
    rows = round(_HOLD / Ts)
    tilt = _TILT if trial.angle_limit is None else trial.angle_limit
    levels = tilt * np.repeat(_LEVELS, rows)
    direction = np.array([math.cos(orientation), math.sin(orientation)])
    direction /= np.abs(direction).max()
    wanted = np.vstack([levels[:, None] * direction, np.zeros((H, 2))])
    # A constant error of either sign, and one that changes with every sample.
    errors = trial.measurement_bound * (
        0.5 * rng.choice([-1.0, 1.0], 2) + 0.5 * rng.uniform(-1.0, 1.0, (levels.size, 2))
    )
    parameters = np.array(
        [*trial.parameters, *(v for v in (trial.angle_limit, trial.minimum_tautness) if v is not None)]
    )
    state, out = np.zeros(runtime.state_size(arrays)), np.zeros(3)
    inputs = np.zeros(10 + (2 if H > 0 else 0) + int(a.constants[rt.MPC_DISTURBANCES]))
    inputs[8:10] = 1.0
    necks = [_Axis(plant) for plant in plants]
    dead = max(plant.delay for plant in plants)
    line, angles, motors = np.zeros((dead + 1, 3)), np.zeros((levels.size, 2)), np.zeros((levels.size, 3))
    for k in range(levels.size):
        angles[k], motors[k] = [neck.y for neck in necks], line[-1]
        inputs[:2], inputs[3:5], inputs[5:8] = wanted[k], angles[k] + errors[k], motors[k]
        if H > 0:
            inputs[10:12] = wanted[k + H]
        runtime.step(arrays, parameters, state, inputs, out)
        line = np.vstack([out, line[:-1]])
        for axis, neck in enumerate(necks):
            neck.advance(float((a.T @ out)[axis]))
    return angles, motors


class _Axis:
    """One axis of a plant behind its dead time."""

    def __init__(self, plant: AxisPlant) -> None:
        self.A, self.B, self.C = plant.observable_form()
        self.x: Vector = np.zeros(plant.order)
        self.line = [0.0] * plant.delay
        self.y = 0.0

    def advance(self, v: float) -> None:
        """Move on by a sample under the input `v`."""
        self.line.append(v)
        self.x = self.A @ self.x + self.B * self.line.pop(0)
        self.y = float(self.C @ self.x)
