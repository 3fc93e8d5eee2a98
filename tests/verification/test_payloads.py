"""The payloads of the requirements in the loops over a user's own plants: carried where one knows them, else said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softneck.core import load, silent
from softneck.plant import NeckParameters
from softneck.verification import make_requirements
from softneck.verification._neck_loops import SimulationModel, make_simulation_model, missing_payloads, run_loops

from ..data import ROOT
from ..identification.structured.test_payload import at
from .necks import QUICK, pi

GREYBOX = ROOT / "tests" / "golden" / "greybox.npz"


def plant_with(payload: str, seen: list[float]) -> SimulationModel:
    return replace(
        make_simulation_model(NeckParameters.paper(), "own"), payload=payload, conditions={"payload_kg": seen}
    )


@pytest.mark.parametrize(
    ("payload", "seen", "carried", "left"),
    [
        ("inputs", [0.0, 0.0], [0.0, 0.5, 1.0], ""),
        ("parameters", [0.0, 1.0], [0.0, 0.5, 1.0], ""),
        ("parameters", [0.0, 0.6], [0.0, 0.5], "1"),
        ("parameters", [0.7, 0.8], [0.7], "0.5, 1"),
        ("", [0.0, 0.0], [0.0], "0.5, 1"),
    ],
)
def test_a_plant_carries_the_payloads_that_it_knows_and_the_others_are_said(
    payload: str, seen: list[float], carried: list[float], left: str
) -> None:
    plant = plant_with(payload, seen)
    assert plant.payloads([0.0, 0.5, 1.0]) == carried
    told = missing_payloads([plant], make_requirements({**QUICK, "sim": {"payloads_kg": [0.0, 0.5, 1.0]}}))
    assert [f"own does not model {left} kg" in why for why in told.values()] == [True] * bool(left)
    assert not missing_payloads([plant], make_requirements({**QUICK, "sim": {"payloads_kg": [0.0]}}))


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
