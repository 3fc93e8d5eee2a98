"""Steps and loads in time: the controller's own runtime against every plant, with all its limits, and noise."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.loop._result import SETTLING_BAND
from softneck.runtime import Block, load_functions
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ._plants import Plants

_RUNTIME = "softneck.verification._sweep_runtime"
_PORTS = (
    "pitch_reference", "roll_reference", "cocontraction_reference", "pitch", "roll",
    "motor_position_1", "motor_position_2", "motor_position_3", "healthy", "enabled",
)  # fmt: skip
METRICS = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "load_rms_deg", "coupling_deg")
# As the lab and `softneck.loop` measure a rise, and the part of the time in which all is settled.
_RISE, _STEADY_PART = (0.1, 0.9), 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class StepTest:
    """A step of one axis after the other, then a load.

    Attributes:
        step: size [rad].
        duration: until the load comes [s], and once more as long with it.
        noise: standard deviation of the measured angles [rad].
        load: added to the plant's input after `duration` [rad].
        seed: of the noise, which all plants share.
    """

    step: float
    duration: float
    noise: float
    load: float
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """What all plants did, of the step in pitch and of that in roll.

    Attributes:
        time: (rows,) [s].
        angles: (2, n, rows) the stepped angle [rad].
        motors: (2, n, rows, 3) set-points [rad].
        metrics: name -> (n,) the worse of both axes; inf where a level is never reached or numbers overflow.
        worse: name -> (n,) 0 where pitch is that one, 1 where roll is.
    """

    time: Vector
    angles: np.ndarray
    motors: np.ndarray
    metrics: dict[str, Vector]
    worse: dict[str, np.ndarray]


def check_ports(block: Block) -> None:
    """Raise SettingsError unless `block` is a controller of the neck's channels."""
    inputs, outputs = {port.name for port in block.inputs}, {port.name for port in block.outputs}
    missing = [name for name in ("pitch_reference", "roll_reference", "pitch", "roll") if name not in inputs]
    missing += [f"motor_setpoint_{j}" for j in (1, 2, 3) if f"motor_setpoint_{j}" not in outputs]
    if missing:
        raise SettingsError(
            f"the controller {block.kind} has no channel `{missing[0]}`; softneck verifies controllers from "
            "pitch, roll and their references to motor_setpoint_1..3."
        )


def run_steps(plants: Plants, block: Block, test: StepTest, *, workers: int | None = None) -> Steps:
    """Return the responses of all plants.

    Args:
        plants: with the delay that the loop's order adds.
        block: the controller.
        test: what is asked.
        workers: threads; all cores where None.
    """
    Ts = plants.sample_time
    half = round(test.duration / Ts)
    rows = 2 * half
    rng = np.random.default_rng(test.seed)
    noise = test.noise * rng.standard_normal((rows, 2))
    angles, motors, other = [], [], []
    for axis in (0, 1):
        signals = np.zeros((rows, 7))
        signals[:, axis] = test.step
        signals[:, 3:5] = noise
        signals[half:, 5 + axis] = test.load
        y, P = _run(plants, block, signals, workers or os.cpu_count() or 1)
        angles.append(y[:, :, axis])
        other.append(y[:, :half, 1 - axis])
        motors.append(P)
    parts = [_metrics(angles[i], other[i], test, half, Ts) for i in (0, 1)]
    table = {name: np.stack([part[name] for part in parts]) for name in METRICS}
    return Steps(
        np.arange(rows) * Ts,
        np.array(angles),
        np.array(motors),
        {name: both.max(axis=0) for name, both in table.items()},
        {name: both.argmax(axis=0) for name, both in table.items()},
    )


def _run(plants: Plants, block: Block, signals: Matrix, workers: int) -> tuple[np.ndarray, np.ndarray]:
    functions: Any = load_functions(f"{_RUNTIME}({block.runtime}:{len(block.arrays)})")
    T = redefinition_matrix(np.asarray(TENDON_ANGLES))
    arrays = (T, *block.arrays)
    parameters = block.initial_state().parameters
    names = [port.name for port in block.inputs]
    places = np.array([names.index(name) if name in names else -1 for name in _PORTS])
    outputs = [port.name for port in block.outputs]
    outputs_at = np.array([*(outputs.index(f"motor_setpoint_{j}") for j in (1, 2, 3)), len(outputs)])
    start = np.array([port.start for port in block.inputs])
    for axis, name in enumerate(("pitch", "roll")):
        if f"{name}_reference_ahead" in names:  # of a predictive one; the step is there from the start
            start[names.index(f"{name}_reference_ahead")] = signals[0, axis]
    n, rows = len(plants), signals.shape[0]
    angles, motors = np.empty((n, rows, 2)), np.empty((n, rows, 3))

    def part(chosen: slice) -> None:
        functions.sweep_run(
            arrays, parameters, start, places, outputs_at, plants.numerator[chosen], plants.denominator[chosen],
            plants.delay[chosen], plants.cross[chosen], signals, angles[chosen], motors[chosen],
        )  # fmt: skip

    borders = np.linspace(0, n, min(workers, n) + 1).astype(int)
    # The first plant compiles; two threads compiling the same function would do it twice.
    part(slice(0, 1))
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(part, [slice(a, b) for a, b in pairwise(borders)]))
    return angles, motors


def _metrics(y: Matrix, other: Matrix, test: StepTest, half: int, Ts: float) -> Mapping[str, Vector]:
    """Return the metrics (n,) of one axis: of the step before the load, of the load's effect, of the other axis."""
    first = y[:, :half] / test.step
    finite: np.ndarray = np.asarray(np.isfinite(y).all(axis=1) & np.isfinite(other).all(axis=1))
    first = np.where(finite[:, None], first, 0.0)
    rise = [np.where((first >= level).any(axis=1), (first >= level).argmax(axis=1), np.inf) for level in _RISE]
    outside = np.abs(first - 1.0) >= SETTLING_BAND
    settled = half - outside[:, ::-1].argmax(axis=1)
    settled = np.where(outside.any(axis=1), settled, 0)
    tail = np.where(finite[:, None], y, np.inf)
    steady = tail[:, half - int(half * _STEADY_PART) : half] - test.step
    with np.errstate(invalid="ignore", over="ignore"):
        found = {
            "overshoot_pct": np.maximum(0.0, 100.0 * (first.max(axis=1) - 1.0)),
            "rise_s": np.where(
                np.isfinite(rise[1]), (rise[1] - np.where(np.isfinite(rise[0]), rise[0], 0.0)) * Ts, np.inf
            ),
            "settling_s": np.where(settled < half, settled * Ts, np.inf),
            "steady_rms_deg": np.degrees(np.sqrt((steady**2).mean(axis=1))),
            "load_rms_deg": np.degrees(np.sqrt(((tail[:, half:] - test.step) ** 2).mean(axis=1))),
            "coupling_deg": np.degrees(np.abs(other).max(axis=1)),
        }
    return {name: np.where(finite, values, np.inf) for name, values in found.items()}
