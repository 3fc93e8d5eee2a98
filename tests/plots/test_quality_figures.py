"""The figures of a recording's quality show what the report holds, and the page stands on its own."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from softneck.plots import correlation_figure, faults_figure, quality_page, region_figure, spectrum_figure
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


def texts(figure: Figure) -> str:
    return " ".join(text.get_text() for ax in figure.axes for text in ax.texts)


@pytest.mark.slow
def test_the_page_of_any_recording_holds_its_pictures_and_every_finding(case: tuple[Recording, Quality]) -> None:
    recording, found = case
    html = quality_page(recording, found, "<Quality>")
    assert "&lt;Quality&gt;" in html
    assert not re.search(r"(src|href)=\"(?!data:|#)", html)
    assert html.count("data:image/png") == 4
    assert html.count('class="chart"') == 1
    assert html.count('<li class="ok">') == sum(finding.severity == "ok" for finding in found.findings)


def test_the_spectrum_has_its_line_at_the_bandwidth() -> None:
    (ax,) = spectrum_figure(assess_quality(CASES["clean"]), "t").axes
    upright = [line for line in ax.lines if len(set(np.asarray(line.get_xdata()).tolist())) == 1]
    assert [np.asarray(line.get_xdata())[0] for line in upright] == [4.0]


def test_the_correlation_shows_its_numbers_and_a_motor_that_rests() -> None:
    found = assess_quality(CASES["clean"])
    assert f"{found.correlation[0, 1]:.2f}" in texts(correlation_figure(found, "t"))
    assert "never\nmoves" in texts(correlation_figure(assess_quality(CASES["still"]), "t"))


def test_every_sort_of_fault_is_marked() -> None:
    recording = CASES["faulty"]
    found = assess_quality(recording)
    legends = [ax.get_legend() for ax in faults_figure(recording, found, "t").axes]
    shown = {text.get_text() for legend in legends if legend is not None for text in legend.get_texts()}
    assert shown == {"missed", "frozen", "clipped", "spikes"}


def test_a_behaviour_that_never_took_place_is_named() -> None:
    assert "never" in texts(region_figure(CASES["still"], assess_quality(CASES["still"]), "t"))
