"""What a nonlinear predictive controller computes once: references, disturbance, in the order of the horizon."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix
from softneck.identification import Model

from ._nmpc_state_runtime import NMPC_NO_BOUND
from ._prediction import idle_moves
from ._scale import TAUTNESS_LEVER

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
        scale: what `scale_numbers` returns, without the units of the redefined inputs.
        motor_unit: of the motors [SI].
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
    scale: tuple[float, ...] = ()
    motor_unit: float = 1.0
    look: int = 0

    @property
    def motors(self) -> int:
        """Number of motors."""
        return self.T.shape[1]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.T.shape[0] - 1

    @property
    def variables(self) -> int:
        """Number of moves of all motors."""
        return self.motors * len(self.starts)

    @property
    def levels(self) -> Matrix:
        """(kept, motors) co-contraction, and what else of the motors moves no output and is kept at zero."""
        return np.vstack([self.T[-1:], idle_moves(self.T)])

    def spread(self) -> Matrix:
        """Return (motors N, nz): which moves make the set-points of each sample."""
        rows = np.array([[float(start <= i) for start in self.starts] for i in range(self.horizon)])
        return np.kron(rows, np.eye(self.motors))


class Preparation:
    """Filters over the horizon, the moves that a moving reference asks for itself, and the disturbance's gains."""

    def __init__(self, controller: Any) -> None:
        """Prepare `controller`."""
        s, Ts = controller.settings, controller.sample_time
        p = self.problem = controller.problem()
        plants = self.plants = controller.plants()
        pole = max(float(-plant.denominator[1]) for plant in plants)
        self.gains = estimate_gains(pole, s.window)
        self.future = disturbance_ahead(pole, p.horizon)
        self.ahead = round(s.preview / Ts)
        self.keep = math.exp(-Ts / s.reference_time) if s.reference_time > 0.0 else 0.0
        self.lead = min(round(s.reference_time / Ts), self.ahead)
        delay = max(0, max(plant.delay for plant in plants) - p.look)
        L = p.horizon + delay + 1
        i = np.arange(1, L + 1)
        self.asked_at = np.minimum(i + self.lead, max(self.ahead, 1)) - 1
        ends = (*p.starts[1:], p.horizon)
        middles = np.array([-0.5, *(0.5 * (a + b) for a, b in zip(p.starts, ends, strict=True))]) + delay
        places = np.clip(middles, 0.0, L - 1.0)
        low = np.minimum(np.floor(places).astype(int), L - 2)
        weights = np.zeros((places.size, L))
        weights[np.arange(places.size), low] += 1.0 - (places - low)
        weights[np.arange(places.size), low + 1] += places - low
        self.slopes = np.diff(weights, axis=0)
        self.inverse = p.T_inverse[:, :-1] / np.array([plant.static_gain for plant in plants])


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


def controller_arrays(controller: Any) -> tuple[Matrix, ...]:
    """Return the controller's own arrays, in the order of `_nmpc_runtime`; those of the model stand behind them."""
    s, prepared = controller.settings, Preparation(controller)
    p, block = prepared.problem, controller.model.block()
    start = block.initial_state(use_measurement=0.0, noise_std=0.0)
    slack = 0.0 if s.angle_limit is None else SLACK_WEIGHT * float(p.weights[0].max())
    coast, settle = (max(1, round(time / prepared.plants[0].sample_time)) for time in (_COAST, _SETTLE))
    taut = -NMPC_NO_BOUND if s.minimum_tautness is None else controller.motor_factor * s.minimum_tautness / p.motor_unit
    constants = np.array([
        controller.sample_time, p.horizon, s.window, prepared.ahead, prepared.lead, prepared.keep, p.move_weight,
        p.cocontraction_weight, slack, s.angle_limit or 0.0, BUDGET, coast, settle,
        len(block.outputs), taut, TAUTNESS_LEVER, p.look, *p.scale,
    ])  # fmt: skip
    return (
        constants, np.array(p.starts, dtype=np.float64), p.T, p.levels, p.weights, prepared.gains, prepared.future,
        prepared.slopes, prepared.inverse, prepared.asked_at.astype(np.float64), start.parameters,
    )  # fmt: skip
