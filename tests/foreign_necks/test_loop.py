"""Foreign necks close loops as the virtual neck does."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest

from softneck.design import PiSettings
from softneck.estimation import LinearNeck
from softneck.loop import BlockPart, Loop, run_loop
from softneck.signals import SAMPLE_TIME

from ..references import StepReference
from .necks import NECKS, ForeignNeck


@pytest.fixture(scope="module")
def controller() -> BlockPart:
    """A cautious PI controller of the paper's neck (Eq. 31)."""
    a = math.exp(-5.293 * SAMPLE_TIME)
    tf = control.TransferFunction([math.radians(27.69) / 5.293 * (1 - a)], [1.0, -a, 0, 0, 0, 0], SAMPLE_TIME)
    return BlockPart(PiSettings().design(LinearNeck(pitch=tf, roll=tf)).block())


@pytest.mark.slow
@pytest.mark.parametrize("name", NECKS)
def test_a_loop_with_integral_action_reaches_its_reference(name: str, controller: BlockPart) -> None:
    plant = BlockPart(ForeignNeck(name=name, noise=False).block())
    reference = StepReference(pitch=math.radians(8.0), at=1.0)
    result = run_loop(Loop(plant=plant, controller=controller, reference=reference, duration=15.0))
    pitch = np.degrees(result["pitch"])
    # Backlash and dead zones keep a loop circling; Euler angles and a sensor that yaws are 0.01 deg off here.
    assert abs(pitch[-150:].mean() - 8.0) < 0.1
