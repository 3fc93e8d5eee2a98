"""Soft limits that are tightened until the true ones hold, found by trials over the uncertain plant's samples.

The back-off is the largest violation of the whole loop, its solver, limits and dead time included, while measurements
are wrong within a bound; what the trials still violate is added until nothing is left. Chance-constrained control takes
such back-offs from samples (Koller, Ricardez-Sandoval and Biegler 2018; Paulson and Mesbah 2018).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, to_si
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.runtime import load_runtime

from ..linear._ports import LIMITS, ControllerLimits
from ..plants._coupled_axis import AnyAxis, inputs_of
from . import _mpc_state_runtime as rt
from ._arrays import with_back_off
from ._scale import runtime_of, units_of
from ._tuning import Pair, slowness

# What is asked for, in limits, each for so long [s], stretched by another robot's slowest pole: the limit, the other
# one, beyond it, rest. After 1.5 s the slowest samples were still on their way to the limit, and what passes it by the
# error of its measurement had not come to pass.
_LEVELS = (1.0, -1.0, 1.4, 0.0)
_HOLD = 3.0
_ORIENTATIONS = (0.0, 0.25 * math.pi, 0.5 * math.pi, 1.25 * math.pi)
# Where only tautness is limited, steps are this large [rad]: the lab's 15 deg.
_TILT = math.radians(15.0)
# The neck's bound of 0.35 deg over its noise of 0.05 deg.
_OF_NOISE = 7.0
# Of limits, to be called kept [rad]; a tenth of what an inclinometer resolves.
_KEPT = math.radians(1e-3)
# A little more than was violated, so that the next round ends it.
_EXTRA = 1.1
_ROUNDS = 10
_SEED = 13


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitTrial:
    """What the limits are tried with, in SI.

    Attributes:
        parameters: position, slew, lead and least position limits of the block.
        angle_limit, minimum_tautness: soft limits [rad], None for none.
        lever: (motors, outputs) how much an angle loosens each tendon [rad/rad], of another robot in the units of its
            size.
        measurement_bound: largest error of a measured angle [rad].
        neck: whether they are those of a neck.
    """

    parameters: tuple[float, ...]
    angle_limit: float | None
    minimum_tautness: float | None
    lever: Matrix
    measurement_bound: float
    neck: bool


def trial_of(settings: Any, limits: ControllerLimits, lever: Matrix) -> LimitTrial:
    """Return what the soft limits of `MpcSettings` are tried with."""
    taut, motors = settings.minimum_tautness, to_si(limits.robot.motors.unit)[0]
    return LimitTrial(
        parameters=tuple(getattr(limits, name) for name in LIMITS[:4]),
        angle_limit=settings.angle_limit,
        minimum_tautness=None if taut is None else motors * taut,
        lever=lever,
        measurement_bound=measurement_bound(settings.measurement_bound, limits.robot),
        neck=limits.robot.is_neck,
    )


def measurement_bound(given: float, robot: Robot) -> float:
    """Return by how much a measured output of a robot may be wrong in trials, in SI.

    Raises:
        SettingsError: a bound that no neck's angle has, or one that neither its settings nor its file say.
    """
    if robot.is_neck:
        require_between("measurement_bound", given, 0.0, 0.1, "rad")
        return given
    if isinstance(given, NeckDefault):
        if robot.noise_std is None:
            raise SettingsError(
                f"robot {robot.label()} gives no `sensor.noise_std`, which `tightening` needs; add it, or give "
                f"`measurement_bound` in {robot.outputs.unit}."
            )
        given = _OF_NOISE * robot.noise_std
    return to_si(robot.outputs.unit)[0] * given


def tightened(
    arrays: tuple[Matrix, ...], plants: list[Pair], trial: LimitTrial
) -> tuple[tuple[Matrix, ...], dict[str, float]]:
    """Return the arrays with the least back-off that was found to keep the limits, and that back-off [rad].

    Of another robot it is in SI; that of the outputs is the largest of all.

    Raises:
        SettingsError: none does; the angles' own limit would be used up, or tautness beyond what motors reach.
    """
    if trial.angle_limit is None and trial.minimum_tautness is None:
        raise SettingsError("`tightening` needs a soft limit: give `angle_limit` or `minimum_tautness`.")
    angle = taut = 0.0
    unit, outputs, _ = units_of(arrays)
    most = math.inf if trial.angle_limit is None else trial.angle_limit / float(outputs.max())
    for _ in range(_ROUNDS):
        found = with_back_off(arrays, angle, taut)
        beyond = np.max([excess(found, pair, trial) for pair in plants], axis=0)
        if beyond.max() <= _KEPT:
            return found, {"angle": angle * float(outputs.max()), "tautness": taut * unit}
        angle += _EXTRA * max(0.0, float(beyond[0]))
        taut += _EXTRA * max(0.0, float(beyond[1]))
        if angle >= 0.5 * most or taut >= trial.parameters[0] / unit:
            break
    angle, taut = angle * float(outputs.max()), taut * unit
    raise SettingsError(
        f"no tightening keeps the soft limits on all {len(plants)} plants (reached {math.degrees(angle):.2g} deg and "
        f"{taut:.2g} rad of back-off); widen them, or ask for less `bandwidth` or `max_sensitivity`."
    )


def excess(arrays: tuple[Matrix, ...], plants: Pair, trial: LimitTrial) -> tuple[float, float]:
    """Return by how much [rad] angles and tautness pass their limits in all trials with one plant; below zero is room.

    Of another robot in the units of its size.

    A motor is taken to be where its set-point was a dead time before: in drives most of the dead time is theirs.
    """
    rng = np.random.default_rng(_SEED)
    worst = (-math.inf, -math.inf)
    unit, outputs, _ = units_of(arrays)
    for direction, bias in directions(len(plants), rng, neck=trial.neck):
        angles, motors = closed_loop(arrays, plants, trial, (direction, bias), rng)
        beyond = slack = -math.inf
        if trial.angle_limit is not None:
            beyond = float((np.abs(angles) - trial.angle_limit / outputs).max())
        if trial.minimum_tautness is not None:
            slack = trial.minimum_tautness / unit - float((motors - angles @ trial.lever.T).min())
        worst = max(worst[0], beyond), max(worst[1], slack)
    return worst


def directions(outputs: int, rng: np.random.Generator, *, neck: bool) -> Iterator[tuple[Vector, Vector]]:
    """Yield where the outputs are asked to go (outputs,), and which sign the constant error of each has then.

    A neck's as they were chosen, each error of either sign at random. Others alone and all together, errors to both
    sides: the sign that sends an output beyond its limit is not left to chance, which passed `trunk4`'s by 0.014 rad.
    """
    if neck:
        for orientation in _ORIENTATIONS:
            direction = np.array([math.cos(orientation), math.sin(orientation)])
            yield direction / np.abs(direction).max(), rng.choice([-1.0, 1.0], outputs)
        return
    together = [np.ones(outputs), -np.ones(outputs)] if outputs > 1 else []
    for direction in (*np.eye(outputs), *together):
        for sign in (1.0, -1.0):
            yield direction, sign * np.ones(outputs)


def closed_loop(
    arrays: tuple[Matrix, ...], plants: Pair, trial: LimitTrial, way: tuple[Vector, Vector], rng: np.random.Generator
) -> tuple[Matrix, Matrix]:
    """Return the true angles (time, outputs) and motors (time, motors) of one trial.

    Of another robot in the units of its size; its controller is asked and answers in SI.
    """
    runtime, a = load_runtime(runtime_of(arrays)), rt.MpcArrays(arrays)
    Ts, H, m, n = plants[0].sample_time, int(a.constants[rt.MPC_AHEAD]), len(plants), a.T.shape[1]
    unit, outputs, _ = units_of(arrays)
    rows = round(_HOLD * slowness(plants) / Ts)
    tilt = _TILT if trial.angle_limit is None else trial.angle_limit / outputs
    levels = np.repeat(_LEVELS, rows)
    direction, bias = way
    wanted = np.vstack([levels[:, None] * (tilt * direction), np.zeros((H, m))])
    # A constant error of either sign, and one that changes with every sample.
    errors = (trial.measurement_bound / outputs) * (0.5 * bias + 0.5 * rng.uniform(-1.0, 1.0, (levels.size, m)))
    parameters = np.array(
        [*trial.parameters, *(v for v in (trial.angle_limit, trial.minimum_tautness) if v is not None)]
    )
    state, out = np.zeros(runtime.state_size(arrays)), np.zeros(n)
    flags = 2 * m + 1 + n
    inputs = np.zeros(flags + 2 + (m if H > 0 else 0) + int(a.constants[rt.MPC_DISTURBANCES]))
    inputs[flags : flags + 2] = 1.0
    necks = [_Axis(plant, inputs_of(plant, axis, m)) for axis, plant in enumerate(plants)]
    dead = max(plant.delay for plant in plants)
    line, angles, motors = np.zeros((dead + 1, n)), np.zeros((levels.size, m)), np.zeros((levels.size, n))
    for k in range(levels.size):
        angles[k], motors[k] = [neck.y for neck in necks], line[-1]
        inputs[:m], inputs[m + 1 : 2 * m + 1] = outputs * wanted[k], outputs * (angles[k] + errors[k])
        inputs[2 * m + 1 : flags] = unit * motors[k]
        if H > 0:
            inputs[flags + 2 : flags + 2 + m] = outputs * wanted[k + H]
        runtime.step(arrays, parameters, state, inputs, out)
        line = np.vstack([out / unit, line[:-1]])
        for neck in necks:
            neck.advance((a.T @ line[0])[:m])
    return angles, motors


class _Axis:
    """One axis of a plant behind its dead time."""

    def __init__(self, plant: AnyAxis, B: Matrix) -> None:
        self.A, _, self.C = plant.observable_form()
        self.B = B
        self.x: Vector = np.zeros(plant.order)
        self.line: list[Vector] = [np.zeros(B.shape[1])] * plant.delay
        self.y = 0.0

    def advance(self, v: Vector) -> None:
        """Move on by a sample under the redefined inputs `v` of all axes."""
        self.line.append(v)
        self.x = self.A @ self.x + self.B @ self.line.pop(0)
        self.y = float(self.C @ self.x)
