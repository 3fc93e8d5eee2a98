"""Kind `greybox`: the equations of a tendon-driven neck with unknown numbers, fitted by the error of its simulation.

Rates and dead times are in the time of a neck. Several payloads tell how stiffness and pretension go with them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, FileFormatError, Matrix, Progress, Vector, one_blas_thread, require_whole, silent
from softneck.plant import require_tendons
from softneck.robot import Robot
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._arrays import MOST_PAYLOAD, memory_array, within
from ..models._drive import drive_start, fit_noise_model
from ..models._fitting import ScaledData, payload_of, training_recording
from ..models._linear_systems import history_array
from ..models._model import Model
from ._loaded_greybox_runtime import loaded_neck

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of the neck's equations, searched between `low` and `high`, by its logarithm where `positive`.

    unit: SI, lengths of tendon and tensions in radians of motor; guess: start, for a neck of 0.1 m with winches of 7.5
    mm; spread: of the weak prior around it, of the logarithm where `positive`.
    """

    name: str
    unit: str
    guess: float
    low: float
    high: float
    spread: float
    positive: bool
    about: str

    @property
    def is_rate(self) -> bool:
        """Whether it is by the second."""
        return self.unit in ("1/s", "1/(rad s)", "1/(rad^2 s)", "1/(s kg)")

    def encode(self, value: float) -> float:
        """Return the search variable of a value."""
        return float(np.log(value)) if self.positive else value

    def decode(self, value: float) -> float:
        """Return the value of a search variable."""
        return float(np.exp(value)) if self.positive else value


PARAMETERS = (
    Parameter("drive_rate", "1/s", 10.0, 1.0, 80.0, 1.0, True, "position loop of the drives"),
    Parameter("pretension", "rad", 0.3, 0.01, 5.0, 1.0, True, "stretch of each tendon at rest"),
    Parameter("pull_limit", "rad", 0.6, 0.05, 50.0, 1.0, True, "stretch at which a drive stalls"),
    Parameter("lever", "rad/rad", 7.0, 0.5, 40.0, 0.5, True, "radius of the tendons over radius of the winch"),
    Parameter("gain", "1/(rad s)", 10.0, 0.05, 500.0, 1.0, True, "tension to rate of bending"),
    Parameter("stiffness", "1/s", 10.0, 0.05, 500.0, 1.0, True, "of the link against bending"),
    Parameter("stiffening", "1/(rad^2 s)", 3.0, 0.0, 300.0, 10.0, False, "cubic term of the stiffness"),
    Parameter("asymmetry", "1", 0.0, -0.5, 0.5, 0.1, False, "stiffness is (1 + this) in pitch, (1 - this) in roll"),
    Parameter("rest_pitch", "rad", 0.0, -0.3, 0.3, 0.1, False, "bend of the link without tendons"),
    Parameter("rest_roll", "rad", 0.0, -0.3, 0.3, 0.1, False, "bend of the link without tendons"),
    Parameter("compliance", "1", 3.0, 0.001, 50.0, 1.0, True, "compression per sum of the tensions"),
    Parameter("axial_rate", "1/s", 20.0, 0.5, 300.0, 1.0, True, "rate of compression"),
    Parameter("friction", "1/s", 0.3, 0.0, 300.0, 30.0, False, "hysteresis against bending"),
    Parameter("friction_angle", "rad", 0.05, 0.003, 1.0, 1.0, True, "bend over which the hysteresis builds up"),
    Parameter("twist", "rad", 0.0, -0.5, 0.5, 0.1, False, "turn of the tendons against the inclinometer"),
    Parameter("sensor_rate", "1/s", 40.0, 2.0, 300.0, 1.0, True, "lag of the inclinometer"),
)


# What a payload changes, where the recordings have several; of a kilogram as much as the numbers themselves are.
PAYLOAD_PARAMETERS = (
    Parameter("payload_stiffness", "1/(s kg)", -3.0, -60.0, 60.0, 10.0, False, "what a payload adds to the stiffness"),
    Parameter("payload_pretension", "rad/kg", -0.2, -5.0, 5.0, 1.0, False, "what a payload adds to the pretension"),
)

# Those that have no meaning where the link bends in one plane.
OUT_OF_PLANE_PARAMETERS = ("asymmetry", "rest_roll", "twist")

_SIMULATION_RUNTIME = "softneck.identification.structured._neck_equations_runtime"
# An error of a motor counts as much as one of the tilt twenty times smaller: about the ratio of their ranges.
_MOTOR_WEIGHT = 0.05
# How much a number a spread away from its guess counts, as an error [rad] of one row: next to nothing.
_PRIOR_WEIGHT_RAD = 0.005
# The start is unknown for so long [s of a neck's time], a held input is forgotten after so long.
_SETTLING_S, _MEMORY_S = 0.5, 3.0
_SENSOR_DELAYS = (2, 1, 3, 4)
# Those are samples of a neck.
_NECK_SAMPLE = 0.02
_TYPICAL_DRIVE_DELAY = 0.08
_DECIMATION = 2
_NOISE_ORDER = 8
INTERRUPTED = "the fit was interrupted; these are the best numbers until then"


@dataclass(frozen=True, slots=True, kw_only=True)
class GreyBox:
    """Tendon kinematics, slack, hysteresis, stalling drives, lag and dead time; 16 numbers, by output error.

    The equations are in `_neck_equations_runtime`; findings hold each number with its unit and 95 % confidence. Where
    the recordings' channel `payload` has several values, two more say what it changes.

    Attributes:
        evaluations: at most so many steps of Gauss-Newton for each dead time.
        sensor_delay: dead time of the inclinometer in samples; None tries 1 to 4, of a slower robot as
            many more.
    """

    evaluations: int = 40
    sensor_delay: int | None = None

    def __post_init__(self) -> None:
        require_whole("evaluations", self.evaluations, 1, 10_000)
        if self.sensor_delay is not None:
            require_whole("sensor_delay", self.sensor_delay, 0, 100)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify the numbers; Ctrl-C keeps the best so far.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            progress: called with the part done and the error.

        Raises:
            DataError: too short or constant, or a payload that changes within a run or that no neck bears.
            SettingsError: a robot that no tendons on winches bend.
        """
        recording = training_recording(recordings)
        require_tendons(recording.robot, "kind `greybox`")
        scaled = ScaledData.of(recording, amplitudes=False)  # the equations are in rad
        problem = _FitProblem.of(scaled)
        delays = problem.delays() if self.sensor_delay is None else (self.sensor_delay,)
        best: tuple[float, int, Vector] | None = None
        start = np.array([number.encode(number.guess) for number in problem.numbers])
        interrupted = False
        tell = _SearchProgress(progress, len(delays) * self.evaluations * (len(start) + 1))
        for delay in delays:
            tell.what = f"dead time {delay}"
            try:
                found = problem.search(start, delay, self.evaluations, tell)
            except KeyboardInterrupt:
                interrupted = True
                if tell.best is not None and (best is None or tell.best[0] < best[0]):
                    best = (tell.best[0], delay, tell.best[1])
                break
            if best is None or found.cost < best[0]:
                best = (float(found.cost), delay, found.x)
                start = found.x
        if best is None or not np.isfinite(best[0]):
            raise DataError("no numbers of the grey box give a finite error; look for wild values in the recording.")
        model = _model(self, problem, scaled, best[1], best[2])
        progress(1.0, "done")
        if interrupted:
            return replace(model, findings={**model.findings, "interrupted": INTERRUPTED})
        return model


@dataclass(frozen=True, slots=True, eq=False)
class _FitProblem:
    """All runs as arrays; the drives' dead times are known beforehand.

    runs: set-points, start, motor positions and outputs of each; payloads: [kg]; drive: (motors, 2) pole and delay;
    logged: whether motor positions were; numbers: searched; tendons: nothing of three tendons 120 deg apart.
    """

    sample_time: float
    runs: list[tuple[Matrix, Vector, Matrix, Matrix]]
    payloads: list[float]
    drive: Matrix
    logged: bool
    numbers: tuple[Parameter, ...]
    tendons: Vector

    @classmethod
    def of(cls, scaled: ScaledData) -> _FitProblem:
        recording, drive, Ts = scaled.data, scaled.drive.drive.copy(), scaled.data.sample_time
        if not recording.has_motor_positions:
            drive[:, 1] = max(round(_TYPICAL_DRIVE_DELAY / Ts), 1)
        drive[:, 1] = np.maximum(drive[:, 1], 1.0)
        runs = [
            (np.ascontiguousarray(run.set_points), drive_start(run), run.motor_positions, run.outputs)
            for run in recording.runs()
        ]
        across = OUT_OF_PLANE_PARAMETERS if recording.outputs.shape[1] == 1 else ()
        payloads = [payload_of(run) for run in recording.runs()]
        loads = PAYLOAD_PARAMETERS if len(set(payloads)) > 1 else ()
        numbers = (*(number for number in PARAMETERS if number.name not in across), *loads)
        return cls(Ts, runs, payloads, drive, recording.has_motor_positions, numbers, _tendons(recording.robot))

    def delays(self) -> tuple[int, ...]:
        """Return the sensor's dead times to try [samples], the likeliest first."""
        samples = max(_NECK_SAMPLE / self.sample_time, 1.0)  # a sensor is not faster for a robot that is
        return tuple(dict.fromkeys(round(delay * samples) for delay in _SENSOR_DELAYS))

    def decode(self, x: Vector) -> Vector:
        """Return all parameters for the search variables, then the tendons."""
        found = self._found(x)
        return np.array([*(found.get(number.name, number.guess) for number in PARAMETERS), *self.tendons])

    def load(self, x: Vector) -> Vector:
        """Return the lowest and highest payload [kg] and their parameters; empty for one payload."""
        found = [self._found(x)[number.name] for number in PAYLOAD_PARAMETERS if number in self.numbers]
        return np.array([min(self.payloads), max(self.payloads), *found]) if found else np.zeros(0)

    def _found(self, x: Vector) -> dict[str, float]:
        return {number.name: number.decode(value) for number, value in zip(self.numbers, x, strict=True)}

    def simulate(self, x: Vector, delay: int) -> list[tuple[Matrix, Matrix]]:
        """Return the motors and outputs of all runs for the search variables."""
        settle = round(_SETTLING_S / self.sample_time)
        numbers, load = self.decode(x), self.load(x)
        parts = []
        for (u, start, _, y), payload in zip(self.runs, self.payloads, strict=True):
            M, Y = np.empty(u.shape), np.empty(y.shape)
            load_functions(_SIMULATION_RUNTIME).neck_run(
                loaded_neck(numbers, load, payload) if load.size else numbers,
                self.sample_time,
                self.drive[:, 1],
                delay,
                settle,
                u,
                start,
                M,
                Y,
            )
            parts.append((M, Y))
        return parts

    def errors(self, x: Vector, delay: int) -> Vector:
        """Return the errors that are minimised: of tilts, of motors, and of the numbers against their guesses."""
        skip = round(_SETTLING_S / self.sample_time)
        guess = np.array([number.encode(number.guess) for number in self.numbers])
        spread = np.array([number.spread for number in self.numbers])
        parts = [_PRIOR_WEIGHT_RAD * (x - guess) / spread]
        for (M, Y), (_, _, m, y) in zip(self.simulate(x, delay), self.runs, strict=True):
            parts.append((Y - y)[skip::_DECIMATION].ravel())
            if self.logged:
                parts.append(_MOTOR_WEIGHT * (M - m)[skip::_DECIMATION].ravel())
        return np.nan_to_num(np.concatenate(parts))

    def search(self, start: Vector, delay: int, evaluations: int, tell: _SearchProgress) -> OptimizeResult:
        """Return scipy's result of a trust-region Gauss-Newton from `start`."""
        from scipy.optimize import least_squares

        low = np.array([number.encode(number.low) for number in self.numbers])
        high = np.array([number.encode(number.high) for number in self.numbers])

        def errors(x: Vector) -> Vector:
            e = self.errors(x, delay)
            tell.see(0.5 * float(e @ e), x)
            return e

        inside = np.clip(start, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
        return least_squares(errors, inside, bounds=(low, high), x_scale="jac", max_nfev=evaluations, xtol=1e-5)


def _tendons(robot: Robot) -> Vector:
    """Return share, cosines and sines of the tendons for the equations; empty for three 120 deg apart."""
    axes, angles = len(robot.outputs.names), robot.directions.angles_deg
    if axes == 2 and len(angles) == 3 and np.allclose(np.mod(angles, 360.0), [0.0, 120.0, 240.0]):
        return np.zeros(0)
    weights = robot.directions.weights()
    e = np.zeros((2, len(robot.motors.names)))
    e[:axes] = 0.0 if weights is None else weights[:axes]
    largest = float(np.linalg.norm(e, 2)) ** 2
    return np.concatenate([[min(largest / e.shape[1], 1.0)], e.ravel()])


class _SearchProgress:
    """Reports the search, and remembers the best for Ctrl-C."""

    def __init__(self, progress: Progress, expected: int) -> None:
        self.progress, self.expected, self.calls = progress, expected, 0
        self.what = ""
        self.best: tuple[float, Vector] | None = None

    def see(self, cost: float, x: Vector) -> None:
        """Take note of one evaluation."""
        self.calls += 1
        if self.best is None or cost < self.best[0]:
            self.best = (cost, x.copy())
        if self.calls % 20 == 1:
            self.progress(min(self.calls / self.expected, 0.99), f"{self.what}, loss {self.best[0]:.4g}")


def _model(settings: GreyBox, problem: _FitProblem, scaled: ScaledData, delay: int, x: Vector) -> Model:
    numbers, load, outputs = problem.decode(x), problem.load(x), scaled.data.outputs.shape[1]
    skip = round(_SETTLING_S / problem.sample_time)
    errors = [y - Y for (_, Y), (_, _, _, y) in zip(problem.simulate(x, delay), problem.runs, strict=True)]
    for error in errors:
        error[:skip] = np.nan
    echo = np.array([fit_noise_model([error[:, axis] for error in errors], _NOISE_ORDER) for axis in range(outputs)])
    pole = np.exp(-numbers[0] * problem.sample_time)
    drive = np.column_stack([np.full(len(problem.drive), pole), problem.drive[:, 1]])
    arrays = {
        "history": history_array(int(max(_NOISE_ORDER, drive[:, 1].max())), outputs),
        "drive": drive,
        "neck": numbers,
        "sensor": np.array([float(delay), problem.sample_time]),
        "echo": echo,
        "memory": memory_array(_MEMORY_S, problem.sample_time),
        **({"payload": load} if load.size else {}),
    }
    table = _table(problem, x, delay, errors)
    for number, row in zip(problem.numbers, table, strict=True):
        if number.is_rate:
            row |= {key: scaled.scaling.second**-1 * row[key] for key in ("value", "low", "high")}
    findings = {"sensor_delay": delay, "numbers": table}
    return scaled.model("greybox", settings, lambda arrays, _: dict(arrays), arrays=arrays, findings=findings)


def _table(problem: _FitProblem, x: Vector, delay: int, errors: Sequence[Matrix]) -> list[dict]:
    """Return each number with unit, 95 % interval (linearised, the errors' colour taken into account) and range."""
    J = np.empty((problem.errors(x, delay).size, x.size))
    for i in range(x.size):
        # A ten-thousandth of a number: far above rounding, far below its curvature.
        step = np.zeros(x.size)
        step[i] = 1e-4
        J[:, i] = (problem.errors(x + step, delay) - problem.errors(x - step, delay)) / 2e-4
    e = problem.errors(x, delay)
    covariance = np.linalg.pinv(J.T @ J) * float(e @ e) / max(e.size - x.size, 1) * _correlation_time(errors)
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


def _correlation_time(errors: Sequence[Matrix]) -> float:
    """Return the samples of one independent error: `1 + 2 sum r(k)` to the first zero of r."""
    e = np.nan_to_num(np.concatenate(errors))[:, 0]
    e = e - e.mean()
    power = max(float(e @ e), 1e-300)
    total = 1.0
    for lag in range(1, min(500, e.size - 1)):
        r = float(e[lag:] @ e[:-lag]) / power
        if r <= 0.0:
            break
        total += 2.0 * r
    return total / _DECIMATION if total > _DECIMATION else 1.0


def check_greybox(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
    within(arrays["drive"][:, 1], 1, sizes["H"], "a drive's delay")
    within(arrays["sensor"][:1], 0, 1000, "the sensor's dead time")
    if "payload" in arrays:
        _check_payload(arrays["payload"])
    numbers, tendons = np.split(arrays["neck"], [len(PARAMETERS)])
    neck = (sizes["motors"], sizes["outputs"]) == (3, 2) and not tendons.size
    if not neck and tendons.size != 1 + 2 * sizes["motors"]:
        raise FileFormatError(f"its array `neck` has {arrays['neck'].size} numbers, which do not fit its tendons.")
    if np.abs(tendons).max(initial=0.0) > 1.0 or not (tendons[:1] > 0.0).all():
        raise FileFormatError("the directions of its tendons in its array `neck` are not of length 1.")
    for number, value in zip(PARAMETERS, numbers, strict=True):
        # A thousandth for the rounding of logarithms.
        margin = 1e-3 * max(abs(number.low), abs(number.high))
        if not number.low - min(margin, 0.1 * abs(number.low)) <= value <= number.high + margin:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")


def _check_payload(load: Matrix) -> None:
    least, most = load[:2]
    if not 0.0 <= least <= most <= MOST_PAYLOAD:
        raise FileFormatError(f"its payloads from {least:g} to {most:g} kg are not between 0 and {MOST_PAYLOAD:g}.")
    for number, value in zip(PAYLOAD_PARAMETERS, load[2:], strict=True):
        if not number.low <= value <= number.high:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")
