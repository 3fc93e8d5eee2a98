"""Output error: transfer functions with dead time whose free run fits best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    Vector,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import TENDON_ANGLES, Recording, redefine, redefinition_matrix

from ..models._directions import Directions, directions_of
from ..models._drive import fit_drive
from ..models._fitting import delay_samples, fitted_model, free_run_fit, training_recording
from ..models._model import Model
from ..models._state_space import axes_system, lss_arrays
from ._oe_fit import OutputErrorFit, default_starts, fit_output_error, largest_radius, pole_radius
from ._operating_point import about, operating_point, with_offset
from ._regression import arx_rows, require_excitation

SOURCES = ("set_points", "positions")


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputError:
    """Transfer functions from theta_i to pitch and phi_i to roll by output error (Ljung 1999, sec. 4.2 and 10.2).

    Of another robot each output follows its direction, given or learned from the data.
    Unbiased under output noise, where `rls` is not. It has no noise model: a prediction some samples ahead is the
    free run started again from the measured outputs.

    Attributes:
        nf, nb: poles, and coefficients of the numerator.
        delay: dead time [s]; None takes the one of the least cost.
        max_delay: end of that search [s], of another robot by its time constant over the neck's 0.2 s.
        source: what drives the model: "set_points", or "positions" of the motors, which in free run the drive model
            makes from the set-points.
    """

    nf: int = 1
    nb: int = 1
    delay: float | None = None
    max_delay: float = 0.3
    source: str = "set_points"

    def __post_init__(self) -> None:
        require_whole("nf", self.nf, 1, 10)
        require_whole("nb", self.nb, 1, 100)
        if self.delay is not None:
            require_between("delay", self.delay, 0.0, 2.0, "s")
        require_positive("max_delay", self.max_delay, "s")
        require_one_of("source", self.source, SOURCES)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify both axes; runs are never joined and each has its own start, missed samples are not judged.

        Raises:
            DataError: too short, constant, not enough excitation, or no stable model.
        """
        recording = training_recording(recordings, any_robot=True)
        point = operating_point(recording)
        directions, inputs = axis_runs(about(recording, point), self.source)
        found, delays, curves, beside = [], [], {}, {}
        for axis, name in enumerate(directions.names):
            progress(axis / len(inputs), name)
            fit, d, curves[name], beside[name] = self._fit_axis(recording.sample_time, inputs[axis], name, directions)
            found.append(fit)
            delays.append(float(d))
        arrays, functions = axis_arrays(
            recording, directions, [fit.f for fit in found], [fit.b for fit in found], delays, self.source
        )
        arrays = with_offset("oe", arrays, recording, point)
        progress(1.0, "done")
        return fitted_model(
            "oe",
            self,
            recording,
            arrays=arrays,
            findings={
                **functions,
                "delay_criterion": "output_error",
                "delay_curve": curves,
                "parameter_std": [np.sqrt(np.diag(fit.covariance)).tolist() for fit in found],
                "least_squares_beside": beside,
                **_warnings(directions.names, inputs, found),
            },
        )

    def _fit_axis(
        self, sample_time: float, runs: list[tuple[Vector, Vector]], name: str, directions: Directions
    ) -> tuple[OutputErrorFit, int, list[list[float]], dict[str, Any]]:
        """Return the best fit, its dead time, the cost curve (delay [s], fit [%], one-step rms), and plain ARX."""
        columns = [(y[:, None], u[:, None]) for u, y in runs]
        spread = _spread(runs)
        best: tuple[OutputErrorFit, int] | None = None
        curve: list[list[float]] = []
        last: list[Vector] = []
        # In the time of a neck: what starts from time constants starts from the robot's.
        necks = sample_time / directions.stretch
        for d in delay_samples(self.delay, self.max_delay * directions.stretch, sample_time, columns):
            Phi, Y = arx_rows(columns, self.nf, self.nb, d)
            require_excitation(name, Phi)
            arx = np.linalg.lstsq(Phi, Y[:, 0])[0]
            # The optimum of one dead time is a good start for the next; all others only where there is none yet.
            starts = [*last, arx[: self.nf]] if last else default_starts(self.nf, necks, arx[: self.nf])
            fit = fit_output_error(runs, self.nf, self.nb, d, starts)
            if fit is None:
                continue
            last = [fit.f]
            one_step = Y[:, 0] - Phi @ np.concatenate([fit.f, fit.b])
            percent = 100.0 * (1.0 - np.sqrt(fit.cost / spread))
            curve.append([d * sample_time, percent, float(np.sqrt(np.mean(one_step**2)))])
            if best is None or fit.cost < best[0].cost:
                best = (fit, d)
        if best is None:
            raise DataError(f"no dead time gives a stable model of {name}; record with more excitation.")
        d = best[1]
        again = fit_output_error(runs, self.nf, self.nb, d, [best[0].f, *default_starts(self.nf, necks, None)])
        fit = again if again is not None and again.cost < best[0].cost else best[0]
        return fit, d, curve, _beside(columns, self.nf, self.nb, d, sample_time)


def axis_runs(recording: Recording, source: str) -> tuple[Directions, list[list[tuple[Vector, Vector]]]]:
    """Return the directions, and (input, output) of each run for each output, from set-points or logged positions.

    Raises:
        DataError: positions are asked for and were not logged, or only in part; or an output follows no motor.
    """
    if source == "positions" and not recording.has_motor_positions:
        raise DataError("no motor positions were logged; use `source=set_points`.")
    parts = recording.runs()
    motors = [run.motor_positions if source == "positions" else run.set_points for run in parts]
    if not all(np.isfinite(part).all() for part in motors):
        raise DataError("some motor positions were missed; fill them or use `source=set_points`.")
    directions = directions_of(recording, motors)
    runs: list[list[tuple[Vector, Vector]]] = [[] for _ in directions.names]
    for run, part in zip(parts, motors, strict=True):
        U = redefine(part) if recording.robot.is_neck else part @ directions.weights.T
        for axis, pairs in enumerate(runs):
            y = run.outputs[:, axis]
            if np.isfinite(y).any():
                pairs.append((np.ascontiguousarray(U[:, axis]), y))
    return directions, runs


def axis_arrays(
    recording: Recording, directions: Directions, a: list[Vector], b: list[Vector], delays: list[float], source: str
) -> tuple[dict[str, Matrix], dict[str, Any]]:
    """Return the arrays that the runtime reads, and what `findings` must say beside them.

    A model of one pole starts from its last measured output; one of more poles has a Kalman observer, as the last
    outputs determine a slow state beside a fast one only through their noise. So has a model of another robot.
    """
    drive = fit_drive(recording)
    neck = recording.robot.is_neck
    if max(part.size for part in a) > 1 or not neck:
        common = int(min(delays))
        late = [np.concatenate([np.zeros(int(d) - common), part]) for d, part in zip(delays, b, strict=True)]
        system = axes_system(a, late, directions.weights, None if neck else _noise(recording, directions))
        functions = {
            name: {"a": a[axis].tolist(), "b": b[axis].tolist(), "delay": int(delays[axis])}
            for axis, name in enumerate(directions.names)
        }
        arrays = lss_arrays(system, delay=common, drive=drive.array, source=int(source == "positions"))
        return arrays, {"transfer_functions": functions, **({} if neck else directions.findings())}
    # Both axes stand in one table.
    na, nb = max(part.size for part in a), max(part.size for part in b)
    A, B = np.zeros((2, na)), np.zeros((2, nb))
    for axis in range(2):
        A[axis, : a[axis].size], B[axis, : b[axis].size] = a[axis], b[axis]
    history = max(na, max(delays) + nb, drive.delay.max())
    arrays = {
        "history": np.array([float(int(history))]),
        "drive": drive.array,
        "redefinition": redefinition_matrix(TENDON_ANGLES),
        "a": A,
        "b": B,
        "delay": np.array(delays),
        "source": np.array([float(source == "positions")]),
    }
    return arrays, {}


def _noise(recording: Recording, directions: Directions) -> list[tuple[float, float]]:
    """Return by how much inputs act otherwise than asked, and outputs are off: a neck's shares of what they move."""
    inputs, outputs = (recording.set_points @ directions.weights.T).std(axis=0), np.nanstd(recording.outputs, axis=0)
    return [(0.1 * float(u), 0.01 * float(y)) for u, y in zip(inputs, outputs, strict=True)]


def _beside(columns: list[tuple[Matrix, Matrix]], na: int, nb: int, d: int, sample_time: float) -> dict[str, Any]:
    """Return what plain least squares (ARX) makes of the same orders and dead time: its bias under noise shows."""
    Phi, Y = arx_rows(columns, na, nb, d)
    theta = np.linalg.lstsq(Phi, Y[:, 0])[0]
    slowest = pole_radius(theta[:na])
    return {
        "slowest_pole_1_per_s": float(-np.log(slowest)) / sample_time if slowest > 0.0 else None,
        "static_gain": float(theta[na:].sum() / (1.0 + theta[:na].sum())),
        "free_run_fit": _finite(free_run_fit(columns, theta[:na], theta[None, na:], d)),
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _spread(runs: list[tuple[Vector, Vector]]) -> float:
    y = np.concatenate([y[np.isfinite(y)] for _, y in runs])
    return float(np.sum((y - y.mean()) ** 2))


def _warnings(
    names: tuple[str, ...], runs: list[list[tuple[Vector, Vector]]], found: list[OutputErrorFit]
) -> dict[str, list[str]]:
    said = [
        f"{name}: its slowest pole is at the bound of a third of the longest run, a drift; lower `nf` or record longer."
        for name, axis, fit in zip(names, runs, found, strict=True)
        if pole_radius(fit.f) > largest_radius(axis) - 1e-3 * (1.0 - largest_radius(axis))
    ]
    return {"warnings": said} if said else {}
