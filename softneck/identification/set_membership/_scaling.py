"""The scale of a regressor (Eq. 16's norm weighted by component) and epsilon, chosen by free run on a hold-out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Progress, SettingsError, Vector
from softneck.robot import Robot
from softneck.signals import Recording

from ..models._fitting import in_display_unit
from ._regressor import Data, Ground, gammas

RULES = ("auto", "none", "std")
# Sources of a regressor's rows (`_narx_runtime`): own output or both of the base, set-points, motors.
_OUTPUTS, _MOTORS = (0, 3), 2
# Half a percent of fit an axis is less than the scores of two hold-outs differ by; narrower bounds are worth more.
AS_GOOD = 1.0
# Issue 5 asks it of the bounds on data like those they were made of.
COVERAGE = 0.97
_THREADS = 2


def grouped_scale(table: Matrix, output_weight: float, motor_weight: float = 1.0) -> Vector:
    """Return one weight for all outputs, one for all motor positions, and 1 for all set-points."""
    source = table[:, 0]
    return np.where(np.isin(source, _OUTPUTS), output_weight, np.where(source == _MOTORS, motor_weight, 1.0))


def ruled_scale(rule: str | tuple[float, ...], table: Matrix, data: Data) -> Vector:
    """Return the scale of rule "none" or "std", or the given vector.

    Raises:
        SettingsError: the vector is not as long as the regressor.
    """
    if rule == "none":
        return np.ones(len(table))
    if rule == "std":
        spread = np.mean([X.std(axis=1) for X, _ in data], axis=0)
        return 1.0 / np.maximum(spread, 1e-12)
    scale = np.asarray(rule, dtype=np.float64)
    if scale.shape != (len(table),):
        raise SettingsError(f"`scale` has {scale.size} entries; the regressor has {len(table)} components.")
    return scale


@dataclass(frozen=True, slots=True, eq=False)
class ScaleTrial:
    """One scale and epsilon (outputs,), and what the free run over the hold-out says of them.

    Attributes:
        output_weight, motor_weight: of the scale, or None.
        scale: (n,).
        epsilon: (outputs,) [rad].
        score: sum of all axes' fits [%]; -inf where it left all bounds.
        coverage: part of the samples within f_l and f_u.
        width: mean of f_u - f_l [rad].
        slope: the least gamma of all axes; 0: the set is a constant, as epsilon swallowed all there was to learn.
    """

    output_weight: float | None
    motor_weight: float | None
    scale: Vector
    epsilon: Vector
    score: float
    coverage: float
    width: float
    slope: float

    def row(self, robot: Robot) -> list[float | None]:
        """Weights, first epsilon, score, coverage and width as JSON values in the unit shown; None for none."""
        epsilon, width = in_display_unit(robot, np.array([self.epsilon[0], self.width])).tolist()
        judged = [value if np.isfinite(value) else None for value in (self.score, self.coverage, width)]
        return [self.output_weight, self.motor_weight, epsilon, *judged]


@dataclass(frozen=True, slots=True, eq=False)
class HoldOut:
    """Free runs over the last part of the training rows, of sets made of the part before.

    Attributes:
        ground, data: of the first part.
        tail: the last part.
        epsilons: (outputs,) each, tried with every scale.
        narrow: among equally good ones take the narrowest bounds that cover the hold-out.
    """

    ground: Ground
    data: Data
    tail: Recording
    epsilons: Sequence[Vector]
    narrow: bool = False

    def choose(self, outputs: Sequence[float], motors: Sequence[float], progress: Progress) -> list[ScaleTrial]:
        """Return all that was tried, the best first: weights of outputs, then of motors beside the best of those."""
        tried = self._try([(weight, 1.0) for weight in outputs], progress)
        best = self.best_first(tried)[0]
        tried += self._try([(best.output_weight or 1.0, weight) for weight in motors], progress)
        return self.best_first(tried)

    def fixed(self, scale: Vector) -> list[ScaleTrial]:
        """Return each epsilon with one scale, the best first."""
        return self.best_first(list(self._scale(scale, None, None)))

    def best_first(self, tried: list[ScaleTrial]) -> list[ScaleTrial]:
        """Return them by falling score; raises DataError where no function fits the data with any of them."""
        if not tried:
            raise DataError("equal regressors have unequal outputs beyond any epsilon tried; set `epsilon` higher.")
        ranked = sorted(tried, key=lambda one: -one.score)
        if self.narrow:
            as_good = [t for t in ranked if t.score >= ranked[0].score - AS_GOOD and t.coverage >= COVERAGE]
            chosen = min((t for t in as_good if t.slope > 0.0), key=lambda one: one.width, default=ranked[0])
            ranked = [chosen, *(one for one in ranked if one is not chosen)]
        return ranked

    def _try(self, weights: Sequence[tuple[float, float]], progress: Progress) -> list[ScaleTrial]:
        tried: list[ScaleTrial] = []
        # Queries and the search for gamma are compiled and let go of Python's lock.
        with ThreadPoolExecutor(_THREADS) as pool:
            for number, part in enumerate(pool.map(self._weights, weights), start=1):
                progress(number / (len(weights) + 1), f"weights of outputs and motors {weights[number - 1]}")
                tried += part
        return tried

    def _weights(self, weights: tuple[float, float]) -> list[ScaleTrial]:
        scale = grouped_scale(self.ground.table, *weights) * self.ground.units
        return list(self._scale(scale, *weights))

    def _scale(self, scale: Vector, output: float | None, motor: float | None) -> Iterator[ScaleTrial]:
        for epsilon, gamma in zip(self.epsilons, gammas(self.data, scale, self.epsilons), strict=True):
            if gamma.max() > 1e100:
                continue
            arrays = self.ground.arrays(self.data, scale, gamma, epsilon)
            yield ScaleTrial(
                output, motor, scale, epsilon, *self.ground.free_run(arrays, self.tail), float(gamma.min())
            )
