"""Novelty: how far a test's regressors lie from those that the model was trained on.

A model is asked to interpolate near its training data and to guess away from it. The distance is to the nearest
training point in the space of Eq. 21 (y(k-1), six set-points, three motor positions), in units of spread: angles by
the training's standard deviation of that angle, motors by that of all motors together, so that a motor which stood
still in training counts in full when it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.core._shown import Shown
from softneck.signals import Recording, concatenate

from ..models._drive import DriveModel
from ..models._fitting import known_rows
from ..models._model import WARM_UP, Model
from ..models._regressors import PAPER_EQ21, motor_signals, regression
from ..set_membership._regressor import residual_rows
from ._scored_rows import ScoredStretch

QUANTILES = (0.5, 0.9, 0.99, 1.0)
_NAMES = ("p50", "p90", "p99", "max")
_AXES = ("pitch", "roll")
# More points than this are thinned evenly: quantiles of a distribution need no more.
_MOST_KNOWN, _MOST_ASKED = 20_000, 10_000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Novelty(Shown):
    """Quantiles (50, 90, 99 %, largest) of nearest-neighbour distances, for pitch's and roll's regressors.

    Attributes:
        distance: (2, 4) from the judged rows to the training rows, in standard deviations.
        spacing: (2, 4) from each training row to its nearest other one.
    """

    distance: Matrix
    spacing: Matrix

    @property
    def ratio(self) -> Matrix:
        """(2, 4) distance over spacing: about 1 is more of the same; NaN where the training rows coincide."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.spacing > 0.0, self.distance / self.spacing, np.nan)

    @property
    def larger(self) -> list[float] | None:
        """The larger ratio of both axes at each quantile; None where the training rows coincide."""
        ratio = self.ratio[np.isfinite(self.ratio).all(axis=1)]
        return ratio.max(axis=0).tolist() if ratio.size else None

    def as_dict(self) -> dict[str, Any]:
        """Return axis -> {"distance", "spacing", "ratio"} -> quantile -> value, for JSON."""
        tables = {"distance": self.distance, "spacing": self.spacing, "ratio": self.ratio}
        return {
            axis: {what: dict(zip(_NAMES, table[i].tolist(), strict=True)) for what, table in tables.items()}
            for i, axis in enumerate(_AXES)
        }


def novelty(model: Model, stretches: Sequence[ScoredStretch], training: Recording | None) -> Novelty | None:
    """Return the novelty of the judged rows; None without training data, which only some set membership models hold.

    Args:
        model: whose drive model fills in motor positions where none were logged.
        stretches: the rows judged.
        training: recording with the rows that the model was trained on; others in it do not count. None takes the
            points that a set membership model stores, in the space that it works in.
    """
    if training is None:
        if "points" not in model.arrays:
            return None
        if not np.array_equal(model.arrays["table"], PAPER_EQ21):
            return _set_novelty(model, stretches)
    drive = model.arrays.get("drive", np.zeros((3, 2)))
    motors = DriveModel(drive[:, 0], drive[:, 1])
    trained = training if training is None else _trained_rows(motor_signals(training, motors), model.training_rows)
    lag = int(PAPER_EQ21[:, 2].max())
    tests = [motor_signals(s.recording, motors).rows(WARM_UP - lag, len(s.recording)) for s in stretches]
    distance, spacing = np.full((2, len(QUANTILES)), np.nan), np.full((2, len(QUANTILES)), np.nan)
    for axis in range(2):
        # A stretch with fewer than two rows to judge has no regressors.
        asked = [regression(test, PAPER_EQ21, axis)[0] for test in tests if _has_rows(test, axis, lag)]
        if not asked:
            continue
        if trained is not None:
            known = regression(trained, PAPER_EQ21, axis)[0]
        else:
            known = model.arrays["points"][axis].T / model.arrays["scale"]
        distance[axis], spacing[axis] = _quantiles(known, np.concatenate(asked))
    return Novelty(distance, spacing)


def _trained_rows(training: Recording, hashes: np.ndarray) -> Recording:
    """Return the rows of `training` that the model knows by hash, as runs of their own.

    Raises:
        DataError: it knows none of them.
    """
    parts = []
    for run in training.runs():
        seen = known_rows(run, hashes)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
        parts += [run.rows(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]
    if not parts:
        raise DataError(
            "the model was trained on none of the rows given as its training data; "
            "give the recording that it was identified from."
        )
    return concatenate(parts)


def _has_rows(test: Recording, axis: int, lag: int) -> bool:
    """Return whether two rows have their output and the one before."""
    there = np.isfinite(test.outputs[lag - 1 :, axis])
    return int((there[1:] & there[:-1]).sum()) > 1


def _quantiles(known: Matrix, asked: Matrix) -> tuple[Vector, Vector]:
    scale = _scale(known)
    return _distances(known / scale, asked / scale)


def _distances(known: Matrix, asked: Matrix) -> tuple[Vector, Vector]:
    """Return the quantiles of distances from `asked` (rows, n) to `known` and inside `known`."""
    from scipy.spatial import KDTree

    points = known[:: -(-len(known) // _MOST_KNOWN)]
    some = asked[:: -(-len(asked) // _MOST_ASKED)]
    tree = KDTree(points)
    # A point that is in the training itself is compared with the others.
    own = tree.query(points, k=2, workers=-1)[0][:, 1]
    near = tree.query(some, k=2, workers=-1)[0]
    distance = np.where(near[:, 0] == 0.0, near[:, 1], near[:, 0])
    return np.quantile(distance, QUANTILES), np.quantile(own, QUANTILES)


def _scale(known: Matrix) -> Vector:
    """Return the unit of each column: the spread of the output, and that of all motors together."""
    output = PAPER_EQ21[:, 0] == 0
    spread = known.std(axis=0)
    motors = float(np.sqrt(np.mean(spread[~output] ** 2)))
    return np.where(output, max(float(spread[output].max()), 1e-6), max(motors, 1e-6))


def _set_novelty(model: Model, stretches: Sequence[ScoredStretch]) -> Novelty:
    """Return the novelty in the space of a set's own regressor, by its weights: form `lags` or `residual`."""
    table, scale = model.arrays["table"], model.arrays["scale"]
    residual = model.arrays["b"].shape[1] > 0
    # The base settles over twice the longest lag; without one, regressors need the lags alone.
    first = int(table[:, 2].max()) * (2 if residual else 1)
    tests = [stretch.recording for stretch in stretches if len(stretch.recording) > first + 2]
    distance, spacing = np.full((2, len(QUANTILES)), np.nan), np.full((2, len(QUANTILES)), np.nan)
    for axis in range(2):
        asked = [test for test in tests if np.isfinite(test.outputs[first:, axis]).sum() > 1]
        if asked:
            rows = [(_base_rows if residual else _lag_rows)(model, test, axis) for test in asked]
            distance[axis], spacing[axis] = _distances(model.arrays["points"][axis].T, np.concatenate(rows) * scale)
    return Novelty(distance, spacing)


def _base_rows(model: Model, test: Recording, axis: int) -> Matrix:
    """Return regressors (rows, n) of form `residual`: simulated motors and angles of its base."""
    names = ("history", "drive", "redefinition", "a", "b", "delay")
    base = Model(kind="rls", sample_time=model.sample_time, arrays={name: model.arrays[name] for name in names})
    return residual_rows(test, base, model.arrays["table"], axis)[0].T


def _lag_rows(model: Model, test: Recording, axis: int) -> Matrix:
    """Return regressors (rows, n) of form `lags`: measured outputs, set-points and motors."""
    drive = model.arrays["drive"]
    test = motor_signals(test, DriveModel(drive[:, 0], drive[:, 1]))
    # What aligns a free run is not judged.
    start = max(WARM_UP - int(model.arrays["table"][:, 2].max()), 0)
    return regression(test.rows(start, len(test)), model.arrays["table"], axis)[0]
