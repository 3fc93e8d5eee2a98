"""Set membership that learns as it goes: points are added, the oldest are forgotten, gamma stays valid.

The logarithmic method (J. L. Bentley and J. B. Saxe, "Decomposable searching problems I", J. Algorithms 1, 1980): trees
over stretches of time, older ones larger. A new point is a tree; a tree no larger than the one behind it is
merged with it. A bound over all points is the tightest over the trees, so nothing but the cost depends on how they lie.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    DataError,
    FileFormatError,
    Matrix,
    Vector,
    read_archive,
    require_one_of,
    require_whole,
    write_archive,
)

from ._cone_set import ConeSet, as_matrix, as_outputs, as_queries
from ._cones import pick, require_numbers, usual_width, weights
from ._forest import EVERYTHING, PointTree, all_cores, needed_gamma, plant, tighten
from ._gamma import RULES, denial, least_gammas
from ._trees import LEAF

_KIND = "online_cones"
_SETTINGS = ("epsilon", "gamma", "capacity", "scale", "rule")
_COUNTERS = ("total", "lowered", "single")


def write_online(path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, force: bool) -> None:
    """Write settings and counters (one mapping) and arrays."""
    write_archive(path, {"kind": _KIND, **header}, arrays, force=force)


def read_online(path: str | Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, np.ndarray]]:
    """Return settings, counters and arrays that `write_online` wrote.

    Raises:
        FileFormatError: no such file, another kind, or what does not fit.
    """
    header, arrays = read_archive(path)
    if header.get("kind") != _KIND:
        raise FileFormatError(f"{path}: is a file of kind {header.get('kind')}; expected {_KIND}.")
    missing = [name for name in (*_SETTINGS, *_COUNTERS) if name not in header]
    wrong = [name for name in ("points", "values", "ages", "gamma") if not _floats(arrays.get(name))]
    if missing or wrong:
        raise FileFormatError(f"{path}: {', '.join(missing + wrong)} missing or damaged.")
    P, Y, ages, gamma = (arrays[name] for name in ("points", "values", "ages", "gamma"))
    total, lowered = header["total"], header["lowered"]
    whole = isinstance(total, int) and isinstance(lowered, int) and 0 <= lowered <= total
    if not whole or P.ndim != 2 or Y.ndim != 2 or not P.shape[1] == Y.shape[1] == ages.size or len(Y) != gamma.size:
        raise FileFormatError(f"{path}: its arrays or counters do not fit each other.")
    # Ages are the rows behind each other up to the newest: what may be forgotten is told by them.
    if not np.array_equal(ages, np.arange(total - ages.size, total)):
        raise FileFormatError(f"{path}: its ages are not the last {ages.size} of {total}.")
    settings = {name: plain_numbers(header[name]) for name in _SETTINGS}
    return settings, {name: header[name] for name in _COUNTERS}, arrays


def plain_numbers(given: Any) -> Any:
    """Return sequences and arrays as tuples of floats and anything else as it is: what JSON keeps."""
    if isinstance(given, list | tuple | np.ndarray):
        return tuple(float(number) for number in given)
    return float(given) if isinstance(given, float | np.floating) else given


def _floats(array: np.ndarray | None) -> bool:
    return array is not None and array.dtype == np.float64 and bool(np.isfinite(array).all())


# So many points at once are worth a tree of their own.
_CHUNK = 4096


@dataclass(frozen=True, slots=True, eq=False)
class TrackResult:
    """What `OnlineCones.track` said of each row before it learned it; shapes as the outputs'."""

    estimate: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class OnlineCones:
    """Cones over the last `capacity` points of a stream.

    Gamma is raised at once when a new point denies it together with one that is remembered. Forgetting never makes it
    invalid, only larger than need be: after every half capacity of forgotten points it is set to the least that the
    remembered points allow, but never below the `gamma` given.
    """

    def __init__(
        self,
        *,
        epsilon: float | tuple[float, ...],
        gamma: float | tuple[float, ...] | None = None,
        capacity: int | None = None,
        scale: tuple[float, ...] | None = None,
        rule: str = "paper",
    ) -> None:
        """Start empty.

        Args:
            epsilon: bound on the noise, one for all outputs or one each.
            gamma: least slope of the cones; None takes what the points ask for.
            capacity: how many points are remembered; None all.
            scale: (n,) weight of each regressor; None takes 1.
            rule: see `Cones`.
        """
        require_one_of("rule", rule, tuple(RULES))
        require_numbers("epsilon", epsilon, zero=True)
        require_numbers("gamma", gamma, zero=False)
        require_numbers("scale", scale, zero=False)
        if capacity is not None:
            require_whole("capacity", capacity, 2, 2**53)
        numbers = {"epsilon": epsilon, "gamma": gamma, "scale": scale}
        self.settings = {name: plain_numbers(given) for name, given in numbers.items()}
        self.settings |= {"capacity": capacity, "rule": rule}
        self._capacity = capacity
        self._trees: list[PointTree] = []
        self._total = 0  # points ever added: the age of the next
        self._lowered = 0  # how many were forgotten when gamma was last lowered
        self._single = False
        self._scale = np.zeros(0)
        self._gamma = self._floor = self._epsilon = np.zeros(0)

    def __len__(self) -> int:
        return self._total - self._first

    @property
    def gamma(self) -> Vector:
        """The slope (m,) of the cones now."""
        return self._gamma.copy()

    @property
    def _first(self) -> int:
        """The age of the oldest point remembered."""
        return 0 if self._capacity is None else max(0, self._total - self._capacity)

    def add(self, X: ArrayLike, Y: ArrayLike) -> None:
        """Learn rows X (rows, n), Y (rows,) or (rows, m), oldest first: as if they came one by one.

        Raises:
            DataError: shapes that do not fit those before, NaN, or equal regressors whose outputs lie further apart
                than `epsilon` allows; then nothing was learned.
        """
        X = as_matrix("X", X)
        Y, single = as_outputs(Y, len(X))
        if self._total == 0:
            self._begin(X.shape[1], Y.shape[1], single)
        if Y.shape[1] != self._gamma.size:
            raise DataError(f"`Y` must have {self._gamma.size} outputs, as before; got {Y.shape[1]}.")
        points, values = np.ascontiguousarray(as_queries(X, self._scale).T), np.ascontiguousarray(Y.T)
        before = (list(self._trees), self._total, self._lowered, self._gamma)
        try:
            done = 0
            while done < len(X):
                rows = slice(done, done + self._chunk())
                self._learn(points[:, rows], values[:, rows])
                done = rows.stop
        except DataError:
            self._trees, self._total, self._lowered, self._gamma = before
            raise

    def bounds(self, X: ArrayLike, *, workers: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return f_l and f_u, each (rows,) or (rows, m), at X (rows, n); (-inf, inf) of an empty set."""
        queries = as_queries(as_matrix("X", X), self._known_scale())
        low, high = np.empty((len(queries), self._gamma.size)), np.empty((len(queries), self._gamma.size))
        cores, window = all_cores() if workers is None else workers, np.array([[-1.0, float(self._first)]])
        for output, epsilon in enumerate(self._epsilon):
            gamma = self._gamma[output : output + 1]
            found = tighten(self._trees, output, gamma, queries, windows=window, workers=cores)
            low[:, output], high[:, output] = found[:, 0] - epsilon, found[:, 1] + epsilon
        return (low[:, 0], high[:, 0]) if self._single else (low, high)

    def predict(self, X: ArrayLike, *, workers: int | None = None) -> np.ndarray:
        """Return the central estimate, (rows,) or (rows, m)."""
        low, high = self.bounds(X, workers=workers)
        return 0.5 * (low + high)

    def track(self, X: ArrayLike, Y: ArrayLike) -> TrackResult:
        """Predict each row, then learn it: the recursive mode. The set must not be empty."""
        X, targets = as_matrix("X", X), np.asarray(Y, dtype=np.float64)
        as_outputs(targets, len(X))
        lower, upper = np.empty_like(targets), np.empty_like(targets)
        for k in range(len(X)):
            low, high = self.bounds(X[k : k + 1], workers=1)
            lower[k], upper[k] = low[0], high[0]
            self.add(X[k : k + 1], targets[k : k + 1])
        return TrackResult(0.5 * (lower + upper), lower, upper)

    def remembered(self) -> tuple[Matrix, Matrix]:
        """Return regressors (N, n), scaled, and outputs (N, m) of all points remembered, oldest first."""
        points, values, _ = self._alive()
        return points.T, values.T

    def freeze(self, *, correlated: int = 0, usual: float = 0.99) -> ConeSet:
        """Return a set over the points remembered, with the gamma and epsilon of now; see `Cones` for the rest."""
        if len(self) < 2:
            raise DataError(f"a set needs at least 2 points; {len(self)} are remembered.")
        points, values, ages = self._alive()
        tree = plant(points, values, ages - ages[0])
        gammas = self._gamma[:, None]
        widths = [usual_width(tree, i, gammas[i], (correlated, usual), all_cores()) for i in range(len(values))]
        return ConeSet(tree, gammas.copy(), self._epsilon, self._scale, self._epsilon + widths, self._single)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write points, gamma and counters to an `.npz` file."""
        points, values, ages = self._alive()
        counters = {"total": self._total, "lowered": self._lowered, "single": self._single}
        arrays = {"points": points, "values": values, "ages": ages, "gamma": self._gamma}
        write_online(path, {**self.settings, **counters}, arrays, force=force)

    @staticmethod
    def open(path: str | Path) -> OnlineCones:
        """Return the stream that `save` wrote, which goes on as the other would."""
        settings, counters, arrays = read_online(path)
        online = OnlineCones(**settings)
        online._begin(arrays["points"].shape[0], arrays["values"].shape[0], counters["single"])
        online._total, online._lowered = counters["total"], counters["lowered"]
        online._gamma = arrays["gamma"]
        if arrays["ages"].size:
            online._trees = [plant(arrays["points"], arrays["values"], arrays["ages"])]
        return online

    def _begin(self, inputs: int, outputs: int, single: bool) -> None:
        self._scale, self._single = weights(self.settings["scale"], inputs), single
        self._epsilon = np.array([pick(self.settings["epsilon"], output) for output in range(outputs)])
        self._floor = np.array([pick(self.settings["gamma"], output) or 0.0 for output in range(outputs)])
        self._gamma = self._floor.copy()

    def _known_scale(self) -> Vector:
        if self._total == 0:
            raise DataError("the set is empty; `add` points first.")
        return self._scale

    def _chunk(self) -> int:
        """Return how many rows may come at once without a difference to one by one."""
        if self._capacity is None:
            return _CHUNK
        return min(_CHUNK, self._capacity, self._capacity + self._lowered + self._half - self._total)

    @property
    def _half(self) -> int:
        return max((self._capacity or 0) // 2, 1)

    def _learn(self, points: Matrix, values: Matrix) -> None:
        ages = self._total + np.arange(points.shape[1], dtype=np.float64)
        new = plant(np.array(points, order="C"), np.array(values, order="C"), ages)
        # What was forgotten before a row came denies it nothing.
        capacity = np.inf if self._capacity is None else self._capacity
        windows = np.column_stack([np.full(ages.size, -1.0), ages + 1.0 - capacity])
        queries, gamma = np.ascontiguousarray(points.T), self._gamma.copy()
        for output, slack in enumerate(RULES[self.settings["rule"]] * self._epsilon):
            pair = (queries, np.ascontiguousarray(values[output]))
            needed = needed_gamma(self._trees, output, slack, pair, windows=windows, gamma=gamma[output])
            gamma[output] = needed_gamma([new], output, slack, pair, windows=EVERYTHING, gamma=needed)
            if gamma[output] > 1e200:
                raise DataError(self._denied(new, output, slack))
        self._gamma = gamma
        self._trees.append(new)
        self._total += ages.size
        self._merge()
        self._forget()

    def _merge(self) -> None:
        """Merge the newest trees until each is larger than the one behind it."""
        while len(self._trees) > 1:
            older, newer = (tree.ages.size for tree in self._trees[-2:])
            if older > newer and older + newer > LEAF:
                return
            merged = self._alive(self._trees[-2:])
            self._trees[-2:] = [plant(*merged)] if merged[2].size else []

    def _forget(self) -> None:
        """Drop trees of which nothing is remembered, renew one of which half is not, and lower gamma at times."""
        dead = self._first - (self._total - sum(tree.ages.size for tree in self._trees))
        while self._trees and dead >= self._trees[0].ages.size:
            dead -= self._trees.pop(0).ages.size
        if dead > 0 and 2 * dead > self._trees[0].ages.size:
            self._trees[0] = plant(*self._alive(self._trees[:1]))
        if self._first - self._lowered >= self._half:
            self._lowered = self._first
            points, values, _ = self._alive()
            slacks = RULES[self.settings["rule"]] * self._epsilon
            least = [least_gammas(points, y, np.array([slack]))[0][0] for y, slack in zip(values, slacks, strict=True)]
            self._gamma = np.maximum(self._floor, least)

    def _alive(self, trees: list[PointTree] | None = None) -> tuple[Matrix, Matrix, Vector]:
        """Return points (n, N), values (m, N) and ages (N,) that are remembered, oldest first."""
        empty = np.zeros((self._scale.size, 0)), np.zeros((self._gamma.size, 0)), np.zeros(0)
        parts = [empty, *(tree.in_time_order() for tree in (self._trees if trees is None else trees))]
        points, values, ages = (np.concatenate(columns, axis=-1) for columns in zip(*parts, strict=True))
        kept = ages >= self._first
        return np.ascontiguousarray(points[:, kept]), np.ascontiguousarray(values[:, kept]), ages[kept]

    def _denied(self, new: PointTree, output: int, slack: float) -> str:
        points, values, ages = self._alive([*self._trees, new])
        _, pairs = least_gammas(points, values[output], np.array([slack]))
        j, k = sorted(pairs[0])
        rise = abs(values[output, j] - values[output, k])
        who = f"the points added as number {int(ages[j])} and {int(ages[k])}"
        return denial(who, f"output {output} is {rise:.6g} apart", 0.0, (0.0, float(self._epsilon[output])), np.inf)
