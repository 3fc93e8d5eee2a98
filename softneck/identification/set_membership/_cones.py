"""Set membership on plain arrays (Eq. 12-20; Milanese and Novara 2004): any regressor, any number of outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, SettingsError, Vector, require_between, require_one_of, require_whole
from softneck.core._blas_threads import one_blas_thread
from softneck.core._budget import available_bytes

from ._cone_set import ConeSet, as_matrix, as_outputs
from ._forest import PointTree, all_cores, plant, region_gammas, tighten
from ._gamma import RULES, curve_over, least_gammas, require_allowed

# The data, their copy in tree order with nodes and ages, and the columns being sorted (measured: 2.6 at most).
_TIMES_THE_DATA = 3.0


def require_memory(rows: int, inputs: int, outputs: int) -> None:
    """Raise DataError where a set of `rows` points would not fit, and say how many would."""
    free = available_bytes()
    per_row = _TIMES_THE_DATA * 8.0 * (inputs + outputs)
    if free is not None and rows * per_row > free:
        raise DataError(
            f"a set of {rows} points of {inputs} regressors and {outputs} outputs needs about "
            f"{rows * per_row / 2**30:.3g} GB to build, and {free / 2**30:.3g} GB are free: at most "
            f"{int(free / per_row)} points fit. Take every m-th row."
        )


# At most so many rows tell how wide the bounds are between the data: a quantile needs no more.
_WIDTHS = 5000


@dataclass(frozen=True, slots=True, kw_only=True)
class Cones:
    """Each sample confines the function to a cone; the estimate is the middle of what all cones leave.

    `f_u(x) = min_k y_k + epsilon + gamma |x - w_k|`, `f_l(x) = max_k y_k - epsilon - gamma |x - w_k|`.

    Attributes:
        gamma: bound on the slope (Eq. 16), one for all outputs or one each; None takes the least that the data
            allow with `epsilon`.
        epsilon: bound on the noise (Eq. 15), likewise; None takes the least that the data allow with `gamma`, and
            where both are None, the pair at the knee of the gamma curve.
        scale: (n,) weight of each component in the regressor's norm; None takes 1.
        rule: "paper" (each sample within its own bounds) or "milanese_novara" (some function within epsilon of each).
        regions: power of two; more than 1 gives each region of the data its own gamma, see docs, "Local gamma".
        correlated: rows before and after a row that do not count when the width of the bounds between the data is
            learned: neighbours in time are not news. 25 for a motion sampled at 20 ms, 0 for separate samples.
        usual: quantile of those widths above which `ConeSet.outside` calls a query unlike the data.
    """

    gamma: float | tuple[float, ...] | None = None
    epsilon: float | tuple[float, ...] | None = None
    scale: tuple[float, ...] | None = None
    rule: str = "paper"
    regions: int = 1
    correlated: int = 0
    usual: float = 0.99

    def __post_init__(self) -> None:
        require_one_of("rule", self.rule, tuple(RULES))
        require_whole("regions", self.regions, 1, 4096)
        require_whole("correlated", self.correlated, 0, 10**9)
        require_between("usual", self.usual, 0.0, 1.0)
        if self.regions & (self.regions - 1):
            raise SettingsError(f"`regions` must be a power of two; got {self.regions}.")
        if self.regions > 1 and self.gamma is not None:
            raise SettingsError("each region finds its own gamma: leave `gamma` out, or set `regions` to 1.")
        require_numbers("gamma", self.gamma, zero=False)
        require_numbers("epsilon", self.epsilon, zero=True)
        require_numbers("scale", self.scale, zero=False)

    @one_blas_thread
    def fit(self, X: ArrayLike, Y: ArrayLike, *, workers: int | None = None) -> ConeSet:
        """Return the set over regressors X (N, n) and outputs Y (N,) or (N, m).

        Raises:
            DataError: shapes that do not fit, fewer than 2 points, NaN, constant outputs without `epsilon`, more than
                memory holds, or gamma and epsilon that the data deny (then it names the two rows that do).
        """
        X = as_matrix("X", X)
        Y, single = as_outputs(Y, len(X))
        if len(X) < 2 or X.shape[1] == 0:
            raise DataError(f"a set needs at least 2 points of at least 1 regressor; got {X.shape[0]} x {X.shape[1]}.")
        require_memory(X.shape[0], X.shape[1], Y.shape[1])
        scale = weights(self.scale, X.shape[1])
        scaled = np.multiply(X.T, scale[:, None], out=np.empty((X.shape[1], len(X))))
        points = plant(scaled, np.array(Y.T, order="C"), np.arange(len(X), dtype=np.float64))
        regions = min(self.regions, len(points.nodes) // 2)
        cores = all_cores() if workers is None else workers
        outputs = range(Y.shape[1])
        chosen = [self._choose(points, output, regions, cores) for output in outputs]
        gammas, epsilon = np.array([gamma for gamma, _ in chosen]), np.array([epsilon for _, epsilon in chosen])
        widths = [usual_width(points, i, gammas[i], (self.correlated, self.usual), cores) for i in outputs]
        return ConeSet(points, gammas, epsilon, scale, epsilon + np.array(widths), single)

    def _choose(self, points: PointTree, output: int, regions: int, workers: int) -> tuple[Vector, float]:
        """Return the gammas (regions,) and epsilon of one output."""
        P, y = points.points, points.values[output]
        gamma, epsilon = pick(self.gamma, output), pick(self.epsilon, output)
        if gamma is None and epsilon is None:
            gamma, epsilon = curve_over(P, y, rule=self.rule, nodes=points.own_nodes(output)).recommended
        elif epsilon is None:
            gamma = float(gamma or 0.0)
            # f_u(w_i) >= y_i: what the cones alone, without epsilon, leave to be made up.
            bounds = tighten([points], output, np.array([gamma]), np.ascontiguousarray(P.T), workers=workers)
            epsilon = float(np.max(y - bounds[:, 1], initial=0.0)) / RULES[self.rule]
        elif gamma is None:
            slack = np.array([RULES[self.rule] * epsilon])
            gamma = float(least_gammas(P, y, slack, nodes=points.own_nodes(output))[0][0])
        require_allowed(points, output, gamma, epsilon, self.rule)
        if regions == 1:
            return np.array([gamma]), epsilon
        return region_gammas(points, output, RULES[self.rule] * epsilon, regions), epsilon


def usual_width(points: PointTree, output: int, gammas: Vector, usual: tuple[int, float], workers: int) -> float:
    """Return the half-width, without epsilon, that a quantile of the data's rows stays below, themselves left out.

    Args:
        points: the data.
        output: which.
        gammas: (regions,).
        usual: how many rows before and after a row are left out with it, and the quantile.
        workers: threads.
    """
    correlated, quantile = usual
    rows = points.ages.size
    if 2 * correlated + 1 >= rows:
        raise DataError(f"`correlated` {correlated} leaves nothing of {rows} rows to compare a row with; set it lower.")
    some = np.unique(np.linspace(0, rows - 1, min(rows, _WIDTHS)).astype(np.int64))
    windows = np.column_stack([points.ages[some] - correlated, points.ages[some] + correlated + 1])
    queries = np.ascontiguousarray(points.points[:, some].T)
    bounds = tighten([points], output, gammas, queries, windows=windows, workers=workers)
    return float(np.quantile(0.5 * (bounds[:, 1] - bounds[:, 0]), quantile))


def weights(scale: tuple[float, ...] | None, inputs: int) -> Vector:
    """Return the weight of each regressor (n,)."""
    array = np.ones(inputs) if scale is None else np.atleast_1d(np.asarray(scale, dtype=np.float64))
    if array.size != inputs:
        raise DataError(f"`scale` has {array.size} weights; the regressor has {inputs} components.")
    return array


def pick(given: float | tuple[float, ...] | None, output: int) -> float | None:
    """Return the number for one output."""
    if given is None:
        return None
    numbers = np.atleast_1d(np.asarray(given, dtype=np.float64))
    if numbers.size > 1 and output >= numbers.size:
        raise DataError(f"`gamma` and `epsilon` must be one number or one for each output; got {numbers.size}.")
    return float(numbers[output if numbers.size > 1 else 0])


def require_numbers(name: str, given: object, *, zero: bool) -> None:
    """Raise SettingsError unless `given` is None or of finite numbers above (or at) zero."""
    if given is None:
        return
    numbers = np.atleast_1d(np.asarray(given, dtype=np.float64))
    if not np.isfinite(numbers).all() or (numbers < 0.0).any() or (not zero and (numbers == 0.0).any()):
        raise SettingsError(f"`{name}` must be finite and {'at least 0' if zero else 'positive'}; got {given}.")
