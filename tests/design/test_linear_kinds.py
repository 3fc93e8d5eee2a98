"""Every linear kind of model is taken by the controller's and the observer's design alike."""

from __future__ import annotations

import control
import numpy as np
import pytest

from softneck.design import PiSettings
from softneck.estimation import KalmanSettings, axis_plant
from softneck.identification import Model, OutputError, Rls

from ..data import neck_recording, slow_but
from ..oracles.bake_off import exact

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

KINDS = {
    "rls": Rls(max_delay=0.12),
    "miso": Rls(structure="miso", nb=2, max_delay=0.12),
    "oe": OutputError(max_delay=0.12),
    "oe2": OutputError(nf=2, nb=2, delay=0.06),
    "mimo": Rls(structure="mimo", delay=0.06),
}


@pytest.fixture(scope="module", params=slow_but(KINDS, ["oe", "mimo"]))
def model(request: pytest.FixtureRequest) -> Model:
    return KINDS[request.param].fit(neck_recording(1500, noise=1e-3))


def test_the_pi_closes_a_stable_loop_around_it(model: Model) -> None:
    controller = PiSettings().design(exact(model))
    for axis, name in enumerate(("pitch", "roll")):
        gains = controller.design[name]["gains"]
        K, Ti = gains["K"], gains["Ti_s"]
        pi = control.TransferFunction([K, K * (model.sample_time / Ti - 1.0)], [1.0, -1.0], model.sample_time)
        loop = control.feedback(pi * model.tf(name), 1)
        assert np.abs(control.poles(loop)).max() < 1.0, axis


def test_the_kalman_filter_follows_the_recording(model: Model) -> None:
    r = neck_recording(600, seed=9, noise=1e-3)
    found = (
        KalmanSettings(measurement_noise_std=1e-3, disturbance_noise_std=2e-4, sensor_delay=0.0)
        .design(model)
        .estimate(r)
    )
    clean = neck_recording(600, seed=9, noise=0.0)
    # It must not be worse than what was measured.
    assert np.std((found.pitch - clean.outputs[:, 0])[50:]) < 1e-3


def test_its_dead_time_stays_a_dead_time(model: Model) -> None:
    for axis, name in enumerate(("pitch", "roll")):
        plant = axis_plant(model, name)
        assert plant.delay >= 2, axis
        w = np.array([0.5, 2.0, 8.0])
        z = np.exp(1j * w * model.sample_time)
        # Splitting the poles at zero off does not change the response; polynomials of degree 6 lose a few digits.
        np.testing.assert_allclose(plant.response(w), np.asarray(model.tf(name)(z)), rtol=1e-7)
