"""The live view's `validity`: of the model that stands for the plant in the loop, told what the drives measure."""

from __future__ import annotations

import math

import pytest

from softneck.drives.master._gate import sample_of
from softneck.drives.master._measured import Measurement
from softneck.drives.running._pilot import LoopPilot
from softneck.loop import BlockPart, Loop

from ..cosim.test_validity import model, trained
from .test_any_robot import Ports

NAMES = [f"motor_setpoint_{j}" for j in (1, 2, 3)]


def held(_: float) -> tuple[float, float, float]:
    return (0.0, 0.0, 0.0)


def pilot(plant: BlockPart) -> LoopPilot:
    asked = ["pitch_reference", "roll_reference", "pitch", "roll"]
    controller = Ports("controller", asked, NAMES)
    loop = Loop(plant=plant, controller=controller, reference=held, duration=1.0)
    made = LoopPilot(loop)
    made.start()
    return made


def test_a_pilot_knows_how_far_the_motors_are_from_the_model_s_training() -> None:
    made = pilot(BlockPart(trained().block()))
    tilt, seen = sample_of((0.0, 0.0)), []
    for index in range(40):
        where = 0.0 if index < 20 else 30.0
        made.step(Measurement(index, tilt, True, (0.0, where, 0.0)))
        seen.append(made.validity)
    # One sample late: what follows from the positions of now holds at the next.
    assert min(seen[1:20]) > 0.5
    assert max(seen[22:]) < 0.2


def test_a_pilot_tells_what_its_outputs_are_wanted_to_be() -> None:
    """The supervisor compares the loop with it, in the order of the outputs, without the co-contraction."""
    asked = ["pitch_reference", "roll_reference", "pitch", "roll"]
    plant = BlockPart(model().block())
    made = LoopPilot(
        Loop(
            plant=plant,
            controller=Ports("controller", asked, NAMES),
            reference=lambda t: (t, -2.0 * t, 0.5),
            duration=1.0,
        )
    )
    made.start()
    for index in range(3):
        made.step(Measurement(index, sample_of((0.0, 0.0)), True, (0.0, 0.0, 0.0)))
        t = index * made.sample_time
        assert made.reference == (t, -2.0 * t)


def test_what_is_no_model_has_none() -> None:
    plant = Ports("plant", NAMES, ["pitch", "roll", *(f"motor_position_{j}" for j in (1, 2, 3))])
    made = pilot(plant)  # pyright: ignore[reportArgumentType]
    made.step(Measurement(0, sample_of((0.0, 0.0)), True, (0.0, 0.0, 0.0)))
    assert math.isnan(made.value("plant.validity"))
    assert math.isnan(made.validity)


@pytest.mark.parametrize("kind", ["fmu", "a model of before"])
def test_where_nothing_says_it_the_view_shows_a_dash_and_not_0(kind: str) -> None:
    ports = [port.name for port in model().block().outputs]
    plant = Ports("plant", NAMES, ports) if kind == "fmu" else BlockPart(model().block())
    made = pilot(plant)  # pyright: ignore[reportArgumentType]
    made.step(Measurement(0, sample_of((0.0, 0.0)), True, (0.0, 0.0, 0.0)))
    assert made.value("plant.validity") == 0.0
    assert math.isnan(made.validity)
