"""Recursive least squares over the redefined inputs or the motors, with dead time (section 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.runtime import load_functions
from softneck.signals import TENDON_ANGLES, Recording, redefine, redefinition_matrix

from ..models._directions import Directions, directions_of
from ..models._drive import fit_drive
from ..models._fitting import delay_samples, fitted_model, free_run_fit, training_recording
from ..models._model import WARM_UP, Model
from ..models._scores import nrmse_fit
from ..models._state_space import lss_arrays, varx_system
from ._operating_point import about, operating_point, with_offset
from ._recursion import EXACT_START, Recursion, require_forgetting
from ._regression import arx_rows, require_excitation

_UD = "softneck.identification.linear._ud_runtime"
STRUCTURES = ("siso", "miso", "mimo")
Curve = list[list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rls:
    """ARX model of each axis by recursive least squares (Eq. 23-30) over theta_i and phi_i (Eq. 9, 10).

    Attributes:
        na, nb: orders of Eq. 23.
        delay: dead time [s]; None takes that of the best simulation of the training rows.
        max_delay: end of the search [s], of another robot by its time constant over the neck's 0.2 s.
        forgetting: lambda in (0, 1]; 1 for Eq. 29, below for a constant forgetting factor (CFF-RLS).
        structure: "siso" over theta_i and phi_i, "miso" (each output from the three motors and its own past) or
            "mimo" (from the three motors and both pasts).
        covariance_bound: on the trace of F where `forgetting` is below 1; 0 for none.
        stable: halve a step that would make a pole unstable (not for "mimo").
    """

    na: int = 1
    nb: int = 1
    delay: float | None = None
    max_delay: float = 0.3
    forgetting: float = 1.0
    structure: str = "siso"
    covariance_bound: float = 1e8
    stable: bool = False

    def __post_init__(self) -> None:
        # A hundred samples are 2 s: no neck remembers longer.
        require_whole("na", self.na, 1, 100)
        require_whole("nb", self.nb, 1, 100)
        if self.delay is not None:
            require_between("delay", self.delay, 0.0, 2.0, "s")
        require_positive("max_delay", self.max_delay, "s")
        require_forgetting(self.forgetting)
        require_one_of("structure", self.structure, STRUCTURES)
        require_between("covariance_bound", self.covariance_bound, 0.0, 1e15)
        if self.stable and self.structure == "mimo":
            raise SettingsError("`stable` watches the poles of one output; use structure `siso` or `miso` with it.")

    def recursion(self) -> Recursion:
        """Return the recursion of one output, for use sample by sample."""
        inputs = {"siso": 1, "miso": 3, "mimo": 3}[self.structure]  # of a neck
        outputs = 2 if self.structure == "mimo" else 1
        return self._recursion(outputs * self.na + inputs * self.nb)

    def _recursion(self, parameters: int) -> Recursion:
        return Recursion(
            parameters=parameters,
            forgetting=self.forgetting,
            covariance_bound=self.covariance_bound if self.forgetting < 1.0 else 0.0,
            poles=self.na if self.stable else 0,
            start_covariance=EXACT_START,
        )

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify pitch from theta_i and roll from phi_i, or both from the motors.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            progress: called with the part done and a word on it.

        Raises:
            DataError: too short, constant, without two usable rows, or not enough excitation.
        """
        recording = training_recording(recordings, any_robot=True)
        point = operating_point(recording)
        centred = about(recording, point)
        directions = directions_of(centred, [run.set_points for run in centred.runs()])
        settings = replace(self, max_delay=self.max_delay * directions.stretch)
        if self.structure == "siso":
            arrays, findings = settings._fit_siso(centred, directions, progress)
        else:
            arrays, findings = settings._fit_motors(centred, progress)
        if not recording.robot.is_neck:
            findings |= directions.findings()
        arrays = with_offset("rls", arrays, recording, point)
        progress(1.0, "done")
        return fitted_model("rls", self, recording, arrays=arrays, findings={"delay_criterion": "free_run", **findings})

    def _fit_siso(
        self, recording: Recording, directions: Directions, progress: Progress
    ) -> tuple[dict[str, Matrix], dict]:
        drive, neck = fit_drive(recording), recording.robot.is_neck
        runs = [
            (run.outputs, redefine(run.set_points) if neck else run.set_points @ directions.weights.T)
            for run in recording.runs()
        ]
        a, b, delays, stds, numbers = [], [], [], [], []
        curves: dict[str, Curve] = {}
        for axis, name in enumerate(directions.names):
            progress(axis / len(directions.names), name)
            one = [(Y[:, [axis]], U[:, [axis]]) for Y, U in runs]
            d, theta, std, curves[name], number = self._search(recording.sample_time, one, name)
            a.append(theta[: self.na])
            b.append(theta[self.na :])
            delays.append(float(d))
            stds.append(std.tolist())
            numbers.append(number)
        found = {"delay_curve": curves, "condition_number": numbers, "parameter_std": stds}
        if not neck:
            thetas = [np.concatenate(pair) for pair in zip(a, b, strict=True)]
            numbers_of = zip(directions.names, a, b, delays, strict=True)
            found["transfer_functions"] = {
                name: {"a": f.tolist(), "b": g.tolist(), "delay": int(d)} for name, f, g, d in numbers_of
            }
            return axes_arrays(self, directions, thetas, [int(d) for d in delays], drive.array), found
        history = max(self.na, max(delays) + self.nb, drive.delay.max())
        arrays = {
            "history": np.array([float(int(history))]),
            "drive": drive.array,
            "redefinition": redefinition_matrix(TENDON_ANGLES),
            "a": np.array(a),
            "b": np.array(b),
            "delay": np.array(delays),
        }
        return arrays, found

    def _search(
        self, sample_time: float, runs: list[tuple[Matrix, Matrix]], name: str
    ) -> tuple[int, Vector, Vector, Curve, float]:
        """Return delay [samples], theta, its std, the cost curve (delay [s], free-run fit [%], one-step rms), cond."""
        best: tuple[float, int, Vector, Vector, float] | None = None
        curve: Curve = []
        for d in delay_samples(self.delay, self.max_delay, sample_time, runs):
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
        theta, F = self._recurse(Phi, y)
        e = y - Phi @ theta
        rms = float(np.sqrt(np.mean(e**2)))
        free = max(y.size - theta.size, 1)
        return theta, rms * np.sqrt(y.size / free * np.diag(F)), rms, number

    def _recurse(self, Phi: Matrix, y: Vector) -> tuple[Vector, Matrix]:
        n = Phi.shape[1]
        recursion = self._recursion(n)
        state = recursion.initial_state()
        if self.forgetting < 1.0 or self.stable:
            state, _ = recursion.run(state, Phi, y)
        else:
            load_functions(_UD).ud_recursion(Phi, y, state.theta, state.factor, state.scale, 1.0)
        return state.theta, state.covariance

    def _fit_motors(self, recording: Recording, progress: Progress) -> tuple[dict[str, Matrix], dict]:
        """Fit all outputs over the motors; "miso" takes a dead time each, "mimo" one for all."""
        drive = fit_drive(recording).array
        Ts = recording.sample_time
        runs = [(run.outputs, run.set_points) for run in recording.runs()]
        names = recording.robot.outputs.names
        if self.structure == "miso":
            found = []
            for axis, name in enumerate(names):
                progress(axis / len(names), name)
                found.append(self._search(Ts, [(Y[:, [axis]], U) for Y, U in runs], name))
            delays = [d for d, *_ in found]
            arrays = self._motor_arrays([theta for _, theta, *_ in found], delays, drive)
            curves = {name: curve for name, (*_, curve, _) in zip(names, found, strict=True)}
            return arrays, {"delay_curve": curves, "condition_number": [number for *_, number in found]}
        best, curves = None, {name: [] for name in names}
        tried = delay_samples(self.delay, self.max_delay, Ts, runs)
        for step, d in enumerate(tried):
            progress(step / len(tried), f"{1e3 * d * Ts:.0f} ms")
            both = [self._least_squares(_own_first(runs, axis), d, name) for axis, name in enumerate(names)]
            arrays = self._motor_arrays([theta for theta, *_ in both], [d] * len(names), drive)
            fits = _fits(Model(kind="rls", sample_time=Ts, arrays=arrays, robot=recording.robot), recording)
            for name, fit, (_, _, rms, _) in zip(names, fits, both, strict=True):
                curves[name].append([d * Ts, fit, rms])
            cost = -sum(fits)
            if best is None or cost < best[0]:
                best = (cost, arrays, [number for *_, number in both])
        if best is None or not np.isfinite(best[0]):
            raise DataError("no dead time gives a stable model of both outputs; record more or set `delay`.")
        return best[1], {"delay_curve": curves, "condition_number": best[2]}

    def _motor_arrays(self, thetas: list[Vector], delays: list[int], drive: Matrix) -> dict[str, Matrix]:
        return motor_arrays(self, thetas, delays, drive)


def motor_arrays(settings: Rls, thetas: list[Vector], delays: list[int], drive: Matrix) -> dict[str, Matrix]:
    """Return the runtime's arrays of parameters over the motors, one vector for each output."""
    na, nb, common = settings.na, settings.nb, min(delays)
    p = max(na, nb + max(delays) - common)
    outputs, motors = len(thetas), len(drive)
    A, B = np.zeros((p, outputs, outputs)), np.zeros((p, outputs, motors))
    for axis, (theta, d) in enumerate(zip(thetas, delays, strict=True)):
        A[:na, axis, axis] = theta[:na]
        rest = theta[na:]
        if settings.structure == "mimo":
            for other in _others(axis, outputs):
                A[:na, axis, other] = rest[:na]
                rest = rest[na:]
        late = d - common
        B[late : late + nb, axis] = rest.reshape(motors, nb).T
    return lss_arrays(varx_system(A, B), delay=common, drive=drive, history=p + common)


def axes_arrays(
    settings: Rls, directions: Directions, thetas: list[Vector], delays: list[int], drive: Matrix
) -> dict[str, Matrix]:
    """Return the runtime's arrays of parameters over redefined inputs, one vector for each output, over the motors."""
    na = settings.na
    spread = [
        np.concatenate([theta[:na], np.outer(weights, theta[na:]).ravel()])
        for theta, weights in zip(thetas, directions.weights, strict=True)
    ]
    return motor_arrays(replace(settings, structure="miso"), spread, delays, drive)


def _others(axis: int, outputs: int) -> list[int]:
    return [other for other in range(outputs) if other != axis]


def _own_first(runs: list[tuple[Matrix, Matrix]], axis: int) -> list[tuple[Matrix, Matrix]]:
    return [(Y[:, [axis, *_others(axis, Y.shape[1])]], U) for Y, U in runs]


def _fits(model: Model, recording: Recording) -> list[float]:
    """Return the free-run fits [%] of all outputs; -inf where the model is unstable."""
    axes = range(recording.outputs.shape[1])
    if np.abs(np.linalg.eigvals(model.arrays["A"])).max() >= 1.0:
        return [-np.inf for _ in axes]
    simulated = model.simulate(recording)
    starts = np.concatenate([np.arange(len(run)) for run in recording.runs()]) >= WARM_UP
    return [nrmse_fit(recording.outputs[starts, axis], simulated[starts, axis]) for axis in axes]
