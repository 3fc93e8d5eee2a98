"""The error of the grey box's simulation over recordings, and its search by Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from softneck.core import Matrix, Progress, Vector, compute_once, side_by_side
from softneck.robot import Robot
from softneck.runtime import load_functions

from ..models._drive import drive_start
from ..models._fitting import ScaledData, payload_of
from ._levenberg_marquardt import Bounds, minimise
from ._loaded_greybox_runtime import loaded_neck
from ._neck_equations_runtime import NECK_SUBSTEPS
from ._parameters import (
    BODY_PARAMETERS,
    NO_EFFECT,
    OUT_OF_PLANE_PARAMETERS,
    PARAMETERS,
    PARTS,
    PAYLOAD_CURVE,
    PAYLOAD_PARAMETERS,
    Parameter,
    payload_parameters,
)

_SIMULATION_RUNTIME = "softneck.identification.structured._neck_equations_runtime"
# An error of a motor counts as much as one of the tilt twenty times smaller: about the ratio of their ranges.
_MOTOR_WEIGHT = 0.05
# How much a number a spread away from its guess counts, as an error [rad] of one row: next to nothing. Optional parts
# are searched with a prior as strong as the error of the equations makes it, see `FitProblem.as_sure_as`.
_PRIOR_WEIGHT_RAD = 0.005
# The start is unknown for so long [s of a neck's time].
SETTLING_S = 0.5
_SENSOR_DELAYS = (2, 1, 3, 4)
# Those are samples of a neck.
_NECK_SAMPLE = 0.02
_TYPICAL_DRIVE_DELAY = 0.08
DECIMATION = 2
# Substeps of searches that another one refines: half the time, and on five necks and two motions fits as good.
_COARSE_SUBSTEPS = 2
# Steps of a search that starts at what a like one found.
_SHORT = 8
# Of central differences: far above rounding, far below the curvature of a number.
_STEP = 1e-4
# How much the sensor's dead time usually changes [samples].
_DELAY_SPREAD = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """All runs as arrays; the drives' dead times are known beforehand.

    runs: set-points, start, motor positions and outputs of each; payloads: [kg];
    drive_delays: (motors,) in samples; logged: whether motor positions were; numbers: searched; tendons: nothing of
    three tendons 120 deg apart; reach: largest tilt [rad]; prior: what a number a spread away from its guess counts, as
    an error [rad] of one row; substeps: of the equations in a sample.
    """

    sample_time: float
    runs: list[tuple[Matrix, Vector, Matrix, Matrix]]
    payloads: list[float]
    payload_range: tuple[float, float]
    drive_delays: Vector
    logged: bool
    numbers: tuple[Parameter, ...]
    tendons: Vector
    reach: float
    prior: float = _PRIOR_WEIGHT_RAD
    substeps: int = NECK_SUBSTEPS

    @classmethod
    def of(cls, scaled: ScaledData, drive_delays: Vector | None = None) -> FitProblem:
        recording, Ts = scaled.data, scaled.data.sample_time
        delays = np.maximum(scaled.drive_delays if drive_delays is None else drive_delays, 1.0)
        if not recording.has_motor_positions:
            delays[:] = max(round(_TYPICAL_DRIVE_DELAY / Ts), 1)
        runs = [
            (np.ascontiguousarray(run.set_points), drive_start(run), run.motor_positions, run.outputs)
            for run in recording.runs()
        ]
        across = OUT_OF_PLANE_PARAMETERS if recording.outputs.shape[1] == 1 else ()
        payloads = [payload_of(run) for run in recording.runs()]
        loads = payload_parameters(len(set(payloads)))
        numbers = (*(number for number in PARAMETERS if number.name not in across), *loads)
        reach = float(np.nanmax(np.linalg.norm(recording.outputs, axis=1)))
        return cls(
            sample_time=Ts,
            runs=runs,
            payloads=payloads,
            payload_range=(min(payloads), max(payloads)),
            drive_delays=delays,
            logged=recording.has_motor_positions,
            numbers=numbers,
            tendons=_tendons(recording.robot),
            reach=max(reach, 1e-3),
        )

    @property
    def rows(self) -> slice:
        """The rows of each run that count."""
        return slice(round(SETTLING_S / self.sample_time), None, DECIMATION)

    @property
    def has_neck_tendons(self) -> bool:
        """Whether it has three tendons 120 deg apart, whose angles can be searched."""
        return not self.tendons.size

    @property
    def has_two_outputs(self) -> bool:
        """Whether it bends in two directions."""
        return self.runs[0][3].shape[1] == 2

    @property
    def parts(self) -> tuple[str, ...]:
        """The optional parts whose numbers are searched."""
        return tuple(part for part, numbers in PARTS.items() if numbers[0] in self.numbers)

    def with_parts(self, *parts: str) -> FitProblem:
        """Return the problem with the numbers of optional parts."""
        return replace(self, numbers=(*self.numbers, *(number for part in parts for number in PARTS[part])))

    def guess(self, number: Parameter) -> float:
        """Return where the search begins: of `top_speed` at the largest one recorded, where set-points are faster."""
        if number.name != "top_speed" or not self.logged:
            return number.guess
        asked, moved = (
            max(np.nanmax(np.abs(P[2:] - P[:-2]), initial=0.0) for P in positions) / (2.0 * self.sample_time)
            for positions in zip(*((u, m) for u, _, m, _ in self.runs), strict=True)
        )
        return float(np.clip(moved, number.low, number.high)) if asked > 2.0 * moved else number.guess

    def as_sure_as(self, x: Vector, delay: float) -> FitProblem:
        """Return the problem with the prior that the error at `x` gives: of one independent row (Bayes)."""
        misses = self.misses(x, delay)
        error = np.sqrt(np.nanmean(np.concatenate(misses) ** 2) * correlation_time(misses))
        return replace(self, prior=max(float(error), _PRIOR_WEIGHT_RAD))

    def delays(self) -> tuple[int, ...]:
        """Return the sensor's dead times to try [samples], the likeliest first."""
        samples = max(_NECK_SAMPLE / self.sample_time, 1.0)  # a sensor is not faster for a robot that is
        return tuple(dict.fromkeys(round(delay * samples) for delay in _SENSOR_DELAYS))

    def decode(self, x: Vector) -> Vector:
        """Return all parameters for the search variables, then the tendons."""
        found = self._found(x)
        tendons = _displaced(found) if "angle_2" in found else self.tendons
        return np.array([*(found.get(number.name, number.guess) for number in PARAMETERS), *tendons])

    def body(self, x: Vector) -> Vector:
        """Return the numbers of the optional parts but the tendons."""
        found = self._found(x)
        return np.array([self.reach, *(found.get(n.name, NO_EFFECT[n.name]) for n in BODY_PARAMETERS)])

    def load(self, x: Vector) -> Vector:
        """Return the lowest and highest payload [kg] and their parameters; empty for one payload."""
        found = self._found(x)
        load = [found[number.name] for number in (*PAYLOAD_PARAMETERS, PAYLOAD_CURVE) if number.name in found]
        return np.array([*self.payload_range, *load]) if load else np.zeros(0)

    def _found(self, x: Vector) -> dict[str, float]:
        return {number.name: number.decode(value) for number, value in zip(self.numbers, x, strict=True)}

    def simulate(self, x: Vector, delay: float) -> list[tuple[Matrix, Matrix]]:
        """Return the motors and outputs of all runs for the search variables."""
        settle = round(SETTLING_S / self.sample_time)
        numbers, body, load = self.decode(x), self.body(x), self.load(x)
        parts = []
        for (u, start, _, y), payload in zip(self.runs, self.payloads, strict=True):
            M, Y = np.empty(u.shape), np.empty(y.shape)
            load_functions(_SIMULATION_RUNTIME).neck_run(
                loaded_neck(numbers, load, payload) if load.size else numbers,
                body,
                self.sample_time,
                self.substeps,
                self.drive_delays,
                0,
                settle,
                u,
                start,
                M,
                Y,
            )
            parts.append((M, _late(Y, delay)))
        return parts

    def misses(self, x: Vector, delay: float) -> list[Matrix]:
        """Return the errors (rows that count, outputs) of the tilts in each run."""
        rows, simulated = self.rows, self.simulate(x, delay)
        return [Y[rows] - y[rows] for (_, Y), (_, _, _, y) in zip(simulated, self.runs, strict=True)]

    def errors(self, x: Vector, delay: float) -> Vector:
        """Return the errors that are minimised: of tilts, of motors, and of the numbers against their guesses."""
        guess = np.array([number.encode(number.guess) for number in self.numbers])
        spread = np.array([number.spread for number in self.numbers])
        rows, parts = self.rows, [self.prior * (x - guess) / spread]
        for (M, Y), (_, _, m, y) in zip(self.simulate(x, delay), self.runs, strict=True):
            parts.append((Y[rows] - y[rows]).ravel())
            if self.logged:
                parts.append(_MOTOR_WEIGHT * (M[rows] - m[rows]).ravel())
        found = np.concatenate(parts)
        return found if np.isfinite(found).all() else np.nan_to_num(found, copy=False)

    def delayed(self, delay: int | None, evaluations: int, tell: SearchProgress) -> Found:
        """Return the best fit; the sensor's dead time only shifts the output, and is searched as one number."""
        # Of a robot it is asked for without optional parts and with them.
        return compute_once(lambda: self._delayed(delay, evaluations, tell), self, delay, evaluations)

    def coarse(self) -> FitProblem:
        """Return the problem with longer substeps, to begin a search."""
        return replace(self, substeps=_COARSE_SUBSTEPS)

    def _delayed(self, delay: int | None, evaluations: int, tell: SearchProgress) -> Found:
        start = np.array([number.encode(number.guess) for number in self.numbers])
        if delay is not None:
            return self.search(start, delay, evaluations, tell)
        delays = self.delays()
        found, late = self.coarse()._search(start, float(delays[0]), evaluations, tell, (min(delays), max(delays)))
        nearest = dict.fromkeys((int(np.floor(late)), int(np.ceil(late))))
        return min((self.search(found, delay, _SHORT, tell) for delay in nearest), key=lambda each: each.cost)

    def search(self, start: Vector, delay: int, evaluations: int, tell: SearchProgress) -> Found:
        """Return the numbers with the smallest error, by Levenberg-Marquardt from `start`."""
        x, _ = self._search(start, delay, evaluations, tell, None)
        e = self.errors(x, delay)
        return Found(self, x, delay, 0.5 * float(e @ e))

    def _search(
        self, start: Vector, delay: float, evaluations: int, tell: SearchProgress, delays: tuple[int, int] | None
    ) -> tuple[Vector, float]:
        n = len(self.numbers)
        low = np.array([number.encode(number.low) for number in self.numbers])
        high = np.array([number.encode(number.high) for number in self.numbers])
        scale = np.array([number.spread for number in self.numbers])
        if delays is not None:
            start, low, high = np.append(start, delay), np.append(low, delays[0]), np.append(high, delays[1])
            scale = np.append(scale, _DELAY_SPREAD)

        def errors(x: Vector) -> Vector:
            late = delay if delays is None else float(x[n])
            e = self.errors(x[:n], late)
            tell.see(0.5 * float(e @ e), x[:n], late)
            return e

        x = minimise(errors, start, Bounds(low, high, scale), evaluations)
        return x[:n], delay if delays is None else float(x[n])


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Numbers `x` that were found for a problem at a sensor's dead time [samples], and half their squared error."""

    problem: FitProblem
    x: Vector
    delay: int
    cost: float


def _late(Y: Matrix, delay: float) -> Matrix:
    """Return outputs (time, outputs) later by `delay` samples, between samples on straight lines."""
    whole = int(np.floor(delay))
    part = delay - whole
    padded = np.concatenate([np.repeat(Y[:1], whole + 1, axis=0), Y])
    late = padded[1 : 1 + len(Y)]
    return late if part == 0.0 else (1.0 - part) * late + part * padded[: len(Y)]


def _tendons(robot: Robot) -> Vector:
    """Return share, cosines and sines of the tendons for the equations; empty for three 120 deg apart."""
    axes, angles = len(robot.outputs.names), robot.directions.angles_for(robot.outputs.names)
    if axes == 2 and len(angles) == 3 and np.allclose(np.mod(angles, 360.0), [0.0, 120.0, 240.0]):
        return np.zeros(0)
    weights = robot.weights()
    e = np.zeros((2, len(robot.motors.names)))
    e[:axes] = 0.0 if weights is None else weights
    largest = float(np.linalg.norm(e, 2)) ** 2
    return np.concatenate([[min(largest / e.shape[1], 1.0)], e.ravel()])


def _displaced(found: Mapping[str, float]) -> Vector:
    """Return share, cosines and sines, times the arms, of three tendons that are not where they should be."""
    angles = np.radians([0.0, 120.0, 240.0]) + np.array([0.0, found["angle_2"], found["angle_3"]])
    e = np.array([1.0, found["arm_2"], found["arm_3"]]) * np.array([np.cos(angles), np.sin(angles)])
    return np.concatenate([[np.linalg.eigvalsh(e @ e.T)[-1] / 3.0], e.ravel()])


class SearchProgress:
    """Reports the search, and remembers the best for Ctrl-C."""

    def __init__(self, progress: Progress, expected: int) -> None:
        self.progress, self.expected, self.calls = progress, expected, 0
        self.what = ""
        self.best: tuple[float, Vector, float] | None = None

    def see(self, cost: float, x: Vector, delay: float) -> None:
        """Take note of one evaluation."""
        self.calls += 1
        if self.best is None or cost < self.best[0]:
            self.best = (cost, x.copy(), delay)
        if self.calls % 20 == 1:
            self.progress(min(self.calls / self.expected, 0.99), f"{self.what}, loss {self.best[0]:.4g}")


def slopes(problem: FitProblem, x: Vector, delay: float) -> Matrix:
    """Return the derivatives (n, errors) of the errors by the search variables, by central differences."""
    moves = _STEP * np.eye(x.size)
    ends = side_by_side([partial(problem.errors, at, delay) for at in (*(x + moves), *(x - moves))])
    return (np.array(ends[: x.size]) - np.array(ends[x.size :])) / (2.0 * _STEP)


def intervals(problem: FitProblem, x: Vector, delay: int) -> list[dict]:
    """Return each number with unit, 95 % interval (linearised, the errors' colour taken into account) and range."""
    e, J = problem.errors(x, delay), slopes(problem, x, delay)
    covariance = (
        np.linalg.pinv(J @ J.T) * float(e @ e) / max(e.size - x.size, 1) * correlation_time(problem.misses(x, delay))
    )
    half = 1.96 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = []
    for i, number in enumerate(problem.numbers):
        value, low, high = (number.decode(x[i] + shift) for shift in (0.0, -half[i], half[i]))
        at_bound = min(value - number.low, number.high - value) < 1e-3 * (number.high - number.low) * 0.01
        rows.append(
            {
                "name": number.name, "unit": number.unit, "value": value,
                "low": max(low, number.low), "high": min(high, number.high),
                "at_bound": bool(at_bound), "about": number.about,
            }
        )  # fmt: skip
    return rows


def correlation_time(errors: Sequence[Matrix]) -> float:
    """Return the rows of one independent error: `1 + 2 sum r(k)` to the first zero of r."""
    e = np.nan_to_num(np.concatenate(errors))[:, 0]
    e = e - e.mean()
    power = max(float(e @ e), 1e-300)
    total = 1.0
    for lag in range(1, min(250, e.size - 1)):
        r = float(e[lag:] @ e[:-lag]) / power
        if r <= 0.0:
            break
        total += 2.0 * r
    return total
