"""Predictive control for hours: limits kept or reported, answers within their bound, nothing grows."""

from __future__ import annotations

import pytest

from softneck.design.predictive import _mpc_state_runtime as rt

from ..oracles.soak import soak, soft_controller


@pytest.mark.parametrize(
    "hours", [0.1, pytest.param(24.0, marks=[pytest.mark.slow, pytest.mark.nightly])], ids=["minutes", "a_day"]
)
def test_whatever_comes_limits_are_kept_or_reported(hours: float) -> None:
    controller = soft_controller()
    seen = soak(controller, hours, seed=7)
    assert seen.finite
    # Hard limits: rounding of sums.
    assert seen.position <= 1e-9
    assert seen.slew <= 1e-6
    assert seen.iterations <= rt.MpcArrays(controller.arrays).constants[rt.MPC_BUDGET]
    # A hundred times the solver's tolerance: beyond it an answer is not used.
    assert seen.residual <= 1e-8
    # What could not be kept was said.
    assert seen.silent == 0
    assert seen.softest > 0.0
    assert seen.said["softened"] > 0
    assert seen.said["holding"] > 0
    assert seen.said["optimal"] > 0.2 * seen.samples
    # No more than the interpreter's own pools, which come and go by pages.
    assert seen.grown < 8.0
