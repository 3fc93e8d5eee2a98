"""A fitted set of cones: estimates and bounds anywhere, and whether that is anywhere near the data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, FileFormatError, Matrix, Vector, read_archive, write_archive
from softneck.core._shown import Shown

from ._forest import PointTree, all_cores, tighten
from ._trees import tree_nodes

_KIND = "cones"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ConeSet(Shown):
    """What `Cones` makes of data: the data, the slopes and the noise bound.

    Attributes:
        points: the data in tree order, regressors scaled.
        gammas: (m, regions) slope of the cones of each region, one row per output.
        epsilon: (m,) bound on the noise.
        scale: (n,) weight of each regressor.
        usual_width: (m,) half-width of the bounds that hardly any row of the data exceeds, itself left out.
        single: whether the outputs came as (N,), and go as (rows,).
    """

    points: PointTree
    gammas: Matrix
    epsilon: Vector
    scale: Vector
    usual_width: Vector
    single: bool

    def __len__(self) -> int:
        return self.points.ages.size

    @property
    def gamma(self) -> Vector:
        """The slope (m,) that holds everywhere: the largest of the regions'."""
        return self.gammas.max(axis=1)

    def bounds(self, X: ArrayLike, *, workers: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return f_l and f_u, each (rows,) or (rows, m), at regressors X (rows, n).

        Args:
            X: (rows, n), not scaled.
            workers: threads; None takes all cores. The result does not depend on it.

        Raises:
            DataError: another number of regressors, or a number that is not finite.
        """
        queries = as_queries(X, self.scale)
        cores = all_cores() if workers is None else workers
        low, high = np.empty((len(queries), len(self.gammas))), np.empty((len(queries), len(self.gammas)))
        for output, (gammas, epsilon) in enumerate(zip(self.gammas, self.epsilon, strict=True)):
            found = tighten([self.points], output, gammas, queries, workers=cores)
            low[:, output], high[:, output] = found[:, 0] - epsilon, found[:, 1] + epsilon
        return (low[:, 0], high[:, 0]) if self.single else (low, high)

    def predict(self, X: ArrayLike, *, workers: int | None = None) -> np.ndarray:
        """Return the central estimate (Eq. 18), (rows,) or (rows, m)."""
        low, high = self.bounds(X, workers=workers)
        return 0.5 * (low + high)

    def outside(self, X: ArrayLike, *, workers: int | None = None) -> np.ndarray:
        """Return (rows,) whether a query is unlike what was seen: bounds wider than usual, in any output."""
        low, high = self.bounds(X, workers=workers)
        width = (0.5 * (high - low)).reshape(-1, self.epsilon.size)
        return np.asarray((width > self.usual_width).any(axis=1))

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the set to an `.npz` file."""
        arrays = {
            "points": self.points.points, "values": self.points.values, "ages": self.points.ages,
            "gammas": self.gammas, "epsilon": self.epsilon, "scale": self.scale, "usual_width": self.usual_width,
        }  # fmt: skip
        write_archive(path, {"kind": _KIND, "single": self.single}, arrays, force=force)

    @staticmethod
    def open(path: str | Path) -> ConeSet:
        """Return the set that `save` wrote.

        Raises:
            FileFormatError: no such file, another kind, or arrays that do not fit each other.
        """
        header, arrays = read_archive(path)
        if header.get("kind") != _KIND:
            raise FileFormatError(f"{path}: is a file of kind {header.get('kind')}; expected {_KIND}.")
        names = ("points", "values", "ages", "gammas", "epsilon", "scale", "usual_width")
        P, Y, ages, gammas, epsilon, scale, width = _floats(path, arrays, names)
        # The boxes are built anew: a tree that does not fit its points would leave some out.
        shapes = P.ndim == Y.ndim == gammas.ndim == 2 and P.shape[1] == Y.shape[1] == ages.size >= 2
        if not shapes or scale.shape != P.shape[:1] or not len(Y) == len(gammas) == epsilon.size == width.size:
            raise FileFormatError(f"{path}: its arrays do not fit each other; fit the set again.")
        regions = gammas.shape[1]
        nodes = tree_nodes(P, Y)
        if regions < 1 or regions & (regions - 1) or regions > len(nodes) // 2:
            raise FileFormatError(f"{path}: {regions} regions do not fit {ages.size} points.")
        return ConeSet(PointTree(P, Y, nodes, ages), gammas, epsilon, scale, width, header.get("single") is True)


def _floats(path: str | Path, arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> list[np.ndarray]:
    """Return the arrays in order, each checked to be of finite floats."""
    for name in names:
        array = arrays.get(name)
        if array is None or array.dtype != np.float64 or not np.isfinite(array).all():
            raise FileFormatError(f"{path}: its array `{name}` is missing or not of finite floats.")
    return [np.ascontiguousarray(arrays[name]) for name in names]


def as_queries(X: ArrayLike, scale: Vector) -> Matrix:
    """Return X (rows, n), checked and scaled."""
    queries = as_matrix("X", X)
    if queries.shape[1] != scale.size:
        raise DataError(f"`X` must have {scale.size} regressors (columns), as the set has; got {queries.shape[1]}.")
    return np.ascontiguousarray(queries * scale)


def as_matrix(name: str, values: ArrayLike) -> Matrix:
    """Return `values` as a float matrix; raise DataError unless it has two axes and is finite."""
    try:
        matrix = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"`{name}` must be an array of numbers, a row each: {error}.") from error
    if matrix.ndim != 2:
        raise DataError(f"`{name}` must have shape (rows, columns); got {matrix.shape}.")
    bad = ~np.isfinite(matrix).all(axis=1)
    if bad.any():
        raise DataError(f"`{name}` must be finite; row {int(np.argmax(bad))} is not. Leave such rows out.")
    return matrix


def as_outputs(Y: ArrayLike, rows: int) -> tuple[Matrix, bool]:
    """Return the outputs (rows, m), checked, and whether they came as (rows,)."""
    single = np.ndim(Y) == 1
    matrix = as_matrix("Y", np.asarray(Y)[:, None] if single else Y)
    if len(matrix) != rows or matrix.shape[1] == 0:
        raise DataError(f"`Y` must have {rows} rows, as `X` has, and an output; got {matrix.shape}.")
    return matrix, single
