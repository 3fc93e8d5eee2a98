"""Nonlinear set membership identification (section 3): the data set is the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    require_one_of,
    require_positive,
    silent,
)
from softneck.signals import Recording, concatenate

from ._arrays import no_base
from ._checks import check_training
from ._drive import DriveModel, fit_drive
from ._gamma import least_gammas
from ._model import WARM_UP, Model
from ._offending import require_feasible
from ._outside import usual_widths
from ._regressors import PAPER_EQ21, history_length, motor_signals, regression
from ._residual import ANGLE_WEIGHT, residual_points, residual_table
from ._rls import Rls
from ._rows import row_hashes
from ._scores import nrmse_fit
from ._tree import tree_nodes, tree_order

FORMS = ("paper_eq21", "residual")
# Free run of form `residual` hardly depends on it (docs, "Set membership").
_RESIDUAL_SIGMAS = 4.0
# The knee of gamma*(epsilon) lies at 3 to 5 sigma of the noise; in free run more is better, as the model's own
# errors stand in the regressor too. The hold-out decides.
_EPSILON_SIGMAS = (3.0, 5.0, 8.0, 12.0)
# Weight of the output in the regressor, motors having 1: half a decade apart up to the paper's own, 57.3, which
# logs angles in degrees beside motors in radians. A high weight trusts the fed-back output and drifts in free run.
_OUTPUT_WEIGHTS = (3.0, 10.0, 30.0, 57.29577951308232)
# The end of the training rows on which epsilon and the weight are chosen, in free run.
_HOLD_OUT = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class SetMembership:
    """The estimator of Eq. 12-20 and Algorithm 1 over the regressor of Eq. 21, one set for each axis.

    Attributes:
        form: "paper_eq21", or "residual": set membership over simulated signals on what the free run of `Rls`
            leaves over, which has nothing to feed back and so cannot drift.
        epsilon: noise bound of Eq. 15 [rad]; None chooses it on the data.
        output_weight: weight of y(k-1) (of the base's angles) in the regressor's norm, motors having 1; None
            chooses it on the data (takes 5).
    """

    form: str = "paper_eq21"
    epsilon: float | None = None
    output_weight: float | None = None

    def __post_init__(self) -> None:
        require_one_of("form", self.form, FORMS)
        if self.epsilon is not None:
            require_positive("epsilon", self.epsilon, "rad")
        if self.output_weight is not None:
            require_positive("output_weight", self.output_weight)

    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Store the data set and find gamma and epsilon that are consistent with all of it.

        gamma is the paper's: the least for which f_u(i) >= y(i) and f_l(i) <= y(i) at every point. epsilon and
        the output's weight are chosen by the free run over the last fifth of the training rows.

        Raises:
            DataError: too short, constant, or `epsilon` so small that no function fits the data.
        """
        recording = concatenate(recordings if isinstance(recordings, list) else [recordings])
        check_training(recording)
        noise = np.array([noise_level(recording, axis) for axis in range(2)])
        if self.form == "residual":
            arrays, findings = self._fit_residual(recording, noise, progress)
        else:
            drive = fit_drive(recording)  # before `motor_signals` puts the drive model's own positions in
            recording = motor_signals(recording, drive)
            arrays, findings = self._arrays(recording, drive, *self._choose(recording, drive, noise, progress))
        progress(1.0, "done")
        return Model(
            kind="nlsm",
            sample_time=recording.sample_time,
            arrays=arrays,
            settings=asdict(self),
            findings={"form": self.form, "noise_deg": np.degrees(noise).tolist(), **findings},
            training_rows=row_hashes(recording),
        )

    def _choose(
        self, recording: Recording, drive: DriveModel, noise: Vector, progress: Progress
    ) -> tuple[float, Vector]:
        """Return the output weight and epsilon (2,) of the best free run on the hold-out."""
        weights = _OUTPUT_WEIGHTS if self.output_weight is None else (self.output_weight,)
        sigmas = _EPSILON_SIGMAS if self.epsilon is None else (0.0,)
        if len(weights) * len(sigmas) == 1:
            return weights[0], np.full(2, self.epsilon)
        head, tail = recording.split(1.0 - _HOLD_OUT)
        if len(tail) <= 2 * WARM_UP:
            raise DataError(
                "the record is too short to choose epsilon; record longer, or set epsilon and output_weight."
            )
        best: tuple[float, float, Vector] | None = None
        for number, weight in enumerate(weights):
            progress(number / (len(weights) + 1), f"output weight {weight:.3g}")
            epsilons = [s * noise if self.epsilon is None else np.full(2, self.epsilon) for s in sigmas]
            for epsilon, gamma in zip(epsilons, self._gammas(head, weight, epsilons), strict=True):
                if gamma.max() > 1e100:
                    continue
                score = _free_run_score((head, tail), drive, weight, epsilon, gamma)
                if best is None or score > best[0]:
                    best = (score, weight, epsilon)
        if best is None:
            raise DataError("equal regressors have unequal outputs beyond any epsilon tried; set `epsilon` higher.")
        return best[1], best[2]

    def _gammas(self, recording: Recording, weight: float, epsilons: list[Vector]) -> list[Vector]:
        """Return gamma (2,) for each epsilon (2,)."""
        columns = []
        for axis in range(2):
            points, values = _points(recording, weight, axis)
            columns.append(least_gammas(points, values, np.array([epsilon[axis] for epsilon in epsilons]))[0])
        return [np.array(pair) for pair in zip(*columns, strict=True)]

    def _fit_residual(self, recording: Recording, noise: Vector, progress: Progress) -> tuple[dict[str, Matrix], dict]:
        progress(0.0, "linear base")
        base = Rls().fit(recording)
        progress(0.5, "set membership on what it leaves over")
        weight = ANGLE_WEIGHT if self.output_weight is None else self.output_weight
        epsilon = _RESIDUAL_SIGMAS * noise if self.epsilon is None else np.full(2, self.epsilon)
        table = residual_table(recording.sample_time)
        scale = np.where(table[:, 0] == 3, weight, 1.0)
        points = [residual_points(recording, base, table, scale, axis) for axis in range(2)]
        gamma = np.array([least_gammas(*points[i], epsilon[i : i + 1])[0][0] for i in range(2)])
        require_feasible(recording, table, points, gamma, epsilon)
        history = max(float(base.arrays["history"][0]), table[:, 2].max())
        arrays = {
            "history": np.array([history]),
            "drive": base.arrays["drive"],
            "table": table,
            "scale": scale,
            **_set_arrays(points, gamma, epsilon),
            **{name: base.arrays[name] for name in ("redefinition", "a", "b", "delay")},
        }
        findings = _findings(gamma, epsilon, weight, points[0][1].size)
        return arrays, findings | usual_widths(points, gamma, epsilon)

    def _arrays(
        self, recording: Recording, drive: DriveModel, weight: float, epsilon: Vector
    ) -> tuple[dict[str, Matrix], dict]:
        gamma = self._gammas(recording, weight, [epsilon])[0]
        points = [_points(recording, weight, axis) for axis in range(2)]
        require_feasible(recording, PAPER_EQ21, points, gamma, epsilon)
        findings = _findings(gamma, epsilon, weight, _points(recording, weight, 0)[1].size)
        findings |= usual_widths(points, gamma, epsilon)
        return _build(recording, drive, weight, epsilon, gamma), findings


def noise_level(recording: Recording, axis: int) -> float:
    """Return the standard deviation [rad] of white noise on one output, from its third differences.

    A motion of 4 rad/s sampled at 20 ms leaves almost nothing there; the median is not moved by jerks.
    """
    differences = [np.diff(run.outputs[:, axis], 3) for run in recording.runs() if len(run) > 3]
    d = np.concatenate(differences)
    d = d[np.isfinite(d)]
    # 20 = 1 + 9 + 9 + 1, squares of the binomials; 0.6745 is the quartile of a standard normal.
    sigma = float(np.median(np.abs(d))) / 0.6745 / np.sqrt(20.0)
    return max(sigma, 1e-7)  # a noise-free simulation: rounding is left


def _points(recording: Recording, weight: float, axis: int) -> tuple[Matrix, Vector]:
    X, y = regression(recording, PAPER_EQ21, axis)
    return np.ascontiguousarray((X * _scale(weight)).T), np.ascontiguousarray(y)


def _scale(weight: float) -> Vector:
    return np.where(PAPER_EQ21[:, 0] == 0, weight, 1.0)


def _free_run_score(
    parts: tuple[Recording, Recording], drive: DriveModel, weight: float, epsilon: Vector, gamma: Vector
) -> float:
    """Return the sum of both axes' free-run fits [%] on the second part, of a set made of the first."""
    head, tail = parts
    arrays = _build(head, drive, weight, epsilon, gamma)
    outputs = Model(kind="nlsm", sample_time=head.sample_time, arrays=arrays).simulate(tail)[:, :2]
    return sum(nrmse_fit(tail.outputs[WARM_UP:, axis], outputs[WARM_UP:, axis]) for axis in range(2))


def _build(recording: Recording, drive: DriveModel, weight: float, epsilon: Vector, gamma: Vector) -> dict[str, Matrix]:
    points = [_points(recording, weight, axis) for axis in range(2)]
    return {
        "history": np.array([float(history_length(PAPER_EQ21, drive))]),
        "drive": drive.array,
        "table": PAPER_EQ21,
        "scale": _scale(weight),
        **_set_arrays(points, gamma, epsilon),
        **no_base(),
    }


def _set_arrays(points: Sequence[tuple[Matrix, Vector]], gamma: Vector, epsilon: Vector) -> dict[str, Matrix]:
    rows = min(values.size for _, values in points)
    if rows < 2:
        raise SettingsError("a set needs at least 2 points.")
    W = np.empty((len(points), points[0][0].shape[0], rows))
    y = np.empty((len(points), rows))
    # Filled in place: with the data at hand and the tree, memory holds 2.3 times the data.
    for axis, (given, values) in enumerate(points):
        order = tree_order(given[:, :rows])
        for row, given_row in zip(W[axis], given, strict=True):
            row[:] = given_row[order]
        y[axis] = values[order]
    nodes = np.array([tree_nodes(*axis) for axis in zip(W, y, strict=True)])
    return {"points": W, "values": y, "bounds": np.column_stack([gamma, epsilon]), "nodes": nodes}


def _findings(gamma: Vector, epsilon: Vector, weight: float, points: int) -> dict:
    return {
        "epsilon_deg": np.degrees(epsilon).tolist(),
        "gamma": gamma.tolist(),
        "output_weight": weight,
        "points": points,
    }
