"""Interpolation of gain and pole over the inclination, fitted and judged in free run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, to_si
from softneck.core._shown import Shown
from softneck.robot import Robot
from softneck.runtime import load_functions
from softneck.signals import Recording, redefine

from ..models._model import WARM_UP
from ..models._scores import nrmse_fit
from ._local_models import tilt

_RUNTIME = "softneck.identification.uncertainty._lpv_runtime"
_FASTEST = 60.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Lpv(Shown):
    """Gain and pole of each axis over the inclination, linear between knots.

    Attributes:
        knots: (m,) inclinations [rad]; one knot is a linear time-invariant model.
        gains: (outputs, m) angle over redefined input [rad/rad].
        poles: (outputs, m) [1/s].
        delays: (outputs,) samples.
        source: "set_points" or "positions".
        directions: (outputs, motors) of the motors in each redefined input of another robot than the neck.
    """

    knots: Vector
    gains: Matrix
    poles: Matrix
    delays: Vector
    source: str = "set_points"
    directions: Matrix | None = None

    def simulate(self, recording: Recording, *, warm_up: int = WARM_UP) -> Matrix:
        """Free run: return the angles (time, outputs) [rad]; each run starts from `warm_up` measured rows."""
        parts = []
        for run in recording.runs():
            motors = run.motor_positions if self.source == "positions" else run.set_points
            U = redefine(motors)[:, :2] if self.directions is None else motors @ self.directions.T
            Y = np.zeros((len(run), len(self.gains)))
            load_functions(_RUNTIME).lpv_simulate(
                self.knots, self.gains, self.poles, self.delays, run.sample_time,
                np.ascontiguousarray(U), run.outputs, warm_up, Y,
            )  # fmt: skip
            parts.append(Y)
        return np.concatenate(parts)

    def fit(self, recording: Recording) -> tuple[float, ...]:
        """Return the free-run fits [%] of the angles, the first 25 rows of each run left out."""
        scored = np.concatenate([np.arange(len(run)) for run in recording.runs()]) >= WARM_UP
        Y, y = self.simulate(recording)[scored], recording.outputs[scored]
        return tuple(nrmse_fit(y[:, axis], Y[:, axis]) for axis in range(len(self.gains)))


def require_inclination(robot: Robot, what: str) -> None:
    """Raise SettingsError where `what` is asked of a robot whose outputs are not one or two angles."""
    names, unit = robot.outputs.names, robot.outputs.unit
    if len(names) > 2 or to_si(unit)[1] != "rad":
        raise SettingsError(
            f"{what} is for robots with one or two angles; robot {robot.label()} has {', '.join(names)} in {unit}."
        )


def fit_lpv(recordings: Sequence[Recording], start: Lpv, knots: int) -> Lpv:
    """Fit gains and poles at knots spread over the inclinations met, in free run, from an invariant model.

    Raises:
        DataError: the inclination hardly moves.
    """
    from scipy.optimize import least_squares

    met = np.concatenate([tilt(r.outputs)[0] for r in recordings])
    met = met[np.isfinite(met)]
    at = np.unique(np.quantile(met, np.linspace(0.02, 0.98, knots))) if knots > 1 else np.zeros(1)
    if at.size < knots or (knots > 1 and np.diff(at).min() < 1e-3):
        raise DataError(f"the inclination hardly moves, so {knots} knots over it are too many; take fewer `lpv_knots`.")
    mean = start.gains.mean(axis=1)
    size, sign = np.abs(mean), np.sign(mean)[:, None]
    first = np.concatenate([np.repeat(size, knots), np.repeat(start.poles.mean(axis=1), knots)])
    target = [r.outputs for r in recordings]

    def model(x: Vector) -> Lpv:
        gains, poles = np.exp(x).reshape(2, size.size, knots)
        poles = np.minimum(poles, _FASTEST)
        return replace(start, knots=at, gains=sign * gains, poles=poles)

    def residual(x: Vector) -> Vector:
        tried = model(x)
        errors = [tried.simulate(r) - y for r, y in zip(recordings, target, strict=True)]
        e = np.concatenate([error.ravel() for error in errors])
        return np.where(np.isfinite(e), e, 0.0)

    least = 1e-6 if start.directions is None else 1e-12  # of a gain over pascals
    found = least_squares(residual, np.log(np.maximum(first, least)), max_nfev=40, x_scale=0.3, ftol=1e-6)
    return model(np.asarray(found.x))
