"""A validation of a model does not depend on units, pace, names, order or signs; its page has its robot's words."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from softneck import identify, validate
from softneck.core import to_si
from softneck.identification import Validation
from softneck.report._validation_page import fit_table, validation_page
from softneck.robot import Robot

from .worlds import PACES, UNITS, View, World, orders, world


@cache
def judged(name: str, view: View) -> tuple[World, Validation]:
    """Return a world and the validation of its model on other rows, of a robot that gives its time constant."""
    seen, fresh = world(name, view), world(name, view, rows=900, seed=1)
    seconds = seen.plant.time_constant * seen.plant.robot["sample_time_s"] * view.pace
    robot = Robot.from_dict(seen.robot.as_dict() | {"time_constant_s": seconds})
    model = identify("rls", replace(seen.recording, robot=robot), train=1.0)
    return seen, validate(model, replace(fresh.recording, robot=robot), names=("rls", "data"))


def tables(seen: World, found: Validation) -> dict[str, list[float]]:
    """Return the scores that have no unit, of each output as the plain view lists them."""
    order = np.argsort(seen.view.outputs or range(len(seen.robot.outputs.names)))
    names = [seen.robot.outputs.names[i] for i in order]
    scores = {"fits": found.fits, "persistence": found.persistence, "linear": found.best_linear}
    values = {f"{key} {h}": [table[h].get(n) for n in names] for key, table in scores.items() for h in table}
    for i, n in enumerate(names):
        values |= {f"interval {i} {h}": list(table[n] or ()) for h, table in found.intervals.items()}
    values["cold"] = [found.cold_fits[n] for n in names]
    factor = to_si(seen.robot.outputs.display_unit)[0] / seen.numbers[1]
    values |= {f"rms {h}": [factor * (table[n] or 0.0) for n in names] for h, table in found.rmse_deg.items()}
    return {key: [float("nan") if v is None else float(v) for v in row] for key, row in values.items()}


@pytest.mark.parametrize("name", ["joint", pytest.param("arm", marks=pytest.mark.slow)])
def test_scores_are_the_same_in_every_view(name: str) -> None:
    _, first = judged(name, View())
    expected = tables(*judged(name, View()))
    assert any("interval" in key and len(row) == 2 for key, row in expected.items())
    for view in (*UNITS[name], *PACES, *orders(name)):
        seen, found = judged(name, view)
        for key, row in tables(seen, found).items():
            # Models agree to 1e-6 of the range (test_identify_laws), fits to as many percent; quantiles among them.
            np.testing.assert_allclose(row, expected[key], rtol=1e-4, atol=1e-3, err_msg=f"{key} {view}")
        assert (found.diverged, found.white, found.uncorrelated) == (first.diverged, first.white, first.uncorrelated)


@pytest.mark.slow
def test_a_page_is_in_the_words_and_units_of_its_robot() -> None:
    for view in (View(), *UNITS["arm"]):
        seen, found = judged("arm", view)
        outputs = seen.robot.outputs
        assert fit_table([found]).caption.endswith(f"errors in {outputs.display_unit}")
        text = validation_page([found])
        assert "pitch" not in text.lower()
