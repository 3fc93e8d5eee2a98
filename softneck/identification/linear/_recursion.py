"""Recursive least squares as an object with state: one row at a time, or a whole record at compiled speed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    DataError,
    FileFormatError,
    Matrix,
    SettingsError,
    Vector,
    require_between,
    require_positive,
    require_whole,
    write_archive,
)
from softneck.core._checks import finite_vector
from softneck.core._shown import Shown
from softneck.runtime import load_functions

_RUNTIME = "softneck.identification.linear._ud_runtime"
# In U D U' a start this weak costs no digits: it pulls a result by less than 1e-12 over the regressors' information.
EXACT_START = 1e12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class RecursionState(Shown):
    """What the recursion remembers.

    Attributes:
        theta: (n,) parameters.
        factor, scale: (n, n) and (n,): F = U D U' with U' = `factor` + I and D = `scale`.
        tally: (4,) rows taken in and their squared errors (both forgotten with lambda), dead-zone rows, projections.
    """

    theta: Vector
    factor: Matrix
    scale: Vector
    tally: Vector

    @property
    def covariance(self) -> Matrix:
        """F (n, n) of Eq. 29."""
        U = self.factor.T + np.eye(self.theta.size)
        return (U * self.scale) @ U.T

    @property
    def noise_std(self) -> float:
        """Standard deviation of the equation error, from the rows that are not forgotten."""
        free = self.tally[0] - self.theta.size
        return float(np.sqrt(max(self.tally[1], 0.0) / free)) if free > 0 else float("nan")

    @property
    def parameter_std(self) -> Vector:
        """(n,) standard deviations of `theta` if the equation error is white (Ljung 1999, sec. 9.2)."""
        return self.noise_std * np.sqrt(np.diag(self.covariance))

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the state to an `.npz` file."""
        arrays = {"theta": self.theta, "factor": self.factor, "scale": self.scale, "tally": self.tally}
        write_archive(path, {"kind": "rls_state"}, arrays, force=force)

    def summary(self) -> str:
        """Return the parameters with their standard deviations."""
        pairs = zip(self.theta, self.parameter_std, strict=True)
        return "rls_state: " + ", ".join(f"{value:.6g} +- {std:.2g}" for value, std in pairs)

    @classmethod
    def from_archive(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> RecursionState:
        """Return the state that `save` wrote."""
        del header
        n = arrays["theta"].size
        shapes = {"theta": (n,), "factor": (n, n), "scale": (n,), "tally": (4,)}
        for name, shape in shapes.items():
            array = arrays[name]
            if array.shape != shape or array.dtype != np.float64 or not np.isfinite(array).all():
                raise FileFormatError(f"its array `{name}` is not of finite floats of shape {shape}.")
        return cls(**{name: arrays[name] for name in shapes})


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RecursionHistory:
    """The course of a recursion.

    Attributes:
        error: (rows,) epsilon(t+1) of Eq. 30, before each row was taken in.
        theta: (rows, n) parameters after it.
        covariance: (rows, n) diagonal of F after it.
    """

    error: Vector
    theta: Matrix
    covariance: Matrix


@dataclass(frozen=True, slots=True, kw_only=True)
class Recursion:
    """Eq. 28-30 in Bierman's form, with forgetting and what keeps it safe.

    Attributes:
        parameters: n, length of theta.
        forgetting: lambda in (0, 1]; 1 is Eq. 29, below it is CFF-RLS.
        covariance_bound: on the trace of F, kept by shrinking it; without excitation, forgetting lets F grow without
            end (from 0.99 on a constant input to 1e30 within minutes). 0 for none.
        dead_zone: errors up to this size [unit of y] change nothing.
        poles: how many of the first parameters are a_1, a_2, ... of Eq. 23 to keep stable; 0 for no projection.
        pole_radius: bound on those poles; a step beyond it is halved until it is within.
        start_covariance: diagonal of F(0).
    """

    parameters: int
    forgetting: float = 1.0
    covariance_bound: float = 0.0
    dead_zone: float = 0.0
    poles: int = 0
    pole_radius: float = 1.0
    start_covariance: float = EXACT_START

    def __post_init__(self) -> None:
        require_whole("parameters", self.parameters, 1, 10_000)
        require_forgetting(self.forgetting)
        require_between("covariance_bound", self.covariance_bound, 0.0, 1e300)
        require_between("dead_zone", self.dead_zone, 0.0, 1e300)
        require_whole("poles", self.poles, 0, self.parameters)
        require_between("pole_radius", self.pole_radius, 1e-3, 1.0)
        require_positive("start_covariance", self.start_covariance)

    def initial_state(self, theta: ArrayLike | None = None) -> RecursionState:
        """Return the state before any row, from `theta` (n,) or zero."""
        n = self.parameters
        start = self.start_covariance
        if self.covariance_bound > 0.0:
            start = min(start, self.covariance_bound / n)
        return RecursionState(
            theta=np.zeros(n) if theta is None else finite_vector("theta", theta, n).copy(),
            factor=np.zeros((n, n)),
            scale=np.full(n, start),
            tally=np.zeros(4),
        )

    def step(self, state: RecursionState, phi: ArrayLike, y: float) -> RecursionState:
        """Take one row in: regressor `phi` (n,) and output `y`; a NaN in either changes nothing."""
        row = np.ascontiguousarray(phi, dtype=np.float64).reshape(1, -1)
        return self.run(state, row, np.array([y], dtype=np.float64))[0]

    def run(
        self, state: RecursionState, regressors: Matrix, targets: Vector, *, keep: bool = False
    ) -> tuple[RecursionState, RecursionHistory]:
        """Take all rows in; return the state and its course, which is empty unless `keep`.

        Args:
            state: to start from; it stays as it is.
            regressors: (rows, n).
            targets: (rows,).
            keep: return the course as well.
        """
        Phi, y = self._rows(regressors, targets)
        after = RecursionState(
            theta=state.theta.copy(), factor=state.factor.copy(), scale=state.scale.copy(), tally=state.tally.copy()
        )
        n = self.parameters
        course = np.zeros((len(y) if keep else 0, 1 + 2 * n))
        guards = np.array([self.forgetting, self.covariance_bound, self.dead_zone, self.poles, self.pole_radius])
        load_functions(_RUNTIME).ud_guarded(Phi, y, after.theta, after.factor, after.scale, guards, after.tally, course)
        if not np.isfinite(after.theta).all():
            raise DataError("the recursion is no longer finite; scale the regressors to the order of one.")
        return after, RecursionHistory(error=course[:, 0], theta=course[:, 1 : 1 + n], covariance=course[:, 1 + n :])

    def _rows(self, regressors: Matrix, targets: Vector) -> tuple[Matrix, Vector]:
        Phi = np.ascontiguousarray(regressors, dtype=np.float64)
        y = np.ascontiguousarray(targets, dtype=np.float64)
        if Phi.ndim != 2 or Phi.shape[1] != self.parameters or y.shape != (len(Phi),):
            raise DataError(
                f"`regressors` must be (rows, {self.parameters}) and `targets` (rows,); got {Phi.shape} and {y.shape}."
            )
        there = np.isfinite(Phi).all(axis=1) & np.isfinite(y)
        return (Phi, y) if there.all() else (np.ascontiguousarray(Phi[there]), y[there])


def require_forgetting(value: float) -> None:
    """Raise SettingsError unless `value` is in (0, 1]."""
    require_positive("forgetting", value)
    if value > 1.0:
        raise SettingsError(f"`forgetting` must be above 0 and at most 1, where 1 forgets nothing; got {value:g}.")
