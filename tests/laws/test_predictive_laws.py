"""Predictive controllers of one robot in other units, at another pace, renamed, in another order and turned.

In a loop with the plant that they were designed for they give the same set-points, up to the map between the views.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softneck.core import Matrix, to_si
from softneck.design import NmpcSettings
from softneck.design.predictive._settings import MpcNumbers
from softneck.identification import Play

from .models import model_of
from .worlds import PACES, PLANTS, UNITS, View, World, orders, world

VIEWS = {
    name: [*UNITS[name], *PACES, *orders(name), View(turned_motors=(-1,) * len(plant.weights[0]))]
    for name, plant in PLANTS.items()
}


def _middle(seen: World) -> np.ndarray:
    motors = seen.robot.motors
    return to_si(motors.unit)[0] * 0.5 * (np.array(motors.setpoint_min) + np.array(motors.setpoint_max))


def looped(seen: World, controller: Any, model: Any, rows: int = 40) -> Matrix:
    """Return the set-points (rows, motors) of a step of all outputs, as the plain view has them over their range."""
    plant, block, outputs = model.block(), controller.block(), seen.robot.outputs
    m, n = len(outputs.names), len(seen.robot.motors.names)
    u = _middle(seen)
    low, high = (to_si(outputs.unit)[0] * np.array(ends) for ends in (outputs.min, outputs.max))
    given = np.array([*u, *[np.nan] * (m + n)])
    rest, outs = plant.run(plant.initial_state(use_measurement=0.0), np.tile(given, (200, 1)))
    y = outs[-1][:m]
    signs = np.array(seen.view.turned or (1,) * m)[list(seen.view.outputs or range(m))]
    # A twentieth of the range: further, the motors would all stand at their ends.
    wanted = y + 0.05 * signs * (high - low)
    common, state, told = float(u.mean()), block.initial_state(), []
    for _ in range(rows):
        state, u = block.step(state, [*wanted, common, *y, *u, 1.0, 1.0])
        rest, out = plant.step(rest, [*u, *[np.nan] * (m + n)])
        y = out[:m]
        told.append(u)
    motors = seen.plant.robot["motors"]
    size = to_si(motors["unit"])[0] * (motors["setpoint_max"] - motors["setpoint_min"])
    return seen.plain_motors(np.array(told)) / size


def mpc(seen: World) -> Matrix:
    """Return what `mpc` does in a view."""
    model = model_of(seen)
    seconds = seen.plant.time_constant * seen.recording.sample_time
    return looped(seen, MpcNumbers(bandwidth=1.2 / seconds, horizon=12, moves=3).design(model), model)


def nmpc(seen: World) -> Matrix:
    """Return what `nmpc` over `play` does in a view."""
    model = Play(degree=1).fit(seen.recording)
    return looped(seen, NmpcSettings(horizon=12, moves=3).design(model), model, rows=20)


def check(found: Matrix, plain: Matrix, near: float) -> None:
    np.testing.assert_allclose(found, plain, rtol=0, atol=near)
    assert np.abs(np.diff(plain, axis=0)).max() > 1e-3


@pytest.mark.parametrize(
    ("name", "view"),
    [
        pytest.param(name, view, marks=() if name == "finger" else (pytest.mark.slow, pytest.mark.nightly))
        for name, views in VIEWS.items()
        for view in views
    ],
)
@pytest.mark.usefixtures("plain_steps_of_blocks")
def test_mpc_is_the_same(name: str, view: View) -> None:
    # The solver ends at 1e-10 of a motor's range; a loop adds up some of its roundings.
    check(mpc(world(name, view)), mpc(world(name)), 1e-7)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("name", "view"), [(name, view) for name in ("finger", "arm") for view in VIEWS[name]])
def test_nmpc_is_the_same(name: str, view: View) -> None:
    # Fits are equal to 1e-6.
    check(nmpc(world(name, view)), nmpc(world(name)), 1e-5)
