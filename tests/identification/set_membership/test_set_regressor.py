"""The regressor of a set: its lags, the scale of its components, and whose motor positions are in it."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.identification import PAPER_EQ21, SetMembership, fit_drive
from softneck.identification.models._regressors import lag_table

from ...data import neck_recording


def test_lags_of_eq21_are_the_papers_form() -> None:
    recording = neck_recording(500)
    np.testing.assert_array_equal(lag_table((1,), (2, 3), (3,)), PAPER_EQ21)
    paper, lags = (
        SetMembership(form=form, epsilon=0.01, output_weight=10.0).fit(recording).arrays
        for form in ("paper_eq21", "lags")
    )
    assert all(paper[name].tobytes() == lags[name].tobytes() for name in paper)


def test_a_scale_counts_only_by_its_ratios() -> None:
    """Eq. 16's norm times c is a gamma of 1/c: the bounds stay."""
    recording, other = neck_recording(500), neck_recording(300, seed=7)
    scale = tuple(np.linspace(1.0, 4.0, 10))
    runs = [SetMembership(epsilon=0.01, scale=s).fit(recording) for s in (scale, tuple(8.0 * np.array(scale)))]
    # 8 is a power of two: nothing rounds differently.
    assert runs[0].simulate(other).tobytes() == runs[1].simulate(other).tobytes()
    np.testing.assert_array_equal(runs[0].arrays["bounds"][:, 0], 8.0 * runs[1].arrays["bounds"][:, 0])


def test_a_weight_and_a_vector_say_the_same() -> None:
    recording = neck_recording(500)
    weight = SetMembership(epsilon=0.01, output_weight=10.0).fit(recording)
    vector = SetMembership(epsilon=0.01, scale=(10.0,) + 9 * (1.0,)).fit(recording)
    assert all(weight.arrays[name].tobytes() == vector.arrays[name].tobytes() for name in weight.arrays)


def test_the_named_scales_are_what_they_say() -> None:
    recording = neck_recording(700)
    for rule in ("none", "std"):
        model = SetMembership(epsilon=0.01, scale=rule).fit(recording)
        if rule == "none":
            np.testing.assert_array_equal(model.arrays["scale"], np.ones(10))
        else:
            # Of the two axes only the output's spread differs, and `scale` takes the mean of both.
            np.testing.assert_allclose(model.arrays["points"][:, 1:].std(axis=2), 1.0, rtol=1e-12)
    chosen = SetMembership().fit(recording)
    curve = chosen.findings["hold_out_curve"]
    assert chosen.findings["motor_weight"] in (1.0, 3.0, 10.0)
    # 4 weights of outputs, then 2 of motors, with 4 epsilons each; the first row is the best.
    assert len(curve) == 24
    assert curve[0][3] == max(row[3] for row in curve)


def test_without_outputs_in_the_regressor_a_free_run_forgets_its_start() -> None:
    estimator = SetMembership(form="lags", output_lags=(), setpoint_lags=(1, 5, 10, 20), motor_lags=(), epsilon=0.5)
    model = estimator.fit(neck_recording(700))
    U = np.full((60, 8), np.nan)
    U[:, :3] = neck_recording(60, seed=4).set_points
    runs = [model.block().run(model.initial_state(pitch_start=p), U)[1] for p in (0.0, 0.7)]
    # Only set-points are in the regressor: not a bit of the start is left.
    assert runs[0][:, [0, 1, 5, 6, 7, 8]].tobytes() == runs[1][:, [0, 1, 5, 6, 7, 8]].tobytes()


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


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"output_lags": (1, 2)}, "form `paper_eq21` has the lags of Eq. 21; take form `lags` to set `output_lags`"),
        ({"form": "lags", "motor_lags": (0,)}, r"`motor_lags` must be different whole numbers .* got \[0\]"),
        ({"form": "lags", "motor_lags": (2, 2)}, r"`motor_lags` must be different whole numbers"),
        ({"form": "lags", "motor_lags": (1.5,)}, r"`motor_lags` must be different whole numbers"),
        ({"scale": "magic"}, "`scale` must be one of auto, none, std"),
        ({"scale": (1.0, -1.0)}, "or a list of positive numbers"),
        ({"scale": "none", "output_weight": 3.0}, "`output_weight` is a scale of its own"),
    ],
)
def test_wrong_lags_and_scales_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SetMembership(**settings)


def test_a_regressor_of_nothing_and_a_scale_of_another_length_are_refused() -> None:
    recording = neck_recording(500)
    with pytest.raises(SettingsError, match="the regressor is empty"):
        SetMembership(form="lags", output_lags=(), setpoint_lags=(), motor_lags=()).fit(recording)
    with pytest.raises(SettingsError, match="`scale` has 3 entries; the regressor has 10 components"):
        SetMembership(epsilon=0.01, scale=(1.0, 2.0, 3.0)).fit(recording)
