"""A model does not depend on units, pace, names, order, signs or the middle of the set-points."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from softneck import identify
from softneck.core import to_si
from softneck.identification import Model
from softneck.identification.selection._auto import choose
from softneck.robot import Robot
from softneck.signals import Recording

from .worlds import PACES, PLANTS, UNITS, View, World, orders, world

ROWS = 400
SMALL = {"hidden": (3, 3), "iterations": 4, "refine": 3, "starts": 1}
#: Kind and settings; those that see but what they are told cost little.
CHEAP: dict[str, dict[str, Any]] = {
    "rls": {}, "rls miso": {"structure": "miso"}, "oe": {}, "nlsm": {}, "play": {"degree": 2, "widths": ()},
}  # fmt: skip
DEAR: dict[str, dict[str, Any]] = {
    "rls mimo": {"structure": "mimo"}, "oe two": {"nf": 2}, "oe late": {"intervals": True},
    "nlsm residual": {"form": "residual"}, "play all": {}, "nn": SMALL,
}  # fmt: skip


def moved(name: str) -> View:
    """Return the plant with set-points around another middle."""
    return View(offset=0.3 * float(PLANTS[name].robot["motors"]["setpoint_max"]))


VIEWS = [(name, view) for name in PLANTS for view in (*UNITS[name], *PACES, *orders(name), moved(name))]


@cache
def fitted(label: str, name: str, view: View) -> tuple[World, Model]:
    seen = world(name, view, rows=ROWS)
    return seen, identify(label.split()[0], seen.recording, train=1.0, **(CHEAP | DEAR)[label])


def check(label: str, name: str, view: View) -> None:
    (plain, model), (seen, other) = fitted(label, name, View()), fitted(label, name, view)
    expected, found = plain.simulated(model), seen.simulated(other)
    turned = bool(view.turned or view.motors or view.outputs or view.offset)
    # A start draws weights for channels in their order, and its steps make much of the rounding of another middle.
    if label == "nn" and turned:
        spread = max(np.abs(expected - plain.simulated(_seeded(name, seed))).max() for seed in (1, 2, 3))
        assert np.abs(found - expected).max() < 2.0 * spread
        return
    # Where the data have the same bits: what iterations make of rounding. A run begins held until an observer has
    # forgotten all but a thousandth, from motors at zero: with another middle some of that is left.
    near = 1e-3 if view.offset else 1e-6
    np.testing.assert_allclose(found, expected, rtol=0, atol=near)
    for key in ("delay_curve", "points", "terms", "degree"):
        if key in model.findings and not view.offset:
            assert np.shape(_numbers(model.findings[key])) == np.shape(_numbers(other.findings[key]))
    np.testing.assert_allclose(
        np.sort(other.findings["time_constants_s"]), view.pace * np.sort(model.findings["time_constants_s"]), rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("name", "view"), [(name, view) for name in ("finger", "joint")
                                            for view in (*UNITS[name], *PACES)])  # fmt: skip
def test_members_that_vote_see_the_same(name: str, view: View) -> None:
    plain, seen = world(name, rows=ROWS), world(name, view, rows=ROWS)
    one, other = (identify("guarded", w.recording, train=1.0, members=2, workers=1) for w in (plain, seen))
    # As for the kinds that vote.
    np.testing.assert_allclose(seen.simulated(other), plain.simulated(one), rtol=0, atol=1e-6)


@cache
def _seeded(name: str, seed: int) -> Model:
    return identify("nn", world(name, rows=ROWS).recording, train=1.0, seed=seed, **SMALL)


def _numbers(finding: Any) -> Any:
    return list(finding.values()) if isinstance(finding, dict) else finding


@pytest.mark.parametrize("view", [*UNITS["joint"], *PACES, *orders("joint"), moved("joint")])
def test_recursive_least_squares_see_the_same(view: View) -> None:
    check("rls", "joint", view)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "view"), VIEWS)
@pytest.mark.parametrize("label", CHEAP)
def test_a_cheap_kind_sees_the_same(label: str, name: str, view: View) -> None:
    check(label, name, view)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("name", "view"), VIEWS)
@pytest.mark.parametrize("label", DEAR)
def test_every_kind_sees_the_same(label: str, name: str, view: View) -> None:
    check(label, name, view)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["finger", "arm"])
def test_auto_chooses_the_same(name: str) -> None:
    """Scores are fits of models that agree to 1e-6 of the range: to 1e-3 of a point."""

    def chosen(view: View) -> tuple[str, list[tuple[str, float]]]:
        seen = world(name, view, rows=1500)
        found = choose(*seen.recording.split(0.7), kinds=("rls", "oe", "nlsm", "play"))
        return found.chosen.kind, [(row.kind, row.fit) for row in found.ranking]

    kind, ranking = chosen(View())
    for view in (*UNITS[name], *PACES, View(prefix="other_")):
        other, rows = chosen(view)
        assert (other, [row[0] for row in rows]) == (kind, [row[0] for row in ranking]), view
        np.testing.assert_allclose([row[1] for row in rows], [row[1] for row in ranking], atol=1e-3, err_msg=str(view))


def bent(*, pace: float = 1.0, unit: str = "rad") -> Recording:
    """Return a joint between two tendons; its file is in `unit`, its set-points and angles are the same."""
    rng = np.random.default_rng(3)
    robot = Robot.from_dict({
        "name": "joint", "motors": {"names": ["a", "b"], "unit": unit}, "outputs": {"names": ["pitch"], "unit": unit},
        "directions": {"kind": "tendons", "angles_deg": [0.0, 180.0]},
    })  # fmt: skip
    U = np.repeat(rng.uniform(0.0, 3.0, (ROWS // 20, 2)), 20, axis=0)
    y = np.zeros(ROWS)
    for k in range(ROWS - 1):
        y[k + 1] = 0.9 * y[k] + 0.01 * (U[max(k - 2, 0)] @ [1.0, -1.0])
    return Recording.from_arrays(U, y[:, None] + 1e-3 * rng.standard_normal((ROWS, 1)), sample_time=0.02 * pace,
                                 robot=robot)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("changed", [{"pace": 0.1}, {"pace": 1000.0}, {"unit": "deg"}])
def test_the_equations_of_tendons_see_the_same(changed: dict[str, Any]) -> None:
    models = [identify("greybox", bent(**view), train=1.0, evaluations=3, sensor_delay=2) for view in ({}, changed)]
    plain, other = (np.asarray(model.simulate(bent(**view)))[:, 0] for model, view in
                    zip(models, ({}, changed), strict=True))  # fmt: skip
    np.testing.assert_allclose(other, plain, rtol=0, atol=1e-6)
    rates = [[row["value"] for row in model.findings["numbers"] if row["unit"] == "1/s"] for model in models]
    np.testing.assert_allclose(rates[1], np.array(rates[0]) / changed.get("pace", 1.0), rtol=1e-5)


@pytest.mark.parametrize("name", ["finger", "arm"])
def test_a_system_is_in_si_and_has_the_names_of_the_robot(name: str) -> None:
    (seen, model), robot = fitted("rls", name, View()), PLANTS[name].robot
    system = model.ss()
    assert system.input_labels == list(seen.robot.set_points)
    assert system.output_labels == list(seen.robot.outputs.names)
    # The plant bends by 20 % at most, so that a line through it has nearly its gain.
    (motor, _), (output, _) = to_si(robot["motors"]["unit"]), to_si(robot["outputs"]["unit"])
    gain = output / motor * PLANTS[name].gain * np.array(PLANTS[name].weights)
    np.testing.assert_allclose(np.atleast_2d(system.dcgain()), gain, atol=0.2 * np.abs(gain).max())
    first = seen.robot.outputs.names[0]
    by_motor = model.tf(first, input=seen.robot.set_points[0]).dcgain()
    # Directions of the low-pass that learns them, beside the gains that a whole model has.
    assert by_motor == pytest.approx(np.atleast_2d(system.dcgain())[0, 0], rel=1e-6)


@pytest.mark.slow
def test_a_linearised_model_is_in_the_same_units() -> None:
    seen, model = fitted("rls", "arm", View())
    system = model.ss()
    linear = model.linearize(seen.recording.set_points.mean(axis=0))
    np.testing.assert_allclose(linear.dcgain()[: len(system.output_labels)], system.dcgain(), rtol=1e-6)
