"""How likely recordings are under an observer's noise levels: the cost that `fit_noise` minimises."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions
from softneck.runtime._bundle import sized
from softneck.signals import Recording

from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE, KALMAN_REJECTIONS, KalmanArrays
from ._nonlinear import NonlinearObserver
from ._offline import input_rows, measured_angles

# Rows at the start of each run that are not scored: there the filter is still uncertain of everything.
SETTLE = 50
# An outlier is further than so many robust standard deviations from the median of its neighbours and itself.
_OUTLIER = 6.0


def cost_of(observer: KalmanObserver | NonlinearObserver, runs: Sequence[Recording]) -> Cost | WalkCost:
    """Return the cost of an observer's noise levels over runs."""
    return WalkCost(observer, runs) if isinstance(observer, NonlinearObserver) else Cost(observer, runs)


class Cost:
    """The cost of levels over all runs, per measurement."""

    def __init__(self, observer: KalmanObserver, runs: Sequence[Recording]) -> None:
        motors, outputs = len(observer.robot.motors.names), len(observer.robot.outputs.names)
        self._functions = load_functions(sized("softneck.estimation._likelihood_runtime", motors, outputs))
        self._told = 2 * outputs + 2
        arrays = dict(zip(KalmanArrays.names(), observer.arrays, strict=False))  # without steady gains
        arrays["constants"] = constants = arrays["constants"].copy()
        # No gate, no force, no frozen sensor: the likelihood is of all that was measured.
        constants[KALMAN_GATE] = constants[KALMAN_REJECTIONS] = np.inf
        constants[KALMAN_FROZEN] = 0.0
        self._arrays = tuple(arrays.values())
        self._size = int(self._functions.state_size(self._arrays))
        self._tables: list[Matrix] = []
        self.outliers = 0
        for run in runs:
            z = measured_angles(run)
            spoilt = outliers(z)
            z[spoilt] = np.nan
            self.outliers += int(spoilt.sum())
            self._tables.append(input_rows(observer, run, z))
        self.rows = sum(self._run(table, observer.noise)[1] for table in self._tables)

    def of(self, levels: Vector) -> float:
        """Return minus twice the log likelihood per measurement at 10 to the power of `levels`, but for a constant."""
        noise = tuple(float(level) for level in 10.0**levels)
        return sum(self._run(table, noise)[0] for table in self._tables) / self.rows

    def _run(self, table: Matrix, noise: Sequence[float]) -> tuple[float, int]:
        state, outputs, parameters = np.zeros(self._size), np.zeros(self._told), np.array(noise)
        self._functions.initialise(self._arrays, parameters, state, outputs)
        return self._functions.kalman_cost(self._arrays, parameters, state, table, SETTLE)


class WalkCost:
    """The same over a nonlinear model, which runs free: once, and what it misses is judged as a walk."""

    def __init__(self, observer: NonlinearObserver, runs: Sequence[Recording]) -> None:
        self._cost = load_functions("softneck.estimation._walk_likelihood_runtime").walk_cost
        self._start = observer.start**2
        self._tables: list[tuple[Matrix, np.ndarray, Vector]] = []
        self.outliers = 0
        for run in runs:
            z = measured_angles(run)
            spoilt = outliers(z)
            z[spoilt] = np.nan
            self.outliers += int(spoilt.sum())
            angles, fastest = observer.free_run(run)
            self._tables.append((z - angles, np.asarray(np.isfinite(z).all(axis=1)), fastest))
        self.rows = sum(int(came[SETTLE:].sum()) for _, came, _ in self._tables)

    def of(self, levels: Vector) -> float:
        """Return minus twice the log likelihood per measurement at 10 to the power of `levels`, but for a constant."""
        noise, rest, ratio = (float(level) for level in 10.0**levels)
        costs = (
            self._cost(missed, came, rest**2 + (ratio * fastest) ** 2, noise**2, self._start, SETTLE)
            for missed, came, fastest in self._tables
        )
        return float(sum(costs)) / self.rows


def outliers(z: Matrix) -> np.ndarray:
    """Return which measurements (time,) stand apart from both neighbours that came."""
    spoilt = np.zeros(len(z), dtype=bool)
    came = np.flatnonzero(np.isfinite(z).all(axis=1))
    if came.size < 3:
        return spoilt
    y = z[came]
    middle = np.median(np.stack([y[:-2], y[1:-1], y[2:]]), axis=0)
    distance = np.abs(y[1:-1] - middle)
    # Scale from the changes between neighbours: 1.4826 times a median is a normal standard deviation. A noise-free
    # recording has none, and no outliers.
    scale = 1.4826 * np.median(np.abs(np.diff(y, axis=0)), axis=0)
    spoilt[came[1:-1]] = (distance > _OUTLIER * np.maximum(scale, 1e-12)).any(axis=1)
    return spoilt
