"""Recursive least squares over the redefined inputs or the motors, with dead time (section 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    ReprMixin,
    SettingsError,
    Vector,
    finite_vector,
    one_blas_thread,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._drive import fit_drive
from ..models._fitting import MAX_DELAY, ScaledData, delay_samples, free_run_fit, training_recording
from ..models._linear_systems import lss_arrays, varx_system
from ..models._model import WARM_UP, Model
from ..models._scores import nrmse_fit
from ._regression import (
    arx_rows,
    axis_arrays,
    check_delays,
    functions_found,
    linear_in_si,
    require_excitation,
    with_offset,
)

_UD_RUNTIME = "softneck.identification.linear._ud_runtime"
# Start of F. In U D U' it costs no digits, and biases a result by less than 1e-12 over the regressors' information.
EXACT_START = 1e12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class RecursionState(ReprMixin):
    """Parameters theta (n,) and F = U D U' with U' = `factor` (n, n) + I and D = `scale` (n,).

    tally: (4,) number of rows and their squared errors (both forgotten with lambda), dead-zone rows, projections.
    """

    theta: Vector
    factor: Matrix
    scale: Vector
    tally: Vector

    @property
    def covariance(self) -> Matrix:
        """F (n, n) of Eq. 29."""
        U = self.factor.T + np.eye(self.theta.size)
        return (U * self.scale) @ U.T

    @property
    def noise_std(self) -> float:
        """Standard deviation of the equation error."""
        free = self.tally[0] - self.theta.size
        return float(np.sqrt(max(self.tally[1], 0.0) / free)) if free > 0 else float("nan")

    @property
    def parameter_std(self) -> Vector:
        """(n,) standard deviations of `theta` if the equation error is white (Ljung 1999, sec. 9.2)."""
        return self.noise_std * np.sqrt(np.diag(self.covariance))

    def summary(self) -> str:
        """Return the parameters with their standard deviations."""
        pairs = zip(self.theta, self.parameter_std, strict=True)
        return "recursion: " + ", ".join(f"{value:.6g} +- {std:.2g}" for value, std in pairs)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RecursionHistory:
    """Error (rows,) of Eq. 30 before each update, and parameters and diagonal of F (rows, n) after it."""

    error: Vector
    theta: Matrix
    covariance: Matrix


@dataclass(frozen=True, slots=True, kw_only=True)
class Recursion:
    """Recursive least squares (Eq. 28-30) in Bierman's form, with forgetting and safeguards.

    Attributes:
        parameters: n, length of theta.
        forgetting: lambda in (0, 1]; 1 is Eq. 29, below it is CFF-RLS.
        covariance_bound: on the trace of F; without excitation and with forgetting F grows exponentially (to 1e30
            within minutes at 0.99). 0 for none.
        dead_zone: errors up to this size [unit of y] change nothing.
        poles: number of the first parameters that are a_1, a_2, ... of Eq. 23, kept stable (a step is halved); 0: none.
        start_covariance: diagonal of F(0).
    """

    parameters: int
    forgetting: float = 1.0
    covariance_bound: float = 0.0
    dead_zone: float = 0.0
    poles: int = 0
    start_covariance: float = EXACT_START

    def __post_init__(self) -> None:
        require_whole("parameters", self.parameters, 1, 10_000)
        require_forgetting(self.forgetting)
        require_between("covariance_bound", self.covariance_bound, 0.0, 1e300)
        require_between("dead_zone", self.dead_zone, 0.0, 1e300)
        require_whole("poles", self.poles, 0, self.parameters)
        require_positive("start_covariance", self.start_covariance)

    def initial_state(self, theta: ArrayLike | None = None) -> RecursionState:
        """Return the state before any row, from `theta` (n,) or zero."""
        n = self.parameters
        start = self.start_covariance
        if self.covariance_bound > 0.0:
            start = min(start, self.covariance_bound / n)
        return RecursionState(
            theta=np.zeros(n) if theta is None else finite_vector("theta", theta, n).copy(),
            factor=np.zeros((n, n)),
            scale=np.full(n, start),
            tally=np.zeros(4),
        )

    def step(self, state: RecursionState, phi: ArrayLike, y: float) -> RecursionState:
        """Update by one row, regressor `phi` (n,) and output `y`; a NaN in either skips the row."""
        row = np.ascontiguousarray(phi, dtype=np.float64).reshape(1, -1)
        return self.run(state, row, np.array([y], dtype=np.float64))[0]

    def run(
        self, state: RecursionState, regressors: Matrix, targets: Vector, *, keep: bool = False
    ) -> tuple[RecursionState, RecursionHistory]:
        """Update by regressors (rows, n) and targets (rows,); return the state and, with `keep`, the history."""
        Phi = np.ascontiguousarray(regressors, dtype=np.float64)
        y = np.ascontiguousarray(targets, dtype=np.float64)
        if Phi.ndim != 2 or Phi.shape[1] != self.parameters or y.shape != (len(Phi),):
            raise DataError(
                f"`regressors` must be (rows, {self.parameters}) and `targets` (rows,); got {Phi.shape} and {y.shape}."
            )
        there = np.isfinite(Phi).all(axis=1) & np.isfinite(y)
        if not there.all():
            Phi, y = np.ascontiguousarray(Phi[there]), y[there]
        after = RecursionState(
            theta=state.theta.copy(), factor=state.factor.copy(), scale=state.scale.copy(), tally=state.tally.copy()
        )
        n = self.parameters
        history = np.zeros((len(y) if keep else 0, 1 + 2 * n))
        guards = np.array([self.forgetting, self.covariance_bound, self.dead_zone, self.poles, 1.0])
        load_functions(_UD_RUNTIME).ud_guarded(
            Phi, y, after.theta, after.factor, after.scale, guards, after.tally, history
        )
        if not np.isfinite(after.theta).all():
            raise DataError("the recursion is no longer finite; scale the regressors to the order of one.")
        return after, RecursionHistory(error=history[:, 0], theta=history[:, 1 : 1 + n], covariance=history[:, 1 + n :])


def require_forgetting(value: float) -> None:
    """Raise SettingsError unless `value` is in (0, 1]."""
    require_positive("forgetting", value)
    if value > 1.0:
        raise SettingsError(f"`forgetting` must be above 0 and at most 1, where 1 means no forgetting; got {value:g}.")


STRUCTURES = ("siso", "miso", "mimo")
Curve = list[list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rls:
    """ARX model of each axis by recursive least squares (Eq. 23-30) over theta_i and phi_i (Eq. 9, 10).

    Attributes:
        na, nb: orders of Eq. 23.
        delay: dead time [s]; None takes that of the best simulation of the training rows.
        max_delay: end of the search [s]; None: one and a half time constants of the robot (of a neck 0.3 s).
        forgetting: lambda in (0, 1]; 1 for Eq. 29, below for a constant forgetting factor (CFF-RLS).
        structure: "siso" over theta_i and phi_i, "miso" (each output from the three motors and its own past) or
            "mimo" (from the three motors and both pasts).
        covariance_bound: on the trace of F where `forgetting` is below 1; 0 for none.
    """

    na: int = 1
    nb: int = 1
    delay: float | None = None
    max_delay: float | None = None
    forgetting: float = 1.0
    structure: str = "siso"
    covariance_bound: float = 1e8

    def __post_init__(self) -> None:
        # 100 samples are 2 s at 20 ms, ten time constants of a neck.
        require_whole("na", self.na, 1, 100)
        require_whole("nb", self.nb, 1, 100)
        check_delays(self.delay, self.max_delay)
        require_forgetting(self.forgetting)
        require_one_of("structure", self.structure, STRUCTURES)
        require_between("covariance_bound", self.covariance_bound, 0.0, 1e15)

    def _recursion(self, parameters: int) -> Recursion:
        return Recursion(
            parameters=parameters,
            forgetting=self.forgetting,
            covariance_bound=self.covariance_bound if self.forgetting < 1.0 else 0.0,
            start_covariance=EXACT_START,
        )

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify each output from its redefined input (of a neck theta_i, phi_i), or all from the motors.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            progress: called with the part done and a word.

        Raises:
            DataError: too short, constant, without two usable rows, or not enough excitation.
        """
        scaled = ScaledData.of(training_recording(recordings))
        settings = replace(self, delay=scaled.seconds(self.delay), max_delay=scaled.longest_delay(self.max_delay))
        fit = settings._fit_siso if self.structure == "siso" else settings._fit_motors
        arrays, findings = fit(scaled, progress)
        if scaled.has_offset:
            arrays = with_offset("rls", arrays, scaled.data)
        units = zip(findings["delay_curve"].items(), scaled.scaling.output_unit, strict=True)
        findings["delay_curve"] = {
            name: [[scaled.scaling.unscale_seconds(d), fit, unit * rms] for d, fit, rms in curve]
            for (name, curve), unit in units
        }
        progress(1.0, "done")
        findings = {"delay_criterion": "free_run", **findings}
        return scaled.model("rls", self, linear_in_si, arrays=arrays, findings=findings)

    def _fit_siso(self, scaled: ScaledData, progress: Progress) -> tuple[dict[str, Matrix], dict]:
        drive, directions, gains = fit_drive(scaled.data), scaled.directions, scaled.gains
        runs = [(run.outputs, np.asarray(run.set_points @ directions.redefinition.T)) for run in scaled.data.runs()]
        thetas, delays, stds, numbers = [], [], [], []
        curves: dict[str, Curve] = {}
        for axis, name in enumerate(directions.names):
            progress(axis / len(directions.names), name)
            one: list[tuple[Matrix, Matrix]] = [(Y[:, [axis]], U[:, [axis]]) for Y, U in runs]
            d, theta, std, curves[name], number = self._search(scaled.data.sample_time, one, name)
            thetas.append(theta)
            delays.append(d)
            stds.append((std * np.repeat([1.0, gains[axis]], [self.na, self.nb])).tolist())
            numbers.append(number)
        found = {"delay_curve": curves, "condition_number": numbers, "parameter_std": stds}
        a, b = (np.array(part) for part in np.split(np.array(thetas), [self.na], axis=1))
        if scaled.has_offset:
            found |= functions_found(scaled, [*a], [*b], delays)
            spread = [
                np.concatenate([theta[: self.na], np.outer(weights, theta[self.na :]).ravel()])
                for theta, weights in zip(thetas, directions.weights, strict=True)
            ]
            return motor_arrays(replace(self, structure="miso"), spread, delays, drive.array), found
        return axis_arrays(directions.redefinition, drive, a, b, delays), found

    def _search(
        self, sample_time: float, runs: list[tuple[Matrix, Matrix]], name: str
    ) -> tuple[int, Vector, Vector, Curve, float]:
        """Return delay [samples], theta, its std, cost curve (delay [s], simulation fit [%], one-step rms), cond."""
        best: tuple[float, int, Vector, Vector, float] | None = None
        curve: Curve = []
        for d in delay_samples(self.delay, self.max_delay or MAX_DELAY, sample_time, runs):
            theta, std, one_step, number = self._least_squares(runs, d, name)
            free = free_run_fit(runs, theta[: self.na], theta[self.na :].reshape(-1, self.nb), d)
            curve.append([d * sample_time, free, one_step])
            if best is None or -free < best[0]:
                best = (-free, d, theta, std, number)
        if best is None or not np.isfinite(best[0]):
            raise DataError(
                f"no dead time gives a stable one-step model of {name}; record with more excitation or set `delay`."
            )
        return best[1], best[2], best[3], curve, best[4]

    def _least_squares(
        self, runs: list[tuple[Matrix, Matrix]], d: int, name: str
    ) -> tuple[Vector, Vector, float, float]:
        """Return theta, its standard deviation, the one-step rms and the condition number."""
        Phi, Y = arx_rows(runs, self.na, self.nb, d)
        y = np.ascontiguousarray(Y[:, 0])
        number = require_excitation(name, Phi)
        recursion = self._recursion(Phi.shape[1])
        state, _ = recursion.run(recursion.initial_state(), Phi, y)
        theta = state.theta
        rms = float(np.sqrt(np.mean((y - Phi @ theta) ** 2)))
        free = max(y.size - theta.size, 1)
        return theta, rms * np.sqrt(y.size / free * np.diag(state.covariance)), rms, number

    def _fit_motors(self, scaled: ScaledData, progress: Progress) -> tuple[dict[str, Matrix], dict]:
        """Fit all outputs over the motors; "miso" takes a dead time each, "mimo" one for all."""
        recording = scaled.data
        drive = fit_drive(recording).array
        Ts = recording.sample_time
        # Of motors that never moved by themselves, such as tendons in pairs, only the motions that were made are known.
        motors, T = recording.set_points.shape[1], scaled.directions.all_inputs(recording.set_points)
        T = T if len(T) < motors else np.eye(motors)
        runs = [(run.outputs, run.set_points @ T.T) for run in recording.runs()]

        def over_motors(theta: Vector) -> Vector:
            own, inputs = np.split(theta, [theta.size - len(T) * self.nb])
            return np.concatenate([own, (T.T @ inputs.reshape(len(T), self.nb)).ravel()])

        names = recording.robot.outputs.names
        if self.structure == "miso":
            found = []
            for axis, name in enumerate(names):
                progress(axis / len(names), name)
                found.append(self._search(Ts, [(Y[:, [axis]], U) for Y, U in runs], name))
            delays = [d for d, *_ in found]
            arrays = motor_arrays(self, [over_motors(theta) for _, theta, *_ in found], delays, drive)
            curves = {name: curve for name, (*_, curve, _) in zip(names, found, strict=True)}
            return arrays, {"delay_curve": curves, "condition_number": [number for *_, number in found]}
        best, curves = None, {name: [] for name in names}
        # The regressors of each output take its own past first.
        orders = [[axis, *(other for other in range(len(names)) if other != axis)] for axis in range(len(names))]
        delays = delay_samples(self.delay, self.max_delay or MAX_DELAY, Ts, runs)
        for step, d in enumerate(delays):
            progress(step / len(delays), f"{1e3 * d * Ts:.0f} ms")
            both = [
                self._least_squares([(Y[:, order], U) for Y, U in runs], d, name)
                for order, name in zip(orders, names, strict=True)
            ]
            arrays = motor_arrays(self, [over_motors(theta) for theta, *_ in both], [d] * len(names), drive)
            fits = _simulation_fits(Model(kind="rls", sample_time=Ts, arrays=arrays, robot=recording.robot), recording)
            for name, fit, (_, _, rms, _) in zip(names, fits, both, strict=True):
                curves[name].append([d * Ts, fit, rms])
            cost = -sum(fits)
            if best is None or cost < best[0]:
                best = (cost, arrays, [number for *_, number in both])
        if best is None or not np.isfinite(best[0]):
            raise DataError("no dead time gives a stable model of both outputs; record more or set `delay`.")
        return best[1], {"delay_curve": curves, "condition_number": best[2]}


def motor_arrays(settings: Rls, thetas: list[Vector], delays: list[int], drive: Matrix) -> dict[str, Matrix]:
    """Return the runtime's arrays of parameters over the motors, with one vector for each output."""
    na, nb, common = settings.na, settings.nb, min(delays)
    p = max(na, nb + max(delays) - common)
    outputs, motors = len(thetas), len(drive)
    A, B = np.zeros((p, outputs, outputs)), np.zeros((p, outputs, motors))
    for axis, (theta, d) in enumerate(zip(thetas, delays, strict=True)):
        A[:na, axis, axis] = theta[:na]
        rest = theta[na:]
        if settings.structure == "mimo":
            for other in (other for other in range(outputs) if other != axis):
                A[:na, axis, other] = rest[:na]
                rest = rest[na:]
        late = d - common
        B[late : late + nb, axis] = rest.reshape(motors, nb).T
    return lss_arrays(varx_system(A, B), delay=common, drive=drive, history=p + common)


def _simulation_fits(model: Model, recording: Recording) -> list[float]:
    """Return the simulation fits [%] of all outputs; -inf where the model is unstable."""
    axes = range(recording.outputs.shape[1])
    if np.abs(np.linalg.eigvals(model.arrays["A"])).max() >= 1.0:
        return [-np.inf for _ in axes]
    simulated = model.simulate(recording)
    starts = np.concatenate([np.arange(len(run)) for run in recording.runs()]) >= WARM_UP
    return [nrmse_fit(recording.outputs[starts, axis], simulated[starts, axis]) for axis in axes]
