"""The paper's tables and figures, on a record short enough for a test."""

from __future__ import annotations

import re

import numpy as np
import pytest

from softneck.core import silent
from softneck.identification import nrmse_fit
from softneck.report import ReproduceSettings, paper_page, reproduce
from softneck.report._reproduce import Reproduction, group_entries, linear_facts, paper_charts, paper_entries

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found() -> Reproduction:
    settings = ReproduceSettings(iterations=2, other_necks=1, duration=40.0)
    return reproduce(settings, tell=lambda _: silent)


def test_every_published_fit_stands_beside_ours(found: Reproduction) -> None:
    rows = paper_entries(found)
    parts = group_entries(rows)
    # Table 3: 3 models, 2 axes; Table 4: the same over 3 tests; section 7.4: SM and NN on two tests.
    assert [len(part) for part in parts.values()] == [6, 18, 8]
    assert sum(len(part) for part in parts.values()) == len(rows)
    table_3 = {(row.model, row.axis): row.paper for row in rows if row.where == "Table 3"}
    assert table_3["nlsm", "pitch"] == 93.9794
    assert table_3["rls", "roll"] == 82.7217
    assert {row.configuration for row in rows if row.model == "rls"} == {"free run"}
    # The one other neck is `rough`, which is named.
    assert list(found.others) == ["rough"]
    assert all(row.other_necks == (row.rough, row.rough) for row in rows if row.rough is not None)
    assert any(row.rough is not None and row.rough != row.ours for row in rows if row.model == "rls")


def test_persistence_stands_beside_every_one_step_fit_and_only_there(found: Reproduction) -> None:
    for row in paper_entries(found):
        assert (row.persistence is not None) == (row.configuration == "one step")


def test_the_verdict_follows_the_numbers(found: Reproduction) -> None:
    for row in paper_entries(found):
        if row.ours is None:
            continue
        if row.verdict == "none":
            assert abs(row.ours - row.paper) <= 1.0
        if row.verdict.startswith("the plant's"):
            assert row.other_necks is not None
            assert min(row.ours, *row.other_necks) <= row.paper <= max(row.ours, *row.other_necks)


def test_every_figure_draws_what_its_number_says(found: Reproduction) -> None:
    charts = paper_charts(found)
    numbers = [int(word) for name in charts for word in name.split(" and ")]
    assert sorted(numbers) == list(range(4, 24))
    for number, chart in charts.items():
        assert re.match(rf"Figures? {number}\. ", chart.title)
        assert all(np.isfinite(curve.y).any() for panel in chart.panels for curve in panel.curves if curve.label)


def test_a_figure_shows_what_the_table_scores(found: Reproduction) -> None:
    curves = {curve.label: curve.y for curve in paper_charts(found)["20 and 21"].panels[0].curves}
    ours = {row.model: row.ours for row in paper_entries(found) if row.where.startswith("section 7.4")
            and row.data == "rotation" and row.axis == "pitch"}  # fmt: skip
    for model, name in (("nlsm", "SM"), ("nn", "NN")):
        if ours[model] is not None:
            # The figure is in degrees: rounding alone.
            assert nrmse_fit(curves["measured"], curves[name]) == pytest.approx(ours[model], abs=1e-9)


def test_the_linear_model_is_the_papers_to_the_size(found: Reproduction) -> None:
    for fact in linear_facts(found):
        # 40 s of a noisy nonlinear neck: the same order, no more is promised.
        assert fact["ours"]["K"] / fact["ours"]["p"] == pytest.approx(fact["paper"]["K"] / fact["paper"]["p"], rel=0.5)


def test_the_page_has_every_figure_once(found: Reproduction) -> None:
    html = paper_page(found)
    for chart in paper_charts(found).values():
        assert html.count(f"<h3>{chart.title}</h3>") == 1
