"""A family does not depend on units, pace, names, order or signs: its plants are the same up to the map."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import softneck
from softneck.core import Matrix, SettingsError, silent
from softneck.identification.uncertainty._family import Family
from softneck.robot import Robot

from .worlds import PACES, UNITS, View, World, orders, world

# Local models need some windows of 40 time constants, frequency responses some more.
_ROWS = 3000
_PLAIN = View()


@cache
def family_of(name: str, view: View) -> tuple[World, Family]:
    seen = world(name, view, rows=_ROWS)
    return seen, softneck.family(seen.recording, progress=silent)


def numbers(seen: World, found: Family) -> dict[str, Matrix]:
    """Return the samples, boxes and weights of each output as the plain view has them, over their own size."""
    motors, outputs = seen.numbers
    scale = np.array([outputs / motors, 1.0 / seen.view.pace, seen.view.pace])
    order = seen.view.outputs or range(len(found.axes))
    names = list(world_names(seen))
    values: dict[str, Matrix] = {}
    for i, axis in zip(order, found.axes.values(), strict=True):
        samples = axis.samples[axis.used > 0.5]
        # Operating points are listed by where they are, which changes with signs and order.
        listed = samples[np.lexsort(samples.round(9).T)]
        values[names[i]] = np.vstack([axis.nominal, axis.box, listed]) / scale
    return values


def world_names(seen: World) -> list[str]:
    return list(seen.plant.robot["outputs"]["names"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["finger", pytest.param("arm", marks=pytest.mark.nightly)])
def test_a_family_is_the_same_in_every_view(name: str) -> None:
    plain = numbers(*family_of(name, _PLAIN))
    for view in (*UNITS[name], *PACES, *orders(name)):
        seen = numbers(*family_of(name, view))
        for output, values in plain.items():
            # Iterative fits of data that differ by 2^-40 at most: they end within their own tolerance, 1e-6.
            np.testing.assert_allclose(seen[output], values, rtol=1e-6, atol=1e-9, err_msg=f"{output}, {view}")


@pytest.mark.slow
def test_weights_and_bands_are_the_same_at_another_pace_and_in_other_units() -> None:
    _, plain = family_of("finger", _PLAIN)
    for view in (UNITS["finger"][2], PACES[2]):
        _, found = family_of("finger", view)
        one, other = plain.axes["flexion"], found.axes["flexion"]
        np.testing.assert_allclose(found.frequency * view.pace, plain.frequency, rtol=1e-9)
        np.testing.assert_allclose(other.envelope, one.envelope, rtol=1e-5)
        assert found.covered("flexion") == pytest.approx(plain.covered("flexion"), rel=1e-5)
        assert set(found.measured) == set(plain.measured)
        for output, measured in plain.measured.items():
            # Weights are found by bisection to 1e-6 of themselves.
            np.testing.assert_allclose(found.measured[output].weight, measured.weight, rtol=1e-4)


@pytest.mark.parametrize("pace", [0.1, 1.0, 1000.0])
def test_a_window_is_bounded_by_time_constants(pace: float) -> None:
    seen = world("finger", View(pace=pace))
    robot = Robot.from_dict(seen.robot.as_dict() | {"time_constant_s": 0.12 * pace})
    recording = replace(seen.recording, robot=robot)
    # 5 time constants, of the neck 1 s.
    with pytest.raises(SettingsError, match=f"`window` must be between {0.6 * pace:g} and"):
        softneck.family(recording, window=0.5 * pace, progress=silent)
