"""From a nonlinear predictive controller to the arrays that `_nmpc_runtime` reads."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix

from ._nmpc_prepared import COAST, SETTLE, NonlinearController, Preparation


def controller_arrays(controller: NonlinearController) -> tuple[Matrix, ...]:
    """Return the controller's own arrays, in the order of `_nmpc_runtime`; those of the model stand behind them."""
    s, prepared = controller.settings, Preparation(controller)
    p, block = prepared.problem, controller.model.block()
    start = block.initial_state(use_measurement=0.0, noise_std=0.0)
    slack = 0.0 if s.angle_limit is None else s.slack_weight * float(p.weights[0].max())
    constants = np.array([
        controller.sample_time, p.horizon, s.window, prepared.ahead, prepared.lead, prepared.keep, p.move_weight,
        p.cocontraction_weight, slack, s.angle_limit or 0.0, s.budget, float(s.converged), COAST, SETTLE,
        len(block.outputs),
    ])  # fmt: skip
    return (
        constants, np.array(p.starts, dtype=np.float64), p.T, p.weights, prepared.gains, prepared.future,
        prepared.slopes, prepared.inverse / prepared.gain, prepared.asked_at.astype(np.float64), start.parameters,
    )  # fmt: skip
