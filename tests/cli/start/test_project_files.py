"""The files of a project: what the loop over FMUs takes from the robot."""

from __future__ import annotations

import pytest

from softneck.cli.start._project_files import _over_fmus
from softneck.robot import Robot


@pytest.mark.parametrize(("unit", "si"), [("mm", 1e-3), ("deg", 0.017453292519943295), ("rad", 1.0), ("m", 1.0)])
def test_the_noise_of_the_loop_is_the_robots_whatever_its_unit(unit: str, si: float) -> None:
    """A FMU's `noise_std` is in SI; a robot's is in the unit of its outputs."""
    robot = Robot.from_dict(
        {
            "name": "stage",
            "sample_time_s": 0.05,
            "motors": {"names": ["force"], "unit": "N", "setpoint_min": -1.0, "setpoint_max": 1.0},
            "outputs": {"names": ["x"], "unit": unit},
            "directions": {"kind": "identified"},
            "sensor": {"noise_std": 0.05},
        }
    )
    table = {"plant": {"model": "m.npz"}, "controller": {"file": "c.npz"}, "reference": {"kind": "step", "x": 1.0}}
    assert _over_fmus(table, robot)["plant"]["parameters"]["noise_std"] == pytest.approx(0.05 * si, rel=1e-15)
