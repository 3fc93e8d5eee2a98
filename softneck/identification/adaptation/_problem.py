"""The cost of an adaptation: errors of the free run over the window, and how far it leads the old free run elsewhere.

    V(theta) = sum |y - yhat(theta)|^2 / rows + strength * sum |J (theta - theta_0)|^2 / rows of the reference

J are the derivatives of the old model's free run along a reference motion over all set-points that it was trained on:
with the noise's variance J'J is the information that a fit along that motion has, and depends on no measurement. So
the second term is the Gaussian prior that such a fit leaves behind (Ljung 1999, sec. 9.2 and 11.2), in the mean of its
rows, and `strength` its weight beside the mean of the window's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording, signal

from ..models._model import WARM_UP, Model
from ..models._ports import trained_range
from ..models._unrecorded import on_motors
from ._free import Free

# A derivative by differences: far above rounding, far below what bends.
_STEP = 1e-4
# Of each number against the reference [parts of its size]: what moves nothing at all stays where it is.
_STAY = 1e-6
_STEPS, _MOST_DAMPING, _ENOUGH = 8, 1e4, 0.01
# Derivatives cost a free run for each number: so many in all, which bounds the time whatever the kind.
_RUNS = 160
# The reference lasts so long [s of a neck]: all of `mixed`'s motions, each for two seconds.
_REFERENCE = 20.0
_RAMP = 1.0


def reference(model: Model) -> Recording:
    """Return a motion over all set-points that a model was trained on, from rest; outputs are unknown but for rest."""
    trained, Ts = trained_range(model.findings), model.sample_time
    motors, outputs = len(model.robot.motors.names), model.robot.outputs.names
    low, high = trained if trained is not None else (np.full(motors, -1.0), np.full(motors, 1.0))
    own = signal("mixed", duration=_REFERENCE, seed=0)
    P = on_motors(own.set_points, motors)
    P = low + (P - P.min(axis=0)) / np.ptp(P, axis=0) * (high - low)
    seconds = np.array(model.findings.get("time_constants_s", [0.2]))
    # As many samples for another robot, each of its own time constant.
    stretch = float(np.exp(np.mean(np.log(np.maximum(seconds, 1e-9))))) / 0.2
    at = np.arange(0.0, len(P) - 1.0, max(Ts / (own.sample_time * stretch), 0.2))
    P = np.column_stack([np.interp(at, np.arange(len(P)), column) for column in P.T])
    P *= np.minimum(1.0, np.arange(len(P)) / max(_RAMP * len(P) / _REFERENCE, 1.0))[:, None]
    Y = np.full((len(P), len(outputs)), np.nan)
    Y[0] = model.block().initial_state().outputs[: len(outputs)]
    channels = dict(zip((*model.robot.set_points, *outputs), (*P.T, *Y.T), strict=True))
    return Recording(np.arange(len(P)) * Ts, Ts, channels, robot=model.robot)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """One adaptation, its free runs along the window and along the reference.

    Attributes:
        free: the numbers.
        window: to learn from.
        learnt: (time, outputs) which entries count.
        target: (time, outputs) what was measured.
        information: (n, n) J'J / rows of the reference, by sizes.
        strength: of the prior.
    """

    free: Free
    window: Recording
    learnt: np.ndarray
    target: Matrix
    information: Matrix
    strength: float

    def errors(self, z: Vector) -> Vector:
        """Return the errors that count, by numbers counted from the old ones in their sizes."""
        return (self.target - free_run(self.free.at(self.numbers(z)), self.window))[self.learnt]

    def numbers(self, z: Vector) -> Vector:
        """Return the numbers."""
        return self.free.start() + self.free.sizes() * z

    def cost(self, z: Vector, e: Vector) -> float:
        """Return V."""
        return float(e @ e / e.size + z @ self.prior @ z)

    @property
    def prior(self) -> Matrix:
        """(n, n) of the second term."""
        return self.strength * self.information

    def solve(self) -> Vector:
        """Return z of the least cost near zero: Gauss-Newton, damped where a step does not help."""
        z = np.zeros(self.free.start().size)
        e = self.errors(z)
        cost, damping = self.cost(z, e), 1e-3
        for _ in range(int(np.clip(_RUNS // len(self.free.groups()), 1, _STEPS))):
            J = derivatives(self.free, self.numbers(z), lambda model: free_run(model, self.window))[:, self.learnt].T
            A, g = J.T @ J / e.size + self.prior, J.T @ e / e.size - self.prior @ z
            found = self._step(z, cost, damping, A, g)
            if found is None:
                break
            gained = cost - found[1]
            z, cost, e, damping = found
            if gained < _ENOUGH * cost or self.free.linear:
                break
        return z

    def _step(
        self, z: Vector, cost: float, damping: float, A: Matrix, g: Vector
    ) -> tuple[Vector, float, Vector, float] | None:
        """Return the step that lowers the cost, None where none does."""
        while damping < _MOST_DAMPING:
            trial = z + np.linalg.solve(A + damping * np.diag(np.diag(A)), g)
            if self.free.sound(self.numbers(trial)):
                e = self.errors(trial)
                value = self.cost(trial, e)
                if value < cost:
                    return trial, value, e, damping / 10.0
            damping *= 10.0
        return None


def information(free: Free, motion: Recording) -> Matrix:
    """Return J'J (n, n) / entries of the old free run along `motion`, by sizes of the numbers, positive definite."""
    J = derivatives(free, free.start(), lambda model: free_run(model, motion))
    J = J.reshape(len(J), -1)
    H = J @ J.T / J.shape[1]
    return H + _STAY * max(np.trace(H) / len(H), 1e-12) * np.eye(len(H))


def free_run(model: Model, recording: Recording) -> Matrix:
    """Return the free run (time, outputs)."""
    return model.simulate(recording)[:, : recording.outputs.shape[1]]


def derivatives(free: Free, numbers: Vector, run: Callable[[Model], Matrix]) -> np.ndarray:
    """Return the derivatives (n, time, outputs) of a free run by each number over its size."""
    now, sizes = run(free.at(numbers)), free.sizes()
    J = np.zeros((numbers.size, *now.shape))
    for group in free.groups():
        moved = numbers.copy()
        for place, _ in group:
            moved[place] += _STEP * sizes[place]
        change = (run(free.at(moved)) - now) / _STEP
        for place, axis in group:
            if axis is None:
                J[place] = change
            else:
                J[place, :, axis] = change[:, axis]
    return np.nan_to_num(J, posinf=0.0, neginf=0.0)


def scored(recording: Recording) -> np.ndarray:
    """Return (time, outputs) which entries say something: measured, and not among those that align a run."""
    late = np.concatenate([np.arange(len(run)) > WARM_UP for run in recording.runs()])
    return np.isfinite(recording.outputs) & late[:, None]
