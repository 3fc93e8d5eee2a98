"""What the front door gives shows itself in three lines, and in a notebook as a page that holds no foreign markup."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import softneck
from softneck.core._shown import bars, marks, sparkline
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
    few = {key: QUICK[key] for key in ("sampling", "neck")}
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


def test_each_is_a_page_that_parses_and_holds_no_foreign_markup(things: dict[str, Any]) -> None:
    for name, thing in things.items():
        page = ElementTree.fromstring(thing._repr_html_())
        tags = {element.tag.rpartition("}")[2] for element in page.iter()}
        assert tags <= {"div", "b", "br", "svg", "path", "rect", "text"}, name
        assert all(not key.startswith("on") and key != "href" for e in page.iter() for key in e.attrib), name
        # The page says what the terminal does, and names the bars.
        words = [*filter(None, (page.findtext("b"), *(br.tail for br in page.findall("br"))))]
        assert "\n".join(words) == repr(thing), name


def test_a_hostile_name_is_text(things: dict[str, Any]) -> None:
    assert "&lt;script&gt;" in things["validation"]._repr_html_()


@pytest.mark.parametrize("name", ["recording", "model rls", "pi", "validation", "result", "study", "verification"])
def test_recordings_models_controllers_verdicts_and_studies_have_a_picture(things: dict[str, Any], name: str) -> None:
    page = things[name]._repr_html_()
    assert "<path" in page or "<rect" in page
    # A notebook is saved with it.
    assert len(page) < 20_000


def test_a_curve_spans_the_picture_and_gaps_lift_the_pen() -> None:
    assert sparkline([np.full(5, np.nan)]) == sparkline([]) == bars({}) == ""
    assert sparkline([[1.0, 1.0]]).count("<path") == 1
    svg = sparkline([[0.0, np.nan, 4.0]])
    # Heights from 46 px at the least to 2 px at the most; the gap begins a new line.
    assert 'd="M0.0 46.0M160.0 2.0"' in svg
    assert marks([True, False, None]).count("<rect") == 3
