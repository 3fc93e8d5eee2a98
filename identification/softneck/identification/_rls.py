"""Recursive least squares over the redefined inputs, one axis at a time, with dead time (section 4)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from scipy.signal import lfilter, lfiltic

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    Vector,
    load_functions,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.signals import TENDON_ANGLES, Recording, concatenate, redefine, redefinition_matrix

from ._checks import check_training
from ._drive import fit_drive
from ._model import WARM_UP, Model
from ._rows import row_hashes
from ._scores import nrmse_fit

_RECURSION = "softneck.identification._recursion_runtime"
# F(0): the weight of the start theta = 0; at 1e8 its bias is below 1e-9 on a record of one minute.
_START_COVARIANCE = 1e8


@dataclass(frozen=True, slots=True, kw_only=True)
class Rls:
    """ARX model of each axis by recursive least squares (Eq. 23-30) over theta_i and phi_i (Eq. 9, 10).

    Attributes:
        na, nb: orders of Eq. 23.
        delay: dead time [s]; None searches it.
        delay_by: the search's criterion on the training rows: "free_run" (simulation) or "one_step" (prediction).
        max_delay: end of the search [s].
        forgetting: 1 for Eq. 29, below for a constant forgetting factor.
    """

    na: int = 1
    nb: int = 1
    delay: float | None = None
    delay_by: str = "free_run"
    max_delay: float = 0.3
    forgetting: float = 1.0

    def __post_init__(self) -> None:
        # A hundred samples are 2 s: no neck remembers longer.
        require_whole("na", self.na, 1, 100)
        require_whole("nb", self.nb, 1, 100)
        if self.delay is not None:
            require_between("delay", self.delay, 0.0, 2.0, "s")
        require_one_of("delay_by", self.delay_by, ("free_run", "one_step"))
        require_positive("max_delay", self.max_delay, "s")
        require_between("forgetting", self.forgetting, 0.5, 1.0)

    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify pitch from theta_i and roll from phi_i.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            progress: called with the part done and a word on it.

        Raises:
            DataError: too short, constant, or without two usable rows.
        """
        recording = concatenate(recordings if isinstance(recordings, list) else [recordings])
        check_training(recording)
        drive = fit_drive(recording)
        results = []
        for axis in range(2):
            progress(axis / 2, ("pitch", "roll")[axis])
            results.append(self._fit_axis(recording, axis))
        delays = np.array([float(d) for d, *_ in results])
        history = int(max(self.na, delays.max() + self.nb, drive.delay.max()))
        arrays = {
            "history": np.array([float(history)]),
            "drive": drive.array,
            "redefinition": redefinition_matrix(TENDON_ANGLES),
            "a": np.array([a for _, a, _, _ in results]),
            "b": np.array([b for _, _, b, _ in results]),
            "delay": delays,
        }
        curves = {name: curve for name, (_, _, _, curve) in zip(("pitch", "roll"), results, strict=True)}
        progress(1.0, "done")
        return Model(
            kind="rls",
            sample_time=recording.sample_time,
            arrays=arrays,
            settings=asdict(self),
            findings={"delay_criterion": self.delay_by, "delay_curve": curves},
            training_rows=row_hashes(recording),
        )

    def _fit_axis(self, recording: Recording, axis: int) -> tuple[int, Vector, Vector, list[list[float]]]:
        """Return delay [samples], a, b and the cost curve: rows of (delay [s], free-run fit [%], one-step rms)."""
        Ts = recording.sample_time
        delays = range(round(self.max_delay / Ts) + 1) if self.delay is None else [round(self.delay / Ts)]
        runs = [(redefine(run.set_points)[:, axis], run.outputs[:, axis]) for run in recording.runs()]
        best: tuple[float, int, Vector, Vector] | None = None
        curve: list[list[float]] = []
        for d in delays:
            a, b, one_step = self._fit_delay(runs, d)
            free = _free_run_fit(runs, a, b, d)
            curve.append([d * Ts, free, one_step])
            cost = -free if self.delay_by == "free_run" else one_step
            if best is None or cost < best[0]:
                best = (cost, d, a, b)
        if best is None or not np.isfinite(best[0]):
            raise DataError(
                f"no dead time gives a stable one-step model of {('pitch', 'roll')[axis]}; "
                "record with more excitation or set `delay`."
            )
        return best[1], best[2], best[3], curve

    def _fit_delay(self, runs: list[tuple[Vector, Vector]], d: int) -> tuple[Vector, Vector, float]:
        Phi, y = _arx_regression(runs, self.na, self.nb, d)
        theta = np.zeros(self.na + self.nb)
        F = _START_COVARIANCE * np.eye(theta.size)
        load_functions(_RECURSION).rls_recursion(Phi, y, theta, F, self.forgetting)
        rms = float(np.sqrt(np.mean((y - Phi @ theta) ** 2)))
        return theta[: self.na], theta[self.na :], rms


def _arx_regression(runs: list[tuple[Vector, Vector]], na: int, nb: int, d: int) -> tuple[Matrix, Vector]:
    """Return phi(t-1) of Eq. 26 (rows, na + nb), inputs shifted by the dead time, and y(t)."""
    lag = max(na, nb + d)
    parts, targets = [], []
    for u, y in runs:
        if u.size <= lag:
            continue
        columns = [-y[lag - i : y.size - i] for i in range(1, na + 1)]
        columns += [u[lag - d - j : u.size - d - j] for j in range(1, nb + 1)]
        parts.append(np.column_stack(columns))
        targets.append(y[lag:])
    if not parts:
        raise DataError(f"every run is shorter than the {lag + 1} samples that this order and dead time need.")
    Phi, target = np.concatenate(parts), np.concatenate(targets)
    good = np.isfinite(Phi).all(axis=1) & np.isfinite(target)
    return np.ascontiguousarray(Phi[good]), np.ascontiguousarray(target[good])


def _free_run_fit(runs: list[tuple[Vector, Vector]], a: Vector, b: Vector, d: int) -> float:
    """Return the simulation fit [%] over all runs; -inf where the model is unstable."""
    denominator = np.concatenate([[1.0], a])
    if np.abs(np.roots(denominator)).max(initial=0.0) >= 1.0:
        return -np.inf
    numerator = np.concatenate([np.zeros(1 + d), b])
    measured, simulated = [], []
    for u, y in runs:
        y0 = y[np.argmax(np.isfinite(y))]
        zi = lfiltic(numerator, denominator, np.full(a.size, y0), np.full(numerator.size, u[0]))
        measured.append(y[WARM_UP:])
        simulated.append(lfilter(numerator, denominator, u, zi=zi)[0][WARM_UP:])
    return nrmse_fit(np.concatenate(measured), np.concatenate(simulated))
