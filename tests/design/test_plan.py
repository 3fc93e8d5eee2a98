"""Planned trajectories: limits that hold, an optimum that is one, a reference that a loop takes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import PiSettings
from softneck.design.predictive import PlanSettings, plan
from softneck.identification import Model
from softneck.loop import BlockPart, Loop, RotationReference, StepReference, run_loop
from softneck.signals import redefinition_matrix

from ..data import slow_but

LIMITS = PlanSettings(position_limit=3.0, slew_limit=6.0, minimum_tautness=-0.15)
ROUND = RotationReference(inclination=0.15, cocontraction=0.1, frequency=0.5, rise=0.5)


@pytest.mark.parametrize(
    "kind", slow_but(["rls", "play", "nn", "greybox", "nss", "guarded"], ["rls", "play", "greybox"])
)
def test_it_follows_and_keeps_every_limit(kind: str, models: dict[str, Model]) -> None:
    model = models[kind]
    planned = plan(model, ROUND, duration=1.2, settings=LIMITS)
    rows = len(planned.time)
    assert (rows, planned.set_points.shape, planned.angles.shape) == (60, (60, 3), (60, 2))
    # What the model itself makes of the set-points, from rest: row k is what is there when set-point k comes.
    block = model.block()
    start = block.initial_state(use_measurement=0.0)
    y = block.run(start, np.hstack([planned.set_points, np.full((rows, 5), math.nan)]))[1][:, :2]
    np.testing.assert_array_equal(planned.angles, np.vstack([start.outputs[:2], y[:-1]]))
    # ipopt lets bounds give way by 1e-8 of their size.
    assert np.abs(planned.set_points).max() <= 3.0 + 1e-7
    steps = np.diff(planned.set_points, axis=0, prepend=np.zeros((1, 3)))
    assert np.abs(steps).max() <= 6.0 * model.sample_time + 1e-8
    T = redefinition_matrix()
    tautness = planned.set_points - 6.93 * y @ T[:2]
    assert planned.tautness == pytest.approx(tautness.min(), abs=1e-12)
    assert planned.tautness >= -0.15
    wanted = np.array([ROUND(t)[:2] for t in planned.time])
    # Dead time, slew and the range keep it away at first; in the end it is within a few per cent of the radius.
    assert np.abs(planned.angles - wanted)[40:].max() < 0.03


def test_of_a_linear_model_it_is_least_squares(models: dict[str, Model]) -> None:
    """Without an active limit; the step response is measured here, and the normal equations are written out."""
    model, rows, hold = models["rls"], 50, 5
    s = PlanSettings(slew_limit=100.0, spacing=hold * model.sample_time)
    reference = RotationReference(inclination=0.1, cocontraction=0.05, frequency=0.4, rise=0.6)
    planned = plan(model, reference, duration=rows * model.sample_time, settings=s)
    assert planned.status == "Solve_Succeeded"
    block = model.block()
    rest = block.initial_state(use_measurement=0.0)
    T, points = redefinition_matrix(), rows // hold
    columns, free = [], np.full((rows, 5), math.nan)
    for i in range(3 * points):
        places = np.zeros((points + 1, 3))
        places[1 + i // 3, i % 3] = 1.0
        at = np.arange(1, rows + 1) / hold
        u = np.column_stack([np.interp(at, np.arange(points + 1), places[:, j]) for j in range(3)])
        y = block.run(rest, np.hstack([u, free]))[1][:, :2]
        moves = np.diff(places, axis=0).ravel()
        columns.append(np.concatenate([
            y.ravel(), math.sqrt(s.move_weight / hold) * moves, math.sqrt(s.cocontraction_weight) * (u @ T[2]),
        ]))  # fmt: skip
    Ts = model.sample_time
    wanted = np.array([reference((k + 1) * Ts)[:2] for k in range(rows)]).ravel()
    common = np.array([reference(k * Ts)[2] for k in range(rows)])
    asked = np.concatenate([wanted, np.zeros(3 * points), math.sqrt(s.cocontraction_weight) * common])
    z = np.linalg.lstsq(np.array(columns).T, asked)[0].reshape(points, 3)
    # ipopt stops at 1e-6 in the gradient, whose smallest curvature is that of the weights, 1e-3.
    np.testing.assert_allclose(planned.set_points[hold - 1 :: hold], z, atol=2e-3)


def test_a_loop_takes_it_as_its_reference(models: dict[str, Model]) -> None:
    planned = plan(models["play"], ROUND, duration=1.0, settings=LIMITS)
    reference = planned.reference()
    assert reference(0.5) == (*planned.angles[25], planned.cocontraction[25])
    np.testing.assert_allclose(planned.cocontraction, planned.set_points.mean(axis=1), atol=1e-12)  # Eq. 11
    controller = PiSettings().design(models["rls"]).block()
    loop = Loop(
        plant=BlockPart(models["play"].block()), controller=BlockPart(controller), reference=reference, duration=1.0
    )  # fmt: skip
    result = run_loop(loop)
    np.testing.assert_array_equal(result["pitch_reference"][:50], planned.angles[:, 0])


def test_what_cannot_be_is_refused(models: dict[str, Model]) -> None:
    with pytest.raises(SettingsError, match="keeps a tautness of 1 rad"):
        # At rest every tendon has a tautness of zero, and a motor cannot jump.
        plan(models["rls"], ROUND, duration=0.4, settings=PlanSettings(minimum_tautness=1.0))
    with pytest.raises(SettingsError, match="kind `nlsm` searches its set"):
        plan(models["nlsm"], ROUND, duration=0.4)
    with pytest.raises(SettingsError, match="`duration` must be"):
        plan(models["rls"], StepReference(pitch=0.1), duration=0.0)
    with pytest.raises(SettingsError, match="`move_weight` must be positive"):
        PlanSettings(move_weight=0.0)
