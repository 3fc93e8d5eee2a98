"""Models of drives and tendons: least-squares fits of steps and tensions in undisturbed motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softneck.core import DataError, Matrix, Vector
from softneck.runtime import load_functions

from ._baseline import Row, Rows
from ._detection import Whitening
from ._motor_charts import RULES, RUNTIME, MotorFeatures

Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """One segment of undisturbed motion, a row for each bus cycle.

    Attributes:
        setpoints: sent in the cycle before (time, motors) [rad].
        positions: (time, motors) [rad]; tensions: (time, motors) [N].
        values: of the tilt (time, outputs) [rad]; NaN in cycles without a sample.
        rates: of its gyro, the same [rad/s]; NaN without one.
        due: cycles in which a sample was due (time,).
        references: of the loop at the time of the measurement of the tilt (time, outputs) [rad]; NaN in cycles
            without one.
    """

    setpoints: Matrix
    positions: Matrix
    tensions: Matrix
    values: Matrix
    rates: Matrix
    due: Flags
    references: Matrix | None = None

    def halves(self) -> list[Motion]:
        """Return its first and its second half."""
        middle = len(self.due) // 2
        names = [item.name for item in fields(self) if getattr(self, item.name) is not None]
        parts = [
            {name: getattr(self, name)[cut] for name in names} for cut in (slice(None, middle), slice(middle, None))
        ]
        return [Motion(**part) for part in parts]


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Regressors and targets of each cycle and motor."""

    drive: Matrix
    moved: Matrix
    current: Matrix
    change: Matrix
    place: Matrix
    behind: Matrix


def features_of(motion: Motion, cycle: float) -> Features:
    n = motion.positions.shape[1]
    walk = MotorFeatures(n, cycle)
    rows: list[list[Matrix]] = [[], [], [], [], [], []]
    for s, p, tension in zip(motion.setpoints, motion.positions, motion.tensions, strict=True):
        walk.step(s, p, tension)
        told = (walk.drive, walk.moved, walk.current, walk.tension_change, walk.x[0], walk.behind)
        for row, value in zip(rows, told, strict=True):
            row.append(np.array(value) if walk.full else np.full_like(value, np.nan))
    return Features(*(np.array(row) for row in rows))


def motor_rows(X: list[Matrix], y: list[Matrix], motors: int, why: str, *, most: int = 6) -> tuple[Rows, Rows, Rows]:
    """Fit each motor's model; return coefficients, whitening, and variance with its increase by the model's square."""
    gains, white, spread = [], [], []
    for i in range(motors):
        kept = [np.isfinite(part[:, i]).all(axis=-1) for part in X]
        regressors = np.concatenate([part[good, i] for part, good in zip(X, kept, strict=True)])
        target = np.concatenate([part[good, i] for part, good in zip(y, kept, strict=True)])
        if float(np.std(target)) <= 0.0:
            raise DataError(f"motor {i + 1} cannot be compared with: {why}.")
        theta = _robust(regressors, target)
        models = [part[good, i] @ theta for part, good in zip(X, kept, strict=True)]
        left = [part[good, i] - model for part, good, model in zip(y, kept, models, strict=True)]
        filter_ = Whitening.fit(left, most=most)
        order = len(filter_.coefficients)
        squares = np.concatenate([filter_.apply(part) ** 2 for part in left])
        shape = np.concatenate([model[order:] ** 2 for model in models])
        gains.append(row_of(theta))
        white.append(filter_.coefficients)
        # The variance excludes cycles at the current limit, which the bootstrap covers.
        spread.append(variance_of(squares, shape[:, None], all_but=0.005))
    return tuple(gains), tuple(white), tuple(spread)


def level_rows(
    known: Sequence[tuple[Motion, Features]], slack: Vector, top: Vector, reach: Vector
) -> tuple[Rows, tuple[float, float], Rows, Row]:
    """Fit each tension by the motors' positions and the common load, on valid cycles; trivial for one motor.

    Return coefficients of the others' mean by positions, least and largest common residual, coefficients of each
    tension, and its variance. The residual of the others is averaged: their momentary friction would bias the least
    squares towards smaller payloads.
    """
    n = len(slack)
    if n < 2:
        return ((0.0, 0.0),), (0.0, 0.0), (row_of(np.zeros(known[0][1].place.shape[2] + 2)),), (1.0,)
    good = [_usable_cycles(motion, f, slack, top, reach) for motion, f in known]
    places = [np.column_stack([motion.positions, np.ones(len(motion.due))])[kept]
              for (motion, _), kept in zip(known, good, strict=True)]  # fmt: skip
    others = [
        (motion.tensions @ (1.0 - np.eye(n)) / (n - 1.0))[kept] for (motion, _), kept in zip(known, good, strict=True)
    ]
    told = sum(map(len, others)) > 10 * (n + 1)
    load = np.array([_robust(np.concatenate(places), column) if told else np.zeros(n + 1)
                     for column in np.concatenate(others).T])  # fmt: skip
    carried = [_exponential_mean(y - X @ load.T, RULES.carries) for X, y in zip(places, others, strict=True)]
    rows, spread = [], []
    for i in range(n):
        X = np.concatenate([np.column_stack([f.place[kept, i], loads[:, i], np.ones(len(loads))])
                            for (_, f), kept, loads in zip(known, good, carried, strict=True)])  # fmt: skip
        y = np.concatenate([motion.tensions[kept, i] for (motion, _), kept in zip(known, good, strict=True)])
        theta = _robust(X, y) if len(y) > 10 * X.shape[1] else np.zeros(X.shape[1])
        rows.append(row_of(theta))
        spread.append(float(np.var(y - X @ theta)) if theta.any() else 1.0)
    # In the first cycles friction has not averaged out.
    seen = np.concatenate([[0.0], *(loads.max(axis=1)[round(0.1 * RULES.carries) :] for loads in carried)])
    return tuple(row_of(row) for row in load), (float(seen.min()), float(seen.max())), tuple(rows), tuple(spread)


def _usable_cycles(motion: Motion, f: Features, slack: Vector, top: Vector, reach: Vector) -> Flags:
    """Return the cycles with taut tendons, motors below their current limits, and small following errors."""
    T = motion.tensions
    good = ((slack <= T) & ((1.0 - RULES.near_top) * top >= T) & (f.behind <= reach)).all(axis=1)
    return np.asarray(good & np.isfinite(f.place).all(axis=(1, 2)))


def _exponential_mean(off: Matrix, memory: float) -> Matrix:
    """Return the mean over the last cycles, as in the chart."""
    functions, load, counted = load_functions(RUNTIME), np.zeros(off.shape[1]), np.zeros(1)
    rows = np.empty_like(off)
    for k, row in enumerate(off):
        functions.supervised_load(row, load, counted, memory)
        rows[k] = load
    return rows


def _robust(X: Matrix, y: Vector) -> Vector:
    """Return the robust least-squares fit by Huber's weights, which discount cycles at the current limit."""
    theta = np.linalg.lstsq(X, y, rcond=None)[0]
    for _ in range(10):
        off = np.abs(y - X @ theta)
        # 1.48 median is the standard deviation of a normal distribution; 2.5 as in Huber's proposal 2.
        weight = np.sqrt(np.minimum(1.0, 2.5 * 1.48 * np.median(off) / np.maximum(off, 1e-12)))
        theta = np.linalg.lstsq(X * weight[:, None], y * weight, rcond=None)[0]
    return theta


def variance_of(squares: Vector, shapes: Matrix, *, all_but: float = 0.0) -> Row:
    """Return c_0, c_1, ... >= 0 of `squares ~ c_0 + shapes c` by weighted least squares.

    Each row is weighted by its expected value; the share `all_but` of rows with the largest squares is left out.
    """
    from scipy.optimize import nnls

    kept = squares <= np.quantile(squares, 1.0 - all_but)
    squares = squares[kept]
    X = np.column_stack([np.ones(len(squares)), shapes[kept]])
    weight = np.full(len(squares), float(np.mean(squares)))
    found = np.zeros(X.shape[1])
    for _ in range(5):
        found = nnls(X / weight[:, None], squares / weight)[0]
        weight = np.maximum(X @ found, 1e-3 * float(np.mean(squares)))
    found[0] = max(found[0], 1e-3 * float(np.mean(squares)))
    return row_of(found)


def row_of(values: Vector) -> Row:
    return tuple(float(value) for value in values)


class MotionLog:
    """Collector of motion, called after each cycle of a run."""

    def __init__(self) -> None:
        """Start empty."""
        self._rows: list[tuple[tuple[float, ...], ...]] = []
        self._sent: tuple[float, ...] | None = None
        self._asked: tuple[float, ...] = ()
        self._outputs = 0

    def __call__(self, _now: float, _in: Sequence[Any], _out: Sequence[Any], sample: Any, master: Any) -> None:
        """Add one cycle; `sample` is the sensor's sample or None."""
        # The finished step has already increased `cycle`.
        due = (master.cycle - 1) % master.settings.sample_cycles == 0
        values, rates = (), ()
        if sample is not None and sample.valid:
            values, rates = sample.values, sample.rates
        self._outputs = max(self._outputs, len(values))
        if self._sent is not None and master.supervisor.phase == "running":
            row = (self._sent, master.positions, master.tensions, values, rates, (float(due),), self._asked)
            self._rows.append(row)
        self._sent, self._asked = master.setpoints, master.reference

    def motion(self) -> Motion:
        """Return the collected motion."""
        none = (math.nan,) * self._outputs
        columns = [[row[k] or none for row in self._rows] for k in range(7)]
        arrays = [np.array(column, dtype=np.float64) for column in columns]
        s, p, tension, values, rates, due, asked = arrays
        return Motion(
            setpoints=s, positions=p, tensions=tension, values=values, rates=rates, due=due[:, 0] > 0.5,
            references=asked if np.isfinite(asked).any() else None,
        )  # fmt: skip
