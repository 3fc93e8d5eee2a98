"""The views themselves: each is the plain one, up to its map."""

from __future__ import annotations

import numpy as np
import pytest

from .worlds import PACES, PLANTS, UNITS, View, orders, without_limits, world


@pytest.mark.parametrize("name", PLANTS)
def test_every_view_maps_back_to_the_plain_one(name: str) -> None:
    plain = world(name)
    motors = len(plain.robot.motors.names)
    others = [View(offset=3.0), View(turned_motors=(-1,) * motors)]
    for view in (*UNITS[name], *PACES, *orders(name), *others):
        seen = world(name, view)
        # Only the rounding of a few products is left.
        near = 1e-12 * np.abs(plain.recording.set_points).max()
        np.testing.assert_allclose(seen.plain_motors(seen.recording.set_points), plain.recording.set_points, atol=near)
        near = 1e-12 * np.abs(plain.recording.outputs).max()
        np.testing.assert_allclose(seen.plain_outputs(seen.recording.outputs), plain.recording.outputs, atol=near)
        assert without_limits(seen).robot.motors.setpoint_min is None
