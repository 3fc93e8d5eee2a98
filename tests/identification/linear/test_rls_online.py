"""Sample by sample: the same as the batch, and a model at any time."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.design import PiSettings
from softneck.identification import OnlineRls, Rls

from ...data import TRUTH, TS, neck_recording
from ...oracles.bake_off import exact


@pytest.mark.parametrize("structure", ["siso", "miso", "mimo"])
def test_stepping_through_a_record_is_the_fit(structure: str) -> None:
    r = neck_recording(500, positions=False)
    pitch = r.channels["pitch"].copy()
    pitch[[120, 300]] = np.nan
    r = r.with_channels(pitch=pitch)
    settings = Rls(structure=structure, na=2, nb=2, delay=0.06, forgetting=0.999)
    online = OnlineRls(settings=settings, sample_time=TS)
    state = online.initial_state()
    for k in range(len(r)):
        state = online.step(state, r.set_points[k], r.outputs[k])
    model, batch = online.model(state), settings.fit(r)
    # The same rows in the same order.
    for name in ("a", "b") if structure == "siso" else ("A", "B", "K"):
        np.testing.assert_allclose(model.arrays[name], batch.arrays[name], rtol=0, atol=1e-12)
    # What is learnt online knows no training to compare with: validity is 0.
    np.testing.assert_allclose(model.simulate(r)[:, :-1], batch.simulate(r)[:, :-1], rtol=0, atol=1e-12)
    assert state.recursions[0].summary().startswith("recursion: ")


def test_a_controller_can_be_designed_anew_while_it_runs() -> None:
    r = neck_recording(400, noise=1e-4)
    online = OnlineRls(settings=Rls(delay=0.06, forgetting=0.995, covariance_bound=1e4), sample_time=TS)
    state = online.initial_state()
    for k in range(len(r)):
        state = online.step(state, r.set_points[k], r.outputs[k])
    model = online.model(state)
    assert model.arrays["a"][0, 0] == pytest.approx(-TRUTH.pole[0], abs=0.01)
    assert PiSettings().design(exact(model)).design["pitch"]["dead_time_s"] == pytest.approx(0.06)


def test_what_is_wrong_is_named() -> None:
    with pytest.raises(SettingsError, match="a dead time cannot be searched for sample by sample; give `delay`"):
        OnlineRls(settings=Rls(), sample_time=TS)
    online = OnlineRls(settings=Rls(delay=0.0), sample_time=TS)
    with pytest.raises(DataError, match="`set_points` must have 3 entries"):
        online.step(online.initial_state(), [0.0], [0.0, 0.0])
    with pytest.raises(DataError, match="`measured` must have 2 entries"):
        online.step(online.initial_state(), [0.0, 0.0, 0.0], [0.0])
