"""A controller that is told the payload by its observer: in the loops of a verification."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import control
import numpy as np
import pytest

from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.identification import GreyBox
from softneck.loop import BlockPart, Loop, run_loop
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal
from softneck.verification import make_requirements, verify

from ..references import StepReference

TS, POLE, GAIN = 0.02, 5.3, math.radians(5.5)


def neck() -> LinearNeck:
    a = math.exp(-POLE * TS)
    axis = control.TransferFunction([GAIN * (1.0 - a)], [1.0, -a, 0.0, 0.0, 0.0, 0.0], TS)
    return LinearNeck(pitch=axis, roll=axis)


PAPER = VirtualNeck(NeckParameters.paper())
ASKED = {
    "sampling": {"plants": 20, "search_generations": 0},
    "sim": {"necks": 1, "payloads_kg": [0.0, 1.0], "orientations_deg": [45.0], "duration_s": 2.5},
}


def log(motion: str, payload: float, rows: int = 800, seed: int = 1) -> Recording:
    found = record(signal(motion), PAPER, seed=seed, payload=payload).rows(0, rows)
    return found.with_channels(payload=np.full(rows, payload))


@pytest.mark.slow
def test_verify_has_the_estimate_of_an_observer_in_the_loops_of_an_mpc() -> None:
    """By hand, to the bit: the observer over a model of several payloads tells the controller what it thinks."""
    model = GreyBox(evaluations=2, sensor_delay=2).fit([log("eq22", 0.0), log("eq22", 1.0)])
    observer = KalmanSettings().design(model)
    settings = MpcNumbers(bandwidth=6.0, minimum_tautness=0.5, payload_tautness=2.0)
    controller, deaf = settings.design(neck()), replace(settings, payload_tautness=0.0).design(neck())
    found = verify(controller, {"line": neck()}, make_requirements(ASKED), observer=observer)
    runs: list[Any] = found.evidence.necks
    assert [run.payload for run in runs] == [0.0, 1.0]
    size = math.radians(float(found.requirements.sim["size_deg"]))
    for run in runs:
        assert run.result is not None
        ends = size * math.cos(run.orientation), size * math.sin(run.orientation)
        at = float(np.flatnonzero(run.result["pitch_reference"])[0]) * 0.02
        by_hand, not_told = (run_loop(Loop(
            plant=BlockPart(PAPER.block(noise_seed=run.seed)), controller=BlockPart(one.block()),
            observer=BlockPart(observer.block()), plant_inputs={"payload": run.payload},
            reference=StepReference(pitch=ends[0], roll=ends[1], at=at), duration=at + 2.5,
        )) for one in (controller, deaf))  # fmt: skip
        np.testing.assert_array_equal(by_hand["pitch"], run.result["pitch"])
        # An estimate by which the controller acts: that of the light neck is another than that of the heavy one.
        np.testing.assert_array_equal(by_hand["payload_estimate"], run.result["payload_estimate"])
        # What it is told matters: one that does not listen moves the motors otherwise.
        assert not np.array_equal(not_told["motor_setpoint_1"], run.result["motor_setpoint_1"])
    light, heavy = (run.result["payload_estimate"] for run in runs)
    assert not np.array_equal(light, heavy)
    assert "payload at its start value" in found.evidence.not_computed["steps of other payloads"]
