"""Step and load responses of every linear plant with the controller's own runtime, limits and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, core_count, side_by_side, to_si
from softneck.design import motor_ranges
from softneck.loop import SETTLING_BAND, error_unit
from softneck.robot import Robot
from softneck.runtime import Block, load_functions

from ._plants import Plants, mixing_matrix

_SWEEP_RUNTIME = "softneck.verification._sweep_runtime"
NO_PAYLOAD_IN_STEPS = (
    "linear plants are stepped with the payload at its start value (0 kg); the loops over simulation models have the "
    "estimate"
)
METRICS = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "load_rms_deg", "coupling_deg")
# Levels of the rise as in `softneck.loop`, and the final share of the time that is the steady state.
_RISE_LEVELS, _STEADY_SHARE = (0.1, 0.9), 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class StepTest:
    """A step of one axis after the other, then a load; [rad] is the SI unit of the outputs.

    `step`: size [rad]. `duration`: of the step, and of the load after it [s]. `noise`: standard deviation of the
    measured angles [rad]. `load`: added to the plant's input after `duration` [rad]. `seed`: of the noise, equal for
    all plants.
    """

    step: float
    duration: float
    noise: float
    load: float
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Responses of all plants to a step of each axis; [rad] is the SI unit of the outputs.

    `time`: (rows,) [s]. `angles`: (axes, n, rows) the stepped angle [rad]. `motors`: (axes, n, rows, motors) set-points
    [rad]. `metrics`: name -> (n,) the worst of all axes, in deg or the robot's display unit; inf where a level is never
    reached or numbers overflow. `worse`: name -> (n,) the worst axis.
    """

    time: Vector
    angles: np.ndarray
    motors: np.ndarray
    metrics: dict[str, Vector]
    worse: dict[str, np.ndarray]


def check_ports(block: Block, robot: Robot) -> None:
    """Raise SettingsError unless `block` is a controller of the robot's channels."""
    inputs, outputs = {port.name for port in block.inputs}, {port.name for port in block.outputs}
    names = robot.outputs.names
    missing = [name for name in (*(f"{name}_reference" for name in names), *names) if name not in inputs]
    missing += [name for name in robot.set_points if name not in outputs]
    if missing:
        raise SettingsError(
            f"the controller {block.kind} has no channel `{missing[0]}`; softneck verifies controllers from "
            f"{', '.join(names)} and their references to {', '.join(robot.set_points)}."
        )


def run_steps(
    plants: Plants, block: Block, test: StepTest, *, robot: Robot | None = None, weights: Sequence[Matrix] = ()
) -> Steps:
    """Return the responses of all plants, which include the delay of the loop's order, with a controller `block`.

    `robot` None is the neck, `weights` (axes, motors) those of each source of plants; without, they are the robot's.
    """
    whose = Robot.preset() if robot is None else robot
    m, n, Ts = len(plants.axes), len(plants), plants.sample_time
    half = round(test.duration / Ts)
    angles, motors = np.empty((m, n, 2 * half, m)), np.empty((m, n, 2 * half, len(whose.set_points)))
    for number, each in enumerate(weights or [None]):
        mine = plants.source == number if weights else np.full(n, True)
        if not mine.any():
            continue
        T = whose.redefinition(each)[0]
        for axis in range(m):
            signals = _step_signals(axis, T @ middle_motors(whose, block), middle_of(whose), test, half)
            y, P = _run(plants.take(np.flatnonzero(mine)), block, signals, T, whose)
            angles[axis, mine], motors[axis, mine] = y[:, -2 * half :], P[:, -2 * half :]
    own = [angles[i, :, :, i] for i in range(m)]
    other = [np.delete(angles[i, :, :half], i, axis=2) for i in range(m)]
    parts = [_metrics(own[i], other[i], test, half, Ts, error_unit(whose)[1]) for i in range(m)]
    table = {name: np.stack([part[name] for part in parts]) for name in METRICS}
    worst = {name: values.max(axis=0) for name, values in table.items()}
    worse = {name: values.argmax(axis=0) for name, values in table.items()}
    return Steps(np.arange(2 * half) * Ts, np.array(own), motors, worst, worse)


def _step_signals(axis: int, before: Vector, around: Vector, test: StepTest, half: int) -> Matrix:
    """Return references, co-contraction, measurement noise and loads (time, 3 m + 1) of the step of one axis.

    before: the redefined inputs around which steps are made; around: the outputs there.
    """
    m, rows = around.size, 2 * half
    # Motors start at zero; those with another operating point are moved there before the test.
    first = rows if before.any() else 0
    signals = np.zeros((first + rows, 3 * m + 1))
    signals[:, :m], signals[:, m] = around, before[m]
    signals[first:, axis] += test.step
    signals[:, m + 1 : 2 * m + 1] = around
    signals[first:, m + 1 : 2 * m + 1] += test.noise * np.random.default_rng(test.seed).standard_normal((rows, m))
    # The plants are linear around that point.
    signals[:, 2 * m + 1 :] -= before[:m]
    signals[first + half :, 2 * m + 1 + axis] += test.load
    return signals


def middle_of(robot: Robot) -> Vector:
    """Return the outputs around which steps are made: rest, or the middle of their range."""
    outputs, factor = robot.outputs, to_si(robot.outputs.unit)[0]
    if outputs.rest is not None:
        return factor * np.array(outputs.rest)
    if outputs.min is None or outputs.max is None:
        return np.zeros(len(outputs.names))
    return 0.5 * factor * (np.array(outputs.min) + np.array(outputs.max))


def middle_motors(robot: Robot, block: Block) -> Vector:
    """Return the set-points (motors,) around which steps are made: rest, or the middle of their range."""
    if robot.motors.rest is not None:
        return to_si(robot.motors.unit)[0] * np.array(robot.motors.rest)
    limits = {port.name: port.start for port in block.parameters}
    ranges = motor_ranges(robot, limits.get("position_limit"))
    return np.zeros(len(robot.set_points)) if ranges is None else 0.5 * (ranges[0] + ranges[1])


def _run(plants: Plants, block: Block, signals: Matrix, T: Matrix, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    functions: Any = load_functions(f"{_SWEEP_RUNTIME}({block.runtime}:{len(block.arrays)})")
    axes, set_points = robot.outputs.names, robot.set_points
    arrays = (T, *block.arrays)
    parameters = block.initial_state().parameters
    names = [port.name for port in block.inputs]
    ports = (
        *(f"{axis}_reference" for axis in axes), "cocontraction_reference", *axes, *robot.motor_positions, "healthy",
        "enabled",
    )  # fmt: skip
    places = np.array([names.index(name) if name in names else -1 for name in ports])
    outputs = [port.name for port in block.outputs]
    outputs_at = np.array([*(outputs.index(name) for name in set_points), len(outputs)])
    start = np.array([port.start for port in block.inputs])
    for axis, name in enumerate(axes):
        if f"{name}_reference_ahead" in names:  # predictive controllers see the step from the start
            start[names.index(f"{name}_reference_ahead")] = signals[0, axis]
    n, rows = len(plants), len(signals)
    angles, motors = np.empty((n, rows, len(axes))), np.empty((n, rows, len(set_points)))
    mixed = mixing_matrix(plants.cross, len(axes))

    def part(chosen: slice) -> None:
        with np.errstate(all="ignore"):  # user controllers run in plain Python, and loops may diverge
            functions.sweep_run(
                arrays, parameters, start, places, outputs_at, plants.numerator[chosen], plants.denominator[chosen],
                plants.delay[chosen], mixed[chosen], signals, angles[chosen], motors[chosen],
            )  # fmt: skip

    borders = np.linspace(0, n, min(core_count(), n) + 1).astype(int)
    # The first plant compiles; two threads compiling the same function would do it twice.
    part(slice(0, 1))
    side_by_side([partial(part, slice(a, b)) for a, b in pairwise(borders)])
    return angles, motors


def _metrics(
    y: Matrix, other: np.ndarray, test: StepTest, half: int, Ts: float, factor: float | None = None
) -> Mapping[str, Vector]:
    """Return the metrics (n,) of one axis; `factor` converts from the display unit to SI, None: from deg."""
    first = y[:, :half] / test.step
    other = other.reshape(len(y), -1)
    finite: np.ndarray = np.asarray(np.isfinite(y).all(axis=1) & np.isfinite(other).all(axis=1))

    display = np.degrees if factor is None else lambda values: values / factor
    first = np.where(finite[:, None], first, 0.0)
    rise = [np.where((first >= level).any(axis=1), (first >= level).argmax(axis=1), np.inf) for level in _RISE_LEVELS]
    begin = np.where(np.isfinite(rise[0]), rise[0], 0.0)
    outside = np.abs(first - 1.0) >= SETTLING_BAND
    settled = half - outside[:, ::-1].argmax(axis=1)
    settled = np.where(outside.any(axis=1), settled, 0)
    tail = np.where(finite[:, None], y, np.inf)
    steady = tail[:, half - int(half * _STEADY_SHARE) : half] - test.step
    with np.errstate(invalid="ignore", over="ignore"):
        found = {
            "overshoot_pct": np.maximum(0.0, 100.0 * (first.max(axis=1) - 1.0)),
            "rise_s": np.where(np.isfinite(rise[1]), (rise[1] - begin) * Ts, np.inf),
            "settling_s": np.where(settled < half, settled * Ts, np.inf),
            "steady_rms_deg": display(np.sqrt((steady**2).mean(axis=1))),
            "load_rms_deg": display(np.sqrt(((tail[:, half:] - test.step) ** 2).mean(axis=1))),
            "coupling_deg": display(np.abs(other).max(axis=1, initial=0.0)),
        }
    return {name: np.where(finite, values, np.inf) for name, values in found.items()}
