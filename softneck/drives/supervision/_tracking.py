"""Charts of the tracking of a loop: the tilt against a reference model of the closed loop.

The reference model of a loop is a sum of first-order lags of its reference, the same for all outputs,

    y_m = sum c_i x_i,     tau_i x_i' = r - x_i,

whose weights are fitted by least squares to undisturbed runs of the loop. It needs no model of neck or tendons. With
slack tendons a loop behaves differently and is not compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix, Vector

from ._baseline import Tracking
from ._detection import Charts, Filter, Whitening, shift_score
from ._motor_models import Flags, Motion, row_of, variance_of

# Time constants of the lags [s]: from one sample to the slowest loop, each twice the one before.
_LAGS = tuple(0.04 * 2.0**k for k in range(7))
# Tracking error to detect: half of the 3 deg by which a fault may move the neck.
_ASTRAY = math.radians(1.5)
# Samples without evaluation after the start of a reference or slack tendons: the initial state is not in the model.
_SETTLING_ROWS = 150
# Least length of a run of a loop [s].
_LEAST_LENGTH_S = 20.0


class _Lags:
    """The lags of all references."""

    def __init__(self, outputs: int, step: float) -> None:
        self._share = 1.0 - np.exp(-step / np.array(_LAGS))[:, None]
        self.x, self.seen, self._outputs = np.zeros((len(_LAGS), outputs)), 0, outputs
        self._wait = 0

    def step(self, reference: Sequence[float], values: Sequence[float], *, valid: bool) -> bool:
        """Process a sample; return whether the loop has had a reference and taut tendons for long enough."""
        self._wait = max(0, self._wait - 1) if valid else _SETTLING_ROWS
        if len(reference) != self._outputs or not np.isfinite(reference).all():
            self.seen = 0
            return False
        if not self.seen:
            # The loop starts at rest at the measured values.
            self.x[:] = values
        self.x += self._share * (np.asarray(reference) - self.x)
        self.seen += 1
        return self.seen > _SETTLING_ROWS and not self._wait


class TrackingCharts:
    """The charts of a loop's tracking.

    Attributes:
        scores: of the last sample, upper and lower of each output; charts: their sums.
        residual: tilt minus reference model [rad].
    """

    def __init__(self, model: Tracking, outputs: int, step: float, thresholds: Vector | None = None) -> None:
        """Start at zero; `thresholds` other than the model's are for the calibration."""
        self._lags, self._weights = _Lags(outputs, step), np.array(model.weights)
        self._filter = Filter([Whitening(row) for row in model.whitening], 1 + 2 * outputs)
        self._spread = np.array(model.spread)
        passes = np.array([1.0 - sum(row) for row in model.whitening])
        self._allowed = np.abs(passes) * np.array(model.bias)
        self._sides = np.kron(np.eye(outputs), np.array([[_ASTRAY], [-_ASTRAY]]))
        self._past = np.zeros((3, outputs))
        self.charts = Charts(np.array(model.thresholds) if thresholds is None else thresholds)
        self.scores, self.residual = np.zeros(2 * outputs), np.zeros(outputs)

    def step(self, reference: Sequence[float], values: Sequence[float] | None, *, valid: bool) -> int:
        """Process one sample: the reference of the loop (outputs,) [rad], () for none, and the tilt [rad].

        Return the number of a chart beyond its threshold, -1 for none. During slack tendons (not `valid`) and shortly
        after, the loop is not compared.
        """
        if values is None:
            return -1
        good = self._lags.step(reference, values, valid=valid)
        expected = self._weights @ self._lags.x
        self._past = np.vstack([expected, self._past[:2]])
        if self._lags.seen == 1:
            self._filter.reset()
        self.residual = np.asarray(values) - expected
        white = self._filter.step(np.vstack([self.residual, self._sides]))
        if not good:
            self.charts.sums[:] = self.scores[:] = 0.0
            return -1
        shapes = [np.ones(len(expected)), *shapes_of(np.asarray(reference), self._past)]
        spread = (self._spread.T * np.array(shapes)).sum(axis=0)
        self.scores = shift_score(white[0], white[1:], spread) - (np.abs(white[1:]) * self._allowed / spread).sum(
            axis=1
        )
        return self.charts.step(self.scores)


def shapes_of(reference: Vector, past: Matrix) -> tuple[Vector, Vector]:
    """Return the regressors of the variance: squares of the distance to the reference, and of the model's change."""
    return (reference - past[0]) ** 2, (past[0] - past[2]) ** 2


def fit_tracking(runs: Sequence[LoopRun]) -> Tracking:
    """Fit the reference model to undisturbed runs of a loop, without bias and thresholds."""
    X = np.concatenate([run.x[run.good].transpose(0, 2, 1).reshape(-1, len(_LAGS)) for run in runs])
    y = np.concatenate([run.values[run.good].reshape(-1) for run in runs])
    weights = np.linalg.lstsq(X, y, rcond=None)[0]
    white, spread = [], []
    for a in range(runs[0].values.shape[1]):
        parts, shapes = [], []
        for run in runs:
            model = np.einsum("i,tia->ta", weights, run.x)
            past = np.vstack([model[:1], model[:1], model[:-2]])
            left, change = shapes_of(run.references, np.stack([model, model, past]))
            parts.append((run.values - model)[run.good, a])
            shapes.append(np.column_stack([left[run.good, a], change[run.good, a]]))
        filter_ = Whitening.fit(parts)
        order = len(filter_.coefficients)
        squares = np.concatenate([filter_.apply(part) ** 2 for part in parts])
        white.append(filter_.coefficients)
        spread.append(variance_of(squares, np.concatenate([shape[order:] for shape in shapes])))
    return Tracking(weights=row_of(weights), whitening=tuple(white), spread=tuple(spread), bias=(0.0,) * len(white))


def tracking_scores(model: Tracking, run: LoopRun) -> tuple[Matrix, Matrix]:
    """Return the scores (samples, charts) of one run of the loop, and its residual (samples, outputs) [rad]."""
    walk = TrackingCharts(model, len(model.bias), run.step, np.full(2 * len(model.bias), np.inf))
    scores, residual = [], []
    for values, reference, valid, good in zip(run.values, run.references, run.valid, run.good, strict=True):
        walk.step(reference, values if np.isfinite(values).all() else None, valid=bool(valid))
        if good:
            scores.append(walk.scores.copy())
            residual.append(walk.residual)
    return np.array(scores), np.array(residual)


class LoopRun:
    """One run of a loop, sample by sample.

    Attributes:
        step: between samples [s].
        x: lags of its references (samples, lags, outputs).
        values, references: (samples, outputs) [rad].
        valid: samples with a valid tilt model; good: samples in which the tracking may be compared.
    """

    def __init__(self, motion: Motion, valid: Flags, step: float) -> None:
        """Make a run of `motion`; `valid` marks the samples with a valid tilt model."""
        self.step, self.valid, self.values = step, valid, motion.values[motion.due]
        none = np.full_like(self.values, np.nan)
        self.references = none if motion.references is None else motion.references[motion.due]
        lags, x, good = _Lags(self.values.shape[1], step), [], []
        for value, reference, holds in zip(self.values, self.references, valid, strict=True):
            came = bool(np.isfinite(value).all())
            good.append(came and lags.step(reference, value, valid=bool(holds)))
            x.append(lags.x.copy())
        self.x, self.good = np.array(x), np.array(good)

    @property
    def seconds(self) -> float:
        """Length of the comparable part [s]."""
        return float(self.good.sum()) * self.step

    @property
    def long(self) -> bool:
        """Whether it is long enough to be held out of a fit."""
        return self.seconds >= _LEAST_LENGTH_S
