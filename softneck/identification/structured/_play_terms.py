"""The regression behind kind `play`: signals, polynomial terms, ridge, and scores on rows held out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._directions import Directions
from ..models._drive import FUNCTIONS, LoadedDrive, drive_start
from ..models._model import WARM_UP
from ..models._scores import nrmse_fit

# Rows of each run in which its unknown past still shows [s]: those that `validate` does not score either.
_SETTLED = 0.5
HOLD_OUT = 0.2
# Rows held out that say something of a free run, where there are that many.
_LEAST_HELD = 50
# From so many runs on, a run is held out as a whole.
_MANY_RUNS = 4


@dataclass(frozen=True, slots=True)
class PlayStructure:
    """Which terms there are.

    Attributes:
        rate: of the low-pass filters [1/s].
        order: filters in a chain.
        widths: half-widths of the play operators [rad].
        degree: of the polynomial.
        inputs: redefined inputs.
        tilts: those of them that stand in cubes.
    """

    rate: float
    order: int
    widths: tuple[float, ...]
    degree: int
    inputs: int = 3
    tilts: int = 2

    @property
    def table(self) -> Matrix:
        """(n, 3) signals of which each term is the product; -1 stands for 1. The constant comes first."""
        chains = 1 + len(self.widths)
        rows = [[-1, -1, -1]] + [[i, -1, -1] for i in range(self.inputs * chains * self.order)]
        # The last filter but one: late enough for the neck's statics, whose curvature this is.
        late = [c * chains * self.order + self.order - 2 for c in range(self.inputs)]
        if self.degree >= 2:
            rows += [[*pair, -1] for pair in combinations_with_replacement(late, 2)]
        if self.degree >= 3:
            rows += [list(three) for three in combinations_with_replacement(late[: self.tilts], 3)]
        return np.array(rows, dtype=np.float64)

    def chain(self, sample_time: float) -> Vector:
        """(2,) pole and order, as the runtime reads them."""
        return np.array([np.exp(-self.rate * sample_time), float(self.order)])


@dataclass(frozen=True, slots=True, eq=False)
class Data:
    """Simulated motors and measured outputs of all runs, rows in which the start shows marked.

    Attributes:
        motors: one (time, motors) a run, simulated.
        measured: the same with what was logged, where it was.
        outputs: (time, outputs) of all runs behind each other.
        settled: (time,) rows to learn from and to judge.
        groups: masks (time,) of rows to hold out in turn: the last fifth of each run; of many runs a third of them.
        sample_time: [s].
        stretch: by how much the robot is slower than a neck.
        redefinition: (inputs, motors) T of Eq. 9-11.
    """

    motors: list[Matrix]
    measured: list[Matrix]
    outputs: Matrix
    settled: np.ndarray
    groups: list[np.ndarray]
    sample_time: float
    stretch: float
    redefinition: Matrix

    @classmethod
    def of(cls, recording: Recording, drive: LoadedDrive, directions: Directions, redefinition: Matrix) -> Data:
        """Simulate the motors of a recording."""
        runs = recording.runs()
        # Of another robot what `validate` does not score either.
        border = round(_SETTLED / recording.sample_time) if recording.robot.is_neck else WARM_UP
        outputs = recording.outputs
        settled = np.concatenate([np.arange(len(run)) >= border for run in runs]) & np.isfinite(outputs).all(axis=1)
        if settled.sum() < 2:
            raise DataError(f"every run is shorter than the {border} samples in which its start is forgotten.")
        motors = [drive.simulate(run.set_points, drive_start(run)) for run in runs]
        logged = [run.motor_positions if run.has_motor_positions else m for run, m in zip(runs, motors, strict=True)]
        return cls(
            motors=motors,
            measured=[np.where(np.isfinite(there), there, m) for there, m in zip(logged, motors, strict=True)],
            outputs=outputs,
            settled=settled,
            groups=_groups([len(run) for run in runs]),
            sample_time=recording.sample_time,
            stretch=directions.stretch,
            redefinition=redefinition,
        )

    def terms(self, form: PlayStructure, *, measured: bool = False) -> Matrix:
        """Return the terms (time, n) of all runs, along the simulated or the logged motors."""
        run = load_functions(FUNCTIONS).bank_run
        widths, chain, table = np.array(form.widths), form.chain(self.sample_time), form.table.astype(int)
        parts = []
        for motors in self.measured if measured else self.motors:
            signals = np.empty((len(motors), len(self.redefinition) * (1 + len(widths)) * form.order))
            motors = np.ascontiguousarray(motors)
            run(self.redefinition, widths, chain, motors, signals)
            parts.append(np.column_stack([signals, np.ones(len(signals))]))  # -1 is the column of ones
        signals = np.concatenate(parts)
        return signals[:, table[:, 0]] * signals[:, table[:, 1]] * signals[:, table[:, 2]]


def _groups(lengths: list[int]) -> list[np.ndarray]:
    if len(lengths) >= _MANY_RUNS:
        number = np.repeat(3 * np.arange(len(lengths)) // len(lengths), lengths)
        return [number == group for group in range(3)]
    return [np.concatenate([np.arange(n) >= (1.0 - HOLD_OUT) * n for n in lengths])]


def ridge(X: Matrix, Y: Matrix, weight: float) -> Matrix:
    """Return W (outputs, n) of the least `|Y - X W'|^2 / rows + weight |w|^2`, w of standardised terms, no constant."""
    mean, scale = X.mean(axis=0), X.std(axis=0)
    mean[0], scale[0] = 0.0, 1.0
    scale = np.where(scale > 1e-9, scale, 1.0)
    Z = (X - mean) / scale
    penalty = weight * len(Z) * np.ones(Z.shape[1])
    penalty[0] = 0.0
    A = Z.T @ Z + np.diag(penalty) + 1e-12 * len(Z) * np.eye(Z.shape[1])
    W = np.linalg.solve(A, Z.T @ Y) / scale[:, None]
    W[0] -= mean @ W
    return W.T


def scores(data: Data, hold_out: Data | None, form: PlayStructure, weights: tuple[float, ...]) -> list[float]:
    """Return, for each ridge weight, the mean free-run fit [%] of all outputs on rows that were not learnt from.

    Without `hold_out` parts of the data are held out in turn: the end of each run (of many runs a third of them,
    experiments of their own), and what is furthest from all the rest, which tells how the form extrapolates.
    """
    X, good = data.terms(form), data.settled
    if hold_out is None:
        far = _far(X[:, 1:], good)
        # Of a few seconds a tenth must do: the last fifth is always more.
        least = min(_LEAST_HELD, int(good.sum()) // 10)
        folds = [(X[good & ~held], data.outputs[good & ~held], X[good & held], data.outputs[good & held])
                 for held in (*data.groups, far) if (good & held).sum() > least]  # fmt: skip
    else:
        folds = [(X[good], data.outputs[good], hold_out.terms(form)[hold_out.settled],
                  hold_out.outputs[hold_out.settled])]  # fmt: skip
    return [float(np.mean([_fold_score(fold, weight) for fold in folds])) for weight in weights]


def _fold_score(fold: tuple[Matrix, Matrix, Matrix, Matrix], weight: float) -> float:
    X, Y, held, y = fold
    free = held @ ridge(X, Y, weight).T
    return float(np.mean([nrmse_fit(y[:, axis], free[:, axis]) for axis in range(y.shape[1])]))


def _far(signals: Matrix, good: np.ndarray) -> np.ndarray:
    """Return a mask of the fifth of the good rows whose signals are furthest from their mean (Mahalanobis)."""
    Z = (signals - signals[good].mean(axis=0)) / np.maximum(signals[good].std(axis=0), 1e-9)
    values, vectors = np.linalg.eigh(Z[good].T @ Z[good] / good.sum())
    # Directions that hardly occur are noise: 1e-3 of the largest is a thirtieth of its spread.
    kept = values > 1e-3 * values[-1]
    distance = np.linalg.norm(Z @ vectors[:, kept] / np.sqrt(values[kept]), axis=1)
    return distance > np.quantile(distance[good], 1.0 - HOLD_OUT)
