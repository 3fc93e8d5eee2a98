"""The payloads of the requirements in the loops over a user's own plants: carried where one knows them, else said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softneck.core import load, silent
from softneck.plant import NeckParameters
from softneck.robot import Robot
from softneck.verification import Scale, make_requirements
from softneck.verification._neck_loops import SimulationModel, judged_elsewhere, make_simulation_model, run_loops

from ..data import ROOT
from ..identification.structured.test_payload import at
from .necks import QUICK, pi

GREYBOX = ROOT / "tests" / "golden" / "greybox.npz"


def plant_with(payload: str, seen: list[float]) -> SimulationModel:
    return replace(
        make_simulation_model(NeckParameters.paper(), "own"), payload=payload, conditions={"payload_kg": seen}
    )


ASKED = [0.0, 0.32, 0.5, 1.0]


@pytest.mark.parametrize(
    ("payload", "seen", "judged", "told"),
    [
        ("inputs", [0.0, 0.0], ASKED, {}),
        ("parameters", [0.0, 1.0], ASKED, {}),
        ("parameters", [0.35, 1.0], [0.35, 0.5, 1.0], {0.0: "0.35", 0.32: "0.35"}),
        # The ends of the recordings are judged, asked or not.
        ("parameters", [0.0, 1.2], [*ASKED, 1.2], {}),
        ("parameters", [0.7, 0.8], [0.7, 0.8], {0.0: "0.7", 0.32: "0.7", 0.5: "0.7", 1.0: "0.8"}),
        ("parameters", [0.4, 0.4], [0.4], {0.0: "0.4", 0.32: "0.4", 0.5: "0.4", 1.0: "0.4"}),
        ("", [0.0, 0.0], [0.0], {0.32: "", 0.5: "", 1.0: ""}),
        ("", [0.3, 0.6], [0.0], {0.0: "", 1.0: ""}),
    ],
)
def test_each_payload_asked_is_judged_at_the_nearest_known_and_said(
    payload: str, seen: list[float], judged: list[float], told: dict[float, str]
) -> None:
    plant = plant_with(payload, seen)
    assert plant.payloads(ASKED) == judged
    found = judged_elsewhere([plant], make_requirements({**QUICK, "sim": {"payloads_kg": ASKED}}))
    assert list(found) == [f"payload {kg:g} kg of own" for kg in told]
    for how, kg in zip(found.values(), told.values(), strict=True):
        assert how.startswith(f"judged at {kg} kg, it was recorded with" if kg else "judged as recorded, ")
    # Asked, judged and told: each payload is judged as it is, or told.
    assert not payload or set(ASKED) <= set(judged) | set(told)


def test_each_direction_asked_is_judged_or_said() -> None:
    asked = {"sim": {"orientations_deg": [0.0, 90.0]}}
    assert not judged_elsewhere([], make_requirements(asked))
    one = make_requirements(asked, scale=Scale(robot=Robot.preset("finger")))
    assert judged_elsewhere([], one) == {
        "directions": f"{one.robot.outputs.names[0]} is the only output, so all of `orientations_deg` are one step"
    }


def test_loops_over_a_model_of_several_payloads_carry_each() -> None:
    """They are those over the model of that payload alone."""
    plain = load(GREYBOX)
    several = replace(
        plain, arrays={**plain.arrays, "payload": np.array([0.0, 1.0, -3.0, -0.2])},
        findings={**plain.findings, "conditions": {"payload_kg": [0.0, 1.0]}},
    )  # fmt: skip
    few = make_requirements({**QUICK, "sim": {"payloads_kg": [0.0, 1.0], "orientations_deg": [0.0], "duration_s": 2.5}})

    def angles(model: Any) -> list[np.ndarray]:
        own = [make_simulation_model(model, "m")]
        runs = run_loops(pi().block(), few, order="sequential", observer=None, seed=0, progress=silent, own=own)
        return [run.result.angle("pitch") for run in runs if run.result is not None]

    light, heavy = angles(several)
    np.testing.assert_array_equal(light, angles(at(several, 0.0))[0])
    np.testing.assert_array_equal(heavy, angles(at(several, 1.0))[0])
    assert not np.array_equal(light, heavy)
