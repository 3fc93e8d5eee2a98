"""What a loop says as the master's pilot."""

from __future__ import annotations

from types import SimpleNamespace

from softneck.drives.master._gate import sample_of
from softneck.drives.master._master import Measurement
from softneck.drives.running._pilot import LoopPilot, RunLog
from softneck.loop import BlockPart, Loop

from ..cosim.test_validity import model
from .test_any_robot import Ports

NAMES = [f"motor_setpoint_{j}" for j in (1, 2, 3)]


def pilot() -> LoopPilot:
    plant = BlockPart(model().block())
    asked = ["pitch_reference", "roll_reference", "pitch", "roll"]
    controller = Ports("controller", asked, NAMES)
    return LoopPilot(Loop(plant=plant, controller=controller, reference=lambda t: (t, -2.0 * t, 0.5), duration=1.0))


def test_a_pilot_tells_what_its_outputs_are_wanted_to_be() -> None:
    """The supervisor compares the loop with it, in the order of the outputs, without the co-contraction."""
    made = pilot()
    made.start()
    for index in range(3):
        made.step(Measurement(index, sample_of((0.0, 0.0)), True, (0.0, 0.0, 0.0)))
        t = index * made.sample_time
        assert made.reference == (t, -2.0 * t)


def test_a_row_has_what_was_wanted_commanded_and_measured_each_under_its_own_name() -> None:
    made = pilot()
    made.start()
    log = RunLog(made, truth=False)
    for index in range(3):
        made.step(Measurement(index, sample_of((0.1, -0.2)), True, (1.0, 2.0, 3.0)))
        master = SimpleNamespace(positions=(1.0, 2.0, 3.0), tensions=(4.0, 5.0, 6.0), ran=True, index=index,
                                 tilt=SimpleNamespace(values=(0.1, -0.2), rates=(0.3, 0.4)))  # fmt: skip
        t = index * made.sample_time
        row = log.take(t, master, None)  # pyright: ignore[reportArgumentType]
        assert row is not None
        told = {name: value for name, value in row.items() if name not in NAMES}
        assert told == {
            "pitch_reference": t, "roll_reference": -2.0 * t, "cocontraction_reference": 0.5,
            "motor_position_1": 1.0, "motor_position_2": 2.0, "motor_position_3": 3.0,
            "tension_estimate_1": 4.0, "tension_estimate_2": 5.0, "tension_estimate_3": 6.0,
            "pitch_measured": 0.1, "roll_measured": -0.2, "pitch_rate_measured": 0.3, "roll_rate_measured": 0.4,
        }  # fmt: skip
        assert set(NAMES) < set(row)
        # A cycle between two samples adds none.
        assert log.take(t, master, None) is None  # pyright: ignore[reportArgumentType]
