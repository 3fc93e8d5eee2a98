"""What a loop says as the master's pilot."""

from __future__ import annotations

from softneck.drives.master._gate import sample_of
from softneck.drives.master._master import Measurement
from softneck.drives.running._pilot import LoopPilot
from softneck.loop import BlockPart, Loop

from ..cosim.test_validity import model
from .test_any_robot import Ports

NAMES = [f"motor_setpoint_{j}" for j in (1, 2, 3)]


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
