"""The neck identified while it runs: one call a sample, for adaptive control."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Matrix, SettingsError, Vector, finite_vector, require_positive
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..models._model import Model
from ._rls import RecursionState, Rls, motor_arrays

_PARTS = ("theta", "factor", "scale", "tally")
_AXES = ("pitch", "roll")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OnlineState:
    """What has been seen and learnt so far.

    Attributes:
        recursions: of pitch and roll.
        inputs: (delay + nb, 3) set-points, the newest first; NaN before the first.
        outputs: (na, 2) angles, the newest first; NaN where missed.
    """

    recursions: tuple[RecursionState, RecursionState]
    inputs: Matrix
    outputs: Matrix


@dataclass(frozen=True, slots=True, kw_only=True)
class OnlineRls:
    """`Rls` sample by sample: after as many calls it has learnt what `Rls.fit` would have.

    Attributes:
        settings: with a dead time given.
        sample_time: [s].
    """

    settings: Rls
    sample_time: float

    def __post_init__(self) -> None:
        require_positive("sample_time", self.sample_time, "s")
        if self.settings.delay is None:
            raise SettingsError(
                "a dead time cannot be searched for sample by sample; give `delay`, from a model identified before."
            )

    @property
    def delay(self) -> int:
        """Dead time in samples."""
        return round((self.settings.delay or 0.0) / self.sample_time)

    def initial_state(self) -> OnlineState:
        """Return the state before anything was seen."""
        recursion = self.settings.recursion()
        return OnlineState(
            recursions=(recursion.initial_state(), recursion.initial_state()),
            inputs=np.full((self.delay + self.settings.nb, 3), np.nan),
            outputs=np.full((self.settings.na, 2), np.nan),
        )

    def step(self, state: OnlineState, set_points: ArrayLike, measured: ArrayLike) -> OnlineState:
        """Learn from what is known at t_k: set-points (3,) held from now on, and measured pitch and roll (2,) [rad].

        A missed angle is NaN; rows that would need it are left out.
        """
        u = finite_vector("set_points", set_points, 3)
        y = np.asarray(measured, dtype=np.float64).ravel()
        if y.size != 2:
            raise DataError(f"`measured` must have 2 entries (pitch, roll); got {y.size}.")
        recursion = self.settings.recursion()
        first, second = (
            recursion.step(state.recursions[axis], self._regressor(state, axis), float(y[axis])) for axis in range(2)
        )
        return OnlineState(
            recursions=(first, second),
            inputs=np.vstack([u, state.inputs[:-1]]),
            outputs=np.vstack([y, state.outputs[:-1]]),
        )

    def model(self, state: OnlineState) -> Model:
        """Return what has been learnt as a model, as `Rls.fit` returns it; its drives follow their set-points."""
        thetas = [recursion.theta for recursion in state.recursions]
        drive = np.zeros((3, 2))
        s = self.settings
        if s.structure == "siso":
            arrays = {
                "history": np.array([float(max(s.na, self.delay + s.nb))]),
                "drive": drive,
                "redefinition": redefinition_matrix(TENDON_ANGLES),
                "a": np.array([theta[: s.na] for theta in thetas]),
                "b": np.array([theta[s.na :] for theta in thetas]),
                "delay": np.full(2, float(self.delay)),
            }
        else:
            arrays = motor_arrays(s, thetas, [self.delay, self.delay], drive)
        stds = [recursion.parameter_std.tolist() for recursion in state.recursions]
        return Model(
            kind="rls",
            sample_time=self.sample_time,
            arrays=arrays,
            settings=asdict(s),
            findings={"parameter_std": stds} if np.isfinite(stds).all() else {},
        )

    def _regressor(self, state: OnlineState, axis: int) -> Vector:
        """Return phi(t-1) of Eq. 26 for one axis."""
        acting = state.inputs[self.delay :]
        own, other = -state.outputs[:, axis], -state.outputs[:, 1 - axis]
        if self.settings.structure == "siso":
            return np.concatenate([own, acting @ redefinition_matrix(TENDON_ANGLES)[axis]])
        pasts = [own, other] if self.settings.structure == "mimo" else [own]
        return np.concatenate([*pasts, acting.T.ravel()])
