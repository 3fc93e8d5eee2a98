"""A controller does not depend on units, pace, names, order or signs: its step is the same up to the map."""

from __future__ import annotations

from functools import cache
from typing import Any

import control
import numpy as np
import pytest

import softneck
from softneck.core import Matrix, silent

from .worlds import PACES, UNITS, View, World, orders, world

_PLAIN = View()
_KINDS = ("pi", "pid", "fopi", "hinf", "lqg", "adaptive")
_ROWS = 60


@cache
def controller_of(name: str, kind: str, view: View) -> tuple[World, Any]:
    seen = world(name, view, rows=1500)
    model = softneck.identify("oe", seen.recording, train=1.0, progress=silent)
    return seen, softneck.design_controller(kind, model, any_fit=True)


def answered(seen: World, controller: Any) -> Matrix:
    """Return the set-points over their range (time, motors) of a run, as the plain view has them."""
    outputs, motors = len(seen.robot.outputs.names), len(seen.robot.motors.names)
    low, high = (np.array(seen.plant.robot["outputs"][key]) for key in ("min", "max"))
    size = np.radians(high - low) if seen.plant.robot["outputs"]["unit"] == "deg" else 1e-3 * (high - low)
    rng = np.random.default_rng(3)
    wanted, measured = 0.2 * np.ones((_ROWS, outputs)), 0.05 * rng.standard_normal((_ROWS, outputs)).cumsum(axis=0)
    signs, order = np.array(seen.view.turned or (1,) * outputs), list(seen.view.outputs or range(outputs))
    block = controller.block()
    names = [port.name for port in block.inputs]
    U = np.tile([port.start for port in block.inputs], (_ROWS, 1))
    for place, values in (("{}_reference", wanted), ("{}", measured)):
        here = (values * size * signs * seen.numbers[1])[:, order]
        for i, output in enumerate(seen.robot.outputs.names):
            U[:, names.index(place.format(output))] = here[:, i]
    state = block.initial_state()
    Y = block.run(state, U)[1][:, :motors]
    span = np.ptp([seen.plant.robot["motors"][key] for key in ("setpoint_min", "setpoint_max")])
    return seen.plain_motors(Y) / float(span)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_steps_of_blocks")
@pytest.mark.parametrize("name", ["joint", pytest.param("finger", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", _KINDS)
def test_a_controller_is_the_same_in_every_view(name: str, kind: str) -> None:
    plain = answered(*controller_of(name, kind, _PLAIN))
    assert np.ptp(plain) > 0.01
    for view in (*UNITS[name], *PACES, *orders(name)):
        other = answered(*controller_of(name, kind, view))
        # Searches over gains and weights end within 1e-6 of themselves; set-points are compared over their range.
        np.testing.assert_allclose(other, plain, atol=1e-4, err_msg=str(view))


@pytest.mark.slow
@pytest.mark.usefixtures("plain_steps_of_blocks")
@pytest.mark.parametrize("name", ["finger", "joint"])
def test_a_controller_of_ones_own_is_the_same_in_other_units_and_at_another_pace(name: str) -> None:
    def custom(view: View) -> Matrix:
        seen, pi = controller_of(name, "pi", view)
        (table,) = (pi.design[output] for output in seen.robot.outputs.names)
        K, Ti, Ts = table["gains"]["K"], table["gains"]["Ti_s"], seen.recording.sample_time
        gain = control.TransferFunction(K * np.array([1.0 + Ts / Ti, -1.0]), [1.0, -1.0], Ts)
        model = softneck.identify("oe", seen.recording, train=1.0, progress=silent)
        return answered(seen, softneck.design_controller("custom", model, any_fit=True, controller=gain))

    plain = custom(_PLAIN)
    assert np.ptp(plain) > 0.01
    for view in (*UNITS[name], *PACES):
        # As the gains that the search found.
        np.testing.assert_allclose(custom(view), plain, atol=1e-4, err_msg=str(view))


def test_a_gain_in_other_units_than_si_is_remarked() -> None:

    seen = world("finger", rows=1500)
    model = softneck.identify("oe", seen.recording, train=1.0, progress=silent)
    pi = softneck.design_controller("pi", model, any_fit=True)
    K, Ti, Ts = pi.design["flexion"]["gains"]["K"], pi.design["flexion"]["gains"]["Ti_s"], model.sample_time
    said = {}
    for unit, factor in (("Pa/rad", 1.0), ("kPa/deg", 1e-3 * np.pi / 180.0)):
        gain = control.TransferFunction(factor * K * np.array([1.0 + Ts / Ti, -1.0]), [1.0, -1.0], Ts)
        said[unit] = softneck.design_controller("custom", model, any_fit=True, controller=gain).summary()
    assert "is `controller` in SI units" not in said["Pa/rad"]
    assert "is `controller` in SI units" in said["kPa/deg"]
    assert f"K {K * np.pi / 180.0 / 1e3:.4g} kPa/deg" in pi.summary()
