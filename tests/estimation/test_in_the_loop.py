"""The filter in the closed loop with the virtual neck, whose inclinometer drops out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.identification import Model, Rls
from softneck.loop import BlockPart, Loop, LoopResult, run_loop
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import signal

from ..references import StepReference

TS = 0.02
# A dropout of 0.1 s on average every 2 s.
NECK = replace(NeckParameters.paper(), dropout_rate=0.5, dropout_time=0.1)


@pytest.fixture(scope="module")
def model() -> Model:
    return Rls().fit([record(signal("eq22", duration=40.0), VirtualNeck(NeckParameters.paper()), seed=1)])


def closed(model: Model, settings: KalmanSettings) -> LoopResult:
    return run_loop(
        Loop(
            plant=BlockPart(VirtualNeck(NECK).block(noise_seed=3)),
            controller=BlockPart(PiSettings().design(model).block()),
            observer=BlockPart(settings.design(model).block()),
            reference=StepReference(pitch=np.radians(15.0), at=1.0),
            duration=8.0,
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [KalmanSettings(), KalmanSettings(form="gyro")],
    ids=["model", "gyro"],
)
def test_every_form_closes_the_loop_over_dropouts(model: Model, settings: KalmanSettings) -> None:
    result = closed(model, settings)
    last = result.time > 6.0
    # Integral action takes the mean to 15 deg whatever the filter; noise of 0.05 deg and drift of the neck remain.
    assert np.degrees(np.mean(result["pitch"][last])) == pytest.approx(15.0, abs=0.5)
    assert np.isfinite(result["pitch_estimate"]).all()


@pytest.mark.slow
def test_a_model_as_plant_without_noise_does_not_lock_the_loop(model: Model) -> None:
    """At rest its measurement repeats to the last bit; a filter that called it frozen would stop the controller."""
    result = run_loop(
        Loop(
            plant=BlockPart(model.block()),
            controller=BlockPart(PiSettings().design(model).block()),
            observer=BlockPart(KalmanSettings().design(model).block()),
            reference=StepReference(pitch=np.radians(15.0), at=1.0),
            duration=6.0,
        )
    )
    assert np.degrees(result["pitch"][-1]) == pytest.approx(15.0, abs=0.2)
