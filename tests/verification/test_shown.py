"""What the front door gives shows itself in three lines, whatever names are in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

import softneck
from softneck.cosim import make_loop, make_study
from softneck.estimation import KalmanSettings
from softneck.identification import Model
from softneck.plant import NeckParameters, VirtualNeck
from softneck.signals import Recording, assess_quality
from softneck.verification import make_requirements

from .necks import QUICK, family, linear_neck, pi

HOSTILE = "<script>alert('1')</script>&\n\x00\x1b[31m\udcff\"/>.csv"


@pytest.fixture(scope="module")
def things(neck: Recording, models: dict[str, Model]) -> dict[str, Any]:
    """One of each thing that the front door gives, under hostile names where a name goes in."""
    neck_of_ours = VirtualNeck(NeckParameters.paper())
    told = {"hold_out": {"fit": {"pitch": 81.0, "roll": None}}, "why": HOSTILE}
    table = {
        "plant": {"object": neck_of_ours}, "controller": {"object": pi()}, "duration_s": 0.2,
        "reference": {"kind": "step", "pitch_deg": 5.0}, "limits": {"pitch.rms_error_deg": 0.01},
    }  # fmt: skip
    done = softneck.simulate(table)
    few = {key: QUICK[key] for key in ("sampling", "sim")}
    found = softneck.verify(pi(), {HOSTILE: linear_neck()}, make_requirements(few))
    study = make_study(table, vary={"reference.pitch_deg": {"uniform": [1.0, 3.0]}}, runs=8)
    rls = models["rls"]
    return {
        "recording": neck,
        "virtual neck": neck_of_ours,
        "family": family(),
        "kalman": KalmanSettings().design(rls),
        "nonlinear": KalmanSettings(form="nonlinear").design(models["nn"]),
        "pi": pi(),
        "adaptive": softneck.design_controller("adaptive", rls),
        "validation": softneck.validate(rls, neck, names=(HOSTILE, HOSTILE), include_training=True),
        "result": replace(done, remarks=(HOSTILE,)),
        "signals": done.signals,
        "loop": make_loop(table).loop,
        "loop with limits": make_loop(table),
        "block": rls.block(),
        "state": rls.initial_state(),
        "robot": rls.robot,
        "quality": assess_quality(neck),
        "evidence": found.evidence,
        "study": replace(study, name=HOSTILE),
        "verification": found,
        "verdict": replace(found.verdicts[0], note=HOSTILE, worst={HOSTILE: 1}),
        **{f"model {kind}": replace(model, findings={**model.findings, **told}) for kind, model in models.items()},
    }


def test_each_shows_itself_in_three_short_lines(things: dict[str, Any]) -> None:
    for name, thing in things.items():
        said = repr(thing)
        assert said.startswith(type(thing).__name__), name
        lines = said.split("\n")
        assert len(lines) == len(said.splitlines()) <= 3, name
        assert max(map(len, lines)) <= 120, name
        assert said.isprintable() or said.replace("\n", "").isprintable(), name
