"""The regressor of a set: its lags, the weights of its components, and whose motor positions are in it."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.identification import PAPER_EQ21, SetMembership, fit_drive
from softneck.identification.models._regressors import lag_table

from ...data import neck_recording


def test_lags_of_eq21_are_the_papers_form() -> None:
    np.testing.assert_array_equal(lag_table((1,), (2, 3), (3,)), PAPER_EQ21)
    model = SetMembership(epsilon=0.01, output_weight=10.0).fit(neck_recording(500))
    np.testing.assert_array_equal(model.arrays["table"], PAPER_EQ21)
    np.testing.assert_array_equal(model.arrays["scale"], [10.0, *9 * [1.0]])


def test_weights_and_epsilon_are_chosen_among_all_that_are_tried() -> None:
    chosen = SetMembership().fit(neck_recording(700))
    curve = chosen.findings["hold_out_curve"]
    assert chosen.findings["motor_weight"] in (1.0, 3.0, 10.0)
    # 4 weights of outputs, then 2 of motors, with 4 epsilons each; the first row is the best.
    assert len(curve) == 24
    assert curve[0][3] == max(row[3] for row in curve)


@pytest.mark.slow
def test_a_residual_set_is_made_of_the_motors_that_every_simulation_has() -> None:
    """Form `residual` does not look at logged motors beyond the drive model they give."""
    recording = neck_recording(700)
    drive = fit_drive(recording)
    simulated = drive.simulate(recording.set_points, recording.set_points[0])
    spoilt = recording.with_channels(**{f"motor_position_{j + 1}": simulated[:, j] for j in range(3)})
    estimator = SetMembership(form="residual", epsilon=0.02, output_weight=5.0)
    # The drives identified from their own simulation are the same to rounding.
    np.testing.assert_allclose(
        estimator.fit(recording).simulate(recording), estimator.fit(spoilt).simulate(recording), atol=1e-6
    )
