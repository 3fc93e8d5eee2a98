"""The figures of a recording's quality show what the report holds, and the page stands on its own."""

from __future__ import annotations

import re

import numpy as np
import pytest

from softneck.plots import chart_figure, quality_page
from softneck.plots._recording_pages import faults_chart
from softneck.signals import Quality, Recording, assess_quality, concatenate

from ..data import neck_recording


def faulty() -> Recording:
    """Two runs with one fault of each sort; roll of the second is missing."""
    clean = neck_recording(1200, seed=2, noise=1e-3)
    pitch, position = clean.channels["pitch"].copy(), clean.channels["motor_position_1"].copy()
    pitch[300:310], pitch[500:560], pitch[800] = np.nan, pitch[500], -0.9
    pitch = np.minimum(pitch, 0.2)
    second = neck_recording(400)
    missing = second.with_channels(pitch=np.minimum(second.channels["pitch"], 0.2), roll=np.full(400, np.nan))
    return concatenate([clean.with_channels(pitch=pitch, motor_position_1=np.round(position, 1)), missing])


def still() -> Recording:
    """Nothing moves and nothing was measured."""
    rest = neck_recording(100, positions=False)
    names = dict.fromkeys((name for name in rest.channels if name.startswith("motor")), np.zeros(100))
    return rest.with_channels(**names, pitch=np.full(100, np.nan))


CASES = {"clean": neck_recording(1200), "faulty": faulty(), "still": still()}


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> tuple[Recording, Quality]:
    recording = CASES[request.param]
    return recording, assess_quality(recording)


@pytest.mark.slow
def test_the_page_of_any_recording_holds_its_picture_and_every_finding(case: tuple[Recording, Quality]) -> None:
    recording, found = case
    html = quality_page(recording, found, "<Quality>")
    assert "&lt;Quality&gt;" in html
    assert not re.search(r"(src|href)=\"(?!data:|#)", html)
    assert html.count('class="chart"') == 1
    assert html.count('<li class="ok">') == sum(finding.severity == "ok" for finding in found.findings)


def test_every_sort_of_fault_is_marked() -> None:
    recording = CASES["faulty"]
    found = assess_quality(recording)
    legends = [ax.get_legend() for ax in chart_figure(faults_chart(recording, found, "t")).axes]
    shown = {text.get_text() for legend in legends if legend is not None for text in legend.get_texts()}
    assert shown == {"missed", "frozen", "clipped", "spikes"}
