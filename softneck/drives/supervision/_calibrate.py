"""Calibration of a baseline from undisturbed motion: models by least squares, thresholds from held-out residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, Matrix, Vector

from ._baseline import Baseline, Row, Rows, Tracking
from ._detection import Budget, Whitening, thresholds
from ._motor_charts import EDGES, MotorCharts, motor_names
from ._motor_models import Features, Flags, Motion, features_of, level_rows, motor_rows, row_of, variance_of
from ._tilt_charts import GyroLevel, TiltCharts, TiltModel, tilt_names
from ._tracking import LoopRun, fit_tracking, tracking_scores

# Memory of the tilt model [s], and number of its lags, which are denser for recent positions.
_MEMORY_S = 0.5
_LAG_COUNT = 8
# Margin beyond the measured range of positions, loads and speeds, as a share of it.
_RANGE_MARGIN = 0.2
_MIN_LENGTH = 20.0
# Least total length of runs of a loop [s]: four minutes showed a third of the slow error of a quarter of an hour, and
# the tracking chart then had a false alarm every eight hours.
_LEAST_LOOPS = 600.0
# See `calibrate`; by `benchmarks/supervisor_choice.py`.
_KNOWN_BIAS = 0.25
# Quantile of cycles that counts as nearly all.
_HIGH_QUANTILE = 0.95


def calibrate(
    motions: Sequence[Motion], *, cycle: float, sample_cycles: int, slack: float, known_bias: float = _KNOWN_BIAS
) -> Baseline:
    """Return the baseline of undisturbed motion.

    Thresholds come from held-out segments: each segment is left out of the fit once, a single one by halves. Runs of a
    loop are used for its tracking only: motors and tilt are calibrated on experiments, which overload no motor.

    Args:
        motions: undisturbed; those without a loop at least 40 s in total.
        cycle: of the bus [s]; sample_cycles: bus cycles for one sample of the tilt.
        slack: tension below which a tendon is slack [N].
        known_bias: share of the largest slow error that the charts of the tilt allow without a fault; the bootstrap
            covers the rest.

    Raises:
        DataError: too little motion, or motors that did not move.
    """
    loops = [motion for motion in motions if motion.references is not None]
    motions = [motion for motion in motions if motion.references is None]
    seconds = sum(len(motion.due) for motion in motions) * cycle
    if seconds < 2.0 * _MIN_LENGTH:
        besides = ", beside those of a loop" if loops else ""
        raise DataError(
            f"{seconds:.3g} s of motion{besides} are too few to compare with; record at least {2.0 * _MIN_LENGTH:g} s."
        )
    parts = list(motions) if len(motions) > 1 else motions[0].halves()
    known = [(part, features_of(part, cycle)) for part in parts]
    motor, tilt, slow, fitted = [], [], [], []
    for number in range(len(parts)):
        others = [other for k, other in enumerate(known) if k != number]
        fitted.append(fit(others, cycle=cycle, sample_cycles=sample_cycles, slack=slack))
        slow.append(_slow(fitted[-1], parts[number]))
    bias = row_of(known_bias * np.max(slow, axis=0))
    for part, model in zip(parts, fitted, strict=True):
        found = scores_of(replace(model, tilt_bias=bias), part)
        motor.append(found[0])
        tilt.append(found[1])
    whole = fit(known, cycle=cycle, sample_cycles=sample_cycles, slack=slack)
    runs = _loops(loops, replace(whole, tilt_bias=bias))
    charts = motor[0].shape[1] + tilt[0].shape[1] + 1 + (2 * runs[0].values.shape[1] if runs else 0)
    shared = Budget(charts=charts)
    rng = np.random.default_rng(0)
    # If samples are missing at random, e^-h bounds the rate of false alarms (Basseville and Nikiforov, 5.2.2).
    seldom = -np.log(shared.rate / shared.charts * cycle * sample_cycles)
    whole = replace(whole, tilt_bias=bias, missing_threshold=float(seldom))
    h = thresholds(motor, replace(shared, step=cycle), rng)
    g = thresholds(tilt, replace(shared, step=cycle * sample_cycles), rng)
    tracking = _tracking(runs, replace(shared, step=cycle * sample_cycles), rng) if runs else Tracking()
    return replace(whole, motor_thresholds=row_of(h), tilt_thresholds=row_of(g), tracking=tracking, seconds=seconds)


def _loops(loops: Sequence[Motion], model: Baseline) -> list[LoopRun]:
    """Return the runs of a loop that are long enough; a single run is split into halves."""
    runs = []
    for part in loops[0].halves() if len(loops) == 1 else loops:
        walk = _Walk(model)
        valid = np.array([walk.tilt.valid for k in range(len(part.due)) if walk.step(part, k)])
        run = LoopRun(part, valid, model.cycle * model.sample_cycles)
        runs += [run] if run.long else []
    if loops:
        require_loops(sum(run.seconds for run in runs) if len(runs) > 1 else 0.0)
    return runs


def require_loops(seconds: float) -> None:
    """Raise DataError if the runs of a loop with taut tendons are too short for its tracking model."""
    if seconds < _LEAST_LOOPS:
        raise DataError(
            f"{seconds:.0f} s of a loop's motion with taut tendons are too few to compare its tracking with. Run it "
            f"for at least {_LEAST_LOOPS:.0f} s, or leave its runs out: then tracking is not compared."
        )


def _tracking(runs: Sequence[LoopRun], budget: Budget, rng: np.random.Generator) -> Tracking:
    """Fit the tracking model of a loop, with thresholds from held-out runs."""
    fitted = [fit_tracking([other for other in runs if other is not run]) for run in runs]
    slow = [_second(tracking_scores(model, run)[1], run.step) for model, run in zip(fitted, runs, strict=True)]
    bias = row_of(np.max(slow, axis=0))
    scores = [tracking_scores(model._replace(bias=bias), run)[0] for model, run in zip(fitted, runs, strict=True)]
    return fit_tracking(runs)._replace(bias=bias, thresholds=row_of(thresholds(scores, budget, rng)))


def scores_of(baseline: Baseline, motion: Motion) -> tuple[Matrix, Matrix]:
    """Return the scores of all charts on one segment: of motors (cycles, charts), of the tilt (samples, charts)."""
    walk = _Walk(baseline)
    ours, theirs = [], []
    for k in range(len(motion.due)):
        if walk.step(motion, k):
            theirs.append(walk.tilt.scores.copy())
        ours.append(walk.motors.scores.copy())
    return np.array(ours), np.array(theirs)


class _Walk:
    """The charts over a segment of motion, with infinite thresholds."""

    def __init__(self, baseline: Baseline) -> None:
        self._gains = np.array(baseline.current)
        self.motors = MotorCharts(baseline, np.full(len(motor_names(baseline.motors)), np.inf))
        names = tilt_names(baseline.motors, baseline.outputs, gyro=bool(baseline.gyro_spread))
        self.tilt = TiltCharts(baseline, np.full(len(names), np.inf))
        self.tilt.begin()

    def step(self, motion: Motion, k: int) -> bool:
        """Process row `k`; return whether it has a sample."""
        self.motors.step(motion.setpoints[k], motion.positions[k], motion.tensions[k])
        if not motion.due[k]:
            return False
        values = motion.values[k] if np.isfinite(motion.values[k]).all() else None
        self.tilt.step(motion.positions[k], self.motors.features.taut(self._gains), values, motion.rates[k])
        return True


def fit(known: Sequence[tuple[Motion, Features]], *, cycle: float, sample_cycles: int, slack: float) -> Baseline:
    """Return the models of drives, tendons and tilt, without thresholds."""
    motions, features = [motion for motion, _ in known], [f for _, f in known]
    n, m = motions[0].positions.shape[1], motions[0].values.shape[1]
    drive, _, drive_spread = motor_rows(
        [f.drive for f in features], [f.moved for f in features], n, "its motor did not move", most=0
    )
    current, current_white, current_spread = motor_rows(
        [f.current for f in features], [f.change for f in features], n, "its current did not change"
    )
    step = cycle * sample_cycles
    top = np.max([np.abs(motion.tensions).max(axis=0) for motion in motions], axis=0)
    reach = np.nanquantile(np.concatenate([f.behind for f in features]), _HIGH_QUANTILE, axis=0)
    lags = _lags(step)
    # At rest the sign of friction is unknown: a tendon is certainly taut only above this tension.
    least = slack + np.abs(np.array(current)[:, n : n + len(EDGES)]).sum(axis=1)
    load, (least_load, most_load), level, level_spread = level_rows(known, least, top, reach)
    samples = [_Samples.of(motion, f, np.array(current), least) for motion, f in zip(motions, features, strict=True)]
    tilt = _tilt_gains(samples, lags)
    residuals = [s.values - _predict(s, tilt, lags, n) for s in samples]
    sure = [np.convolve(~s.taut, np.ones(lags[-1] + 1))[: len(s.taut)] < 0.5 for s in samples]
    stretches = [part for r, good in zip(residuals, sure, strict=True) for part in _stretches(r, good, lags[-1] + 1)]
    white, spread = _tilt_noise(samples, residuals, sure, tilt, lags, n)
    gyro = _gyro_noise(samples, step)
    bends = [np.diff(part - part.mean(axis=0), 2, axis=0) for part in stretches]
    low = np.min([motion.positions.min(axis=0) for motion in motions], axis=0)
    high = np.max([motion.positions.max(axis=0) for motion in motions], axis=0)
    margin = _RANGE_MARGIN * (high - low)
    due = np.concatenate([s.came for s in samples])
    fastest = np.max([np.nanmax(np.abs(f.moved), axis=0) for f in features], axis=0)
    return Baseline(
        cycle=cycle, sample_cycles=sample_cycles, outputs=m, drive=drive, drive_spread=drive_spread,
        drive_fastest=row_of((1.0 + _RANGE_MARGIN) * fastest),
        current=current, current_whitening=current_white, current_spread=current_spread,
        current_top=row_of(top), current_reach=row_of(reach),
        load=load, load_low=least_load - _RANGE_MARGIN * (most_load - least_load),
        level=level, level_spread=level_spread, tilt=_table(tilt), lags=lags,
        tilt_whitening=white, tilt_spread=spread, tilt_bias=(0.0,) * m,
        gyro_whitening=gyro[0], gyro_spread=gyro[1], gyro_wander=gyro[2],
        noise=row_of(np.concatenate(bends).var(axis=0)),
        missing=1.0 - float(np.mean(due)),
        reach=_table(np.column_stack([low - margin, high + margin])), slack=row_of(least),
    )  # fmt: skip


def _slow(baseline: Baseline, motion: Motion) -> Vector:
    """Return the largest mean over a second of the residual on a segment outside the fit."""
    walk, rows = _Walk(baseline), []
    for k in range(len(motion.due)):
        if walk.step(motion, k):
            rows.append(walk.tilt.residual if walk.tilt.valid else np.full(baseline.outputs, np.nan))
    return _second(np.array(rows), baseline.cycle * baseline.sample_cycles)


def _second(rows: Matrix, step: float) -> Vector:
    """Return the largest mean over a second of each column."""
    second = max(1, round(1.0 / step))
    means = [np.convolve(column, np.ones(second) / second, "valid") for column in rows.T]
    return np.nanmax(np.abs(means), axis=1, initial=0.0)


# -- tilt -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Samples of one segment: positions, tilt (gaps interpolated), rates, flags for taut tendons and valid samples."""

    positions: Matrix
    values: Matrix
    rates: Matrix
    taut: Flags
    came: Flags

    @classmethod
    def of(cls, motion: Motion, features: Features, current: Matrix, slack: Vector) -> _Samples:
        n = motion.positions.shape[1]
        friction = np.einsum("tij,ij->ti", features.place[:, :, n:], current[:, n:])
        taut = (motion.tensions - friction >= slack).all(axis=1)
        at = np.flatnonzero(motion.due)
        values = motion.values[at].copy()
        came = np.asarray(np.isfinite(values).all(axis=1))
        if came.sum() < 100:
            raise DataError("the tilt was measured too rarely to compare with.")
        for a in range(values.shape[1]):
            values[:, a] = np.interp(np.arange(len(at)), np.flatnonzero(came), values[came, a])
        return cls(motion.positions[at], values, motion.rates[at], taut[at], came)


def _lags(step: float) -> tuple[int, ...]:
    """Return lags up to half a second [samples]: 0, 1, 2, then with growing distances."""
    last = max(_LAG_COUNT, round(_MEMORY_S / step))
    return tuple(sorted({0, 1, 2, *np.unique(np.round(np.geomspace(3, last, _LAG_COUNT - 2)).astype(int)).tolist()}))


def _tilt_gains(samples: Sequence[_Samples], lags: tuple[int, ...]) -> Matrix:
    """Fit the gains (outputs, lags x motors) by least squares, with a separate offset for each segment."""
    X, y = [], []
    for s in samples:
        good = (np.convolve(~s.taut, np.ones(lags[-1] + 1))[: len(s.taut)] < 0.5)[lags[-1] :]
        x = np.hstack([s.positions[lags[-1] - lag : len(s.positions) - lag] for lag in lags])[good]
        v = s.values[lags[-1] :][good]
        if len(x) > 1:
            X.append(x - x.mean(axis=0))
            y.append(v - v.mean(axis=0))
    rows = sum(map(len, X))
    if not rows or rows < 10 * X[0].shape[1]:
        raise DataError("the tendons hung for most of the motion: there is no tilt to compare with.")
    return np.linalg.lstsq(np.vstack(X), np.vstack(y), rcond=None)[0].T


def _predict(s: _Samples, tilt: Matrix, lags: tuple[int, ...], motors: int) -> Matrix:
    walk = TiltModel(tilt, lags, motors)
    return np.array([walk.step(p).sum(axis=0) for p in s.positions])


def _stretches(values: Matrix, good: Flags, least: int) -> list[Matrix]:
    """Return the contiguous rows that are `good`, in parts of 50 rows or more, from a given row on."""
    usable = good.copy()
    usable[:least] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[0], usable.astype(int), [0]])))
    return [values[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 50]


def _tilt_noise(
    samples: Sequence[_Samples],
    residuals: Sequence[Matrix],
    known: list[Flags],
    tilt: Matrix,
    lags: tuple[int, ...],
    n: int,
) -> tuple[Rows, Rows]:
    white, spread = [], []
    angles = [_predict(s, tilt, lags, n) for s in samples]
    for a in range(tilt.shape[0]):
        parts, changes, ways = [], [], []
        for r, angle, good in zip(residuals, angles, known, strict=True):
            two = np.vstack([np.zeros((2, angle.shape[1])), angle[2:] - angle[:-2]])
            stack = np.column_stack([r[:, a], two[:, a], angle[:, a]])
            for part in _stretches(stack, good, lags[-1] + 1):
                parts.append(part[:, 0] - part[:, 0].mean())
                changes.append(part[:, 1])
                ways.append(part[:, 2] - part[0, 2])
        filter_ = Whitening.fit(parts)
        order = len(filter_.coefficients)
        squares = np.concatenate([filter_.apply(part) ** 2 for part in parts])
        shapes = [np.concatenate([part[order:] ** 2 for part in column]) for column in (changes, ways)]
        white.append(filter_.coefficients)
        spread.append(variance_of(squares, np.column_stack(shapes)))
    return tuple(white), tuple(spread)


def _gyro_noise(samples: Sequence[_Samples], step: float) -> tuple[Rows, Row, Row]:
    """Return the whitening of angles minus integrated rates, with the variance after and before; () without rates."""
    if not all(np.isfinite(s.rates[s.came]).all() for s in samples):
        return (), (), ()
    levels: list[Matrix] = []
    for s in samples:
        walk = GyroLevel(s.values.shape[1], step)
        known = [(walk.take(v, r), walk.level) for v, r in zip(s.values, s.rates, strict=True)]
        levels.append(np.array([level for good, level in known if good]).reshape(-1, s.values.shape[1]))
    white, spread = [], []
    for a in range(levels[0].shape[1]):
        filter_ = Whitening.fit([level[:, a] for level in levels])
        white.append(filter_.coefficients)
        spread.append(float(np.mean(np.concatenate([filter_.apply(level[:, a]) for level in levels]) ** 2)))
    wander = np.concatenate(levels).var(axis=0)
    return tuple(white), tuple(spread), row_of(wander)


def _table(values: Matrix) -> Rows:
    return tuple(row_of(row) for row in values)
