"""What a nonlinear predictive controller computes once: its problem in numbers, and the arrays of its runtime."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, to_si
from softneck.identification import Model

from ._nmpc_state_runtime import NMPC_NO_BOUND
from ._prediction import idle_moves
from ._scale import TAUTNESS_LEVER, scale_numbers

# Scaled seconds without measurement until the motors hold, and after which a model has settled.
_COAST, _SETTLE = 0.5, 4.0
# On violations of soft limits against errors of the angles, squared; iterations of the QP's solver.
SLACK_WEIGHT, BUDGET = 1e3, 200


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NonlinearProblem:
    """What is asked, in numbers, condensed to the moves z of the motors (Bock 1983; Diehl et al. 2005, sec. 3).

        min  sum_i w_i |y_i(z) - t_i|^2 + lambda |z - a|^2 + rho sum_i (delta_i(z) - c)^2

    with y_i the model's free run and t_i the reference less the estimated disturbance.

    Attributes:
        model: that is predicted.
        horizon: N, samples from now.
        starts: samples at which the motors may move.
        T: (outputs + 1, motors) of Eq. 9-11, of a neck with 3 motors and 2 outputs.
        T_inverse: (motors, outputs + 1).
        weights: (N, outputs) on angle errors [1/rad^2].
        move_weight: lambda.
        cocontraction_weight: rho.
        look: samples by which the observer is ahead of its sensor.
    """

    model: Model
    horizon: int
    starts: tuple[int, ...]
    T: Matrix
    T_inverse: Matrix
    weights: Matrix
    move_weight: float
    cocontraction_weight: float
    look: int = 0

    @property
    def levels(self) -> Matrix:
        """(kept, motors) co-contraction, and what else of the motors moves no output and is kept at zero."""
        return np.vstack([self.T[-1:], idle_moves(self.T)])


def estimate_gains(pole: float, window: int) -> Matrix:
    """Return (2, window): level and rate of the disturbance of now from what the model missed, newest first.

    Of all `o(k+1) = o(k) + r(k)`, `r(k+1) = a r(k)` the one nearest to the last `window` residuals, in least squares:
    with the model's inputs known and its state that of its free run the estimation over the horizon is linear.

    Args:
        pole: a, the plant's slowest.
        window: residuals, at least 2.
    """
    back = np.arange(window)
    # i samples ago the level was lower by the rates since then, r(k-j) = a^-j r(k).
    since = np.concatenate([[0.0], np.cumsum(pole ** -back[1:].astype(float))])
    regressor = np.column_stack([np.ones(window), -since])
    return np.linalg.pinv(regressor)


def disturbance_ahead(pole: float, horizon: int) -> Matrix:
    """Return (horizon, 2): what level and rate of now make of the next samples."""
    i = np.arange(1, horizon + 1)
    return np.column_stack([np.ones(horizon), (1.0 - pole**i) / (1.0 - pole)])


def reference_slopes(problem: NonlinearProblem, delay: int) -> Matrix:
    """Return (moves, path): what makes references to come, over horizon and dead time, to moves that they ask for."""
    p, L = problem, problem.horizon + delay + 1
    ends = (*p.starts[1:], p.horizon)
    middles = np.array([-0.5, *(0.5 * (a + b) for a, b in zip(p.starts, ends, strict=True))]) + delay
    places = np.clip(middles, 0.0, L - 1.0)
    low = np.minimum(np.floor(places).astype(int), L - 2)
    weights = np.zeros((places.size, L))
    weights[np.arange(places.size), low] += 1.0 - (places - low)
    weights[np.arange(places.size), low + 1] += places - low
    return np.diff(weights, axis=0)


def controller_arrays(controller: Any) -> tuple[Matrix, ...]:
    """Return the controller's own arrays, in the order of `_nmpc_runtime`; those of the model stand behind them."""
    s, p, plant, Ts = controller.settings, controller.problem(), controller.near_rest, controller.sample_time
    block, m = controller.model.block(), len(plant.axes)
    start = block.initial_state(use_measurement=0.0, noise_std=0.0)
    pole = max(float(-axis.denominator[1]) for axis in plant.axes)
    ahead = round(s.preview / Ts)
    lead = min(round(s.reference_time / Ts), ahead)
    slopes = reference_slopes(p, max(0, max(axis.delay for axis in plant.axes) - p.look))
    asked_at = np.minimum(np.arange(1, slopes.shape[1] + 1) + lead, max(ahead, 1)) - 1
    slack = 0.0 if s.angle_limit is None else SLACK_WEIGHT * float(p.weights[0].max())
    coast, settle = (max(1, round(time / plant.axes[0].sample_time)) for time in (_COAST, _SETTLE))
    per = to_si(controller.robot.motors.unit)[0] / plant.scaling.motor_unit
    scale = scale_numbers(plant, controller.limits)
    constants = np.array([
        Ts, p.horizon, s.window, ahead, lead, math.exp(-Ts / s.reference_time) if s.reference_time > 0.0 else 0.0,
        p.move_weight, p.cocontraction_weight, slack, s.angle_limit or 0.0, BUDGET, coast, settle, len(block.outputs),
        -NMPC_NO_BOUND if s.minimum_tautness is None else per * s.minimum_tautness, TAUTNESS_LEVER, p.look,
        # The redefined inputs' units are no numbers of this runtime.
        *scale[: max(0, len(scale) - m)],
    ])  # fmt: skip
    return (
        constants, np.array(p.starts, dtype=np.float64), p.T, p.levels, p.weights, estimate_gains(pole, s.window),
        disturbance_ahead(pole, p.horizon), slopes,
        p.T_inverse[:, :-1] / np.array([axis.static_gain for axis in plant.axes]), asked_at.astype(np.float64),
        start.parameters,
    )  # fmt: skip
