"""Observers of one robot in other units, at another pace, renamed, in another order and turned: the same estimates."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import Matrix, to_si
from softneck.estimation import KalmanSettings

from .models import model_of
from .worlds import PACES, PLANTS, UNITS, View, World, orders, world

VIEWS = [
    (name, view)
    for name, plant in PLANTS.items()
    for view in (*UNITS[name], *PACES, *orders(name), View(turned_motors=(-1,) * len(plant.weights[0])))
]


def estimated(seen: World, form: str) -> Matrix:
    """Return the estimates (time, outputs) as the plain view has them, over the range of each output."""
    recording, names = seen.recording, seen.robot.outputs.names
    if form == "gyro":
        rates = np.gradient(recording.outputs, recording.sample_time, axis=0)
        recording = recording.with_channels(**{f"{name}_rate": rates[:, i] for i, name in enumerate(names)})
    lost = recording.channels[names[0]].copy()
    lost[60:80] = np.nan
    settings = KalmanSettings(form=form, sensor_delay=1.5 * recording.sample_time)
    found = settings.design(model_of(seen)).estimate(recording.with_channels(**{names[0]: lost})).outputs
    low, high = (np.array(seen.plant.robot["outputs"][key]) for key in ("min", "max"))
    return seen.plain_outputs(found) / (to_si(seen.plant.robot["outputs"]["unit"])[0] * (high - low))


def check(name: str, view: View, form: str, rows: int) -> None:
    plain, seen = (estimated(world(name, each, rows=rows), form) for each in (View(), view))
    # What some hundred updates leave of rounding; the estimates are of size one.
    np.testing.assert_allclose(seen, plain, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("name", "view"), VIEWS)
def test_a_linear_filter_is_the_same(name: str, view: View) -> None:
    check(name, view, "model", 120)


@pytest.mark.parametrize("view", [*orders("joint"), View(output_unit="rad")])
def test_a_filter_with_a_gyro_is_the_same(view: View) -> None:
    """At another pace it is not: a gyro's noise is in deg a second, whatever it is mounted on."""
    check("joint", view, "gyro", 120)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "view"), VIEWS)
def test_a_filter_over_a_simulation_is_the_same(name: str, view: View) -> None:
    check(name, view, "nonlinear", 120)
