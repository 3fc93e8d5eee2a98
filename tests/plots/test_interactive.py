"""Interactive charts: all that they need is in the page, and a browser draws, zooms, hides and tells their values."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from softneck.plots import Chart, Curve, Level, Panel, Section, page
from softneck.plots._chart import BLUE, GREEN, ORANGE, PURPLE, RED, SKY
from softneck.plots._interactive import _plot
from softneck.plots._page import thin_charts

from ..browser import Shown, own_text, shown

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

X = np.linspace(0.0, 10.0, 501)
NASTY = "</script><script>alert(1)</script>"


def _waves() -> Chart:
    top = [Curve(X, np.sin(X), "sine", BLUE, width=3.0), Curve(X, np.cos(X), "cosine", ORANGE, width=3.0)]
    bottom = [Curve(X, 2.0 * np.sin(X), "sine", BLUE, width=3.0)]
    return Chart("waves", [Panel(top, "y [deg]"), Panel(bottom, "twice [deg]", legend=False)])


def _styles() -> Chart:
    x = np.arange(8.0)
    shapes = [("step", BLUE), ("bars", ORANGE), ("points", GREEN), ("marked", RED), ("stems", PURPLE)]
    curves = [Curve(x, 1.0 + x, name, colour, name, 3.0) for name, colour in shapes]
    return Chart("styles", [Panel([curve], "y") for curve in curves])


def _gaps() -> Chart:
    y = np.ones(500)
    y[200:300] = np.nan
    line = Curve(X[:500], y, "line", BLUE, width=4.0)
    step = Curve(X[:500], y, "step", BLUE, "step", width=4.0)
    band = Curve(X[:500], y, "band", SKY, "band", upper=y + 1.0)
    return Chart("gaps", [Panel([curve], "y", y_range=(0.0, 2.5)) for curve in (line, step, band)])


@pytest.fixture(scope="module")
def html() -> str:
    return page("Charts", [Section("s", charts=[_waves(), _styles()]), Section(NASTY, charts=[_gaps()])])


@pytest.fixture
def view(html: str, browser: Browser, tmp_path: Path) -> Iterator[Shown]:
    path = tmp_path / "charts.html"
    path.write_text(html, encoding="utf-8")
    with shown(browser, path) as showing:
        yield showing


def test_a_page_has_one_library_and_refers_to_nothing_outside(html: str) -> None:
    assert html.count("Copyright (c) Anaconda, Inc., and Bokeh Contributors") == 1  # its licence asks for that
    own = own_text(html)
    assert len(own) < 200_000
    assert not re.search(r"https?://|@import|fetch\(|(src|href)=\"(?!data:|#)", own)
    assert "default-src 'none'" in own


def test_a_page_without_charts_carries_no_library() -> None:
    assert len(page("Plain", [Section("s", text=["words"])])) < 10_000


def test_labels_cannot_end_the_script() -> None:
    chart = Chart(NASTY, [Panel([Curve(X, X, NASTY)], NASTY, title=NASTY)], NASTY, caption=NASTY)
    assert NASTY not in page(NASTY, [Section(NASTY, charts=[chart])])


_COLUMNS = """() => Bokeh.documents.map(one => {
  const found = {};
  for (const [plot] of one.roots()[0].children)
    for (const {data_source: {data}} of plot.renderers)
      for (const [name, column] of data instanceof Map ? data : Object.entries(data))
        found[name] ??= Array.from(column, String);
  return found;
})"""


def test_the_browser_has_every_sample_and_a_shared_axis_once(browser: Browser, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    y = rng.standard_normal((3, X.size))
    y[0, 7] = np.nan
    steep = np.geomspace(1e-6, 1.0, X.size)
    panel = Panel([*(Curve(X, row) for row in y), Curve(X, steep), Curve(X, np.full(X.size, 3.0))], "y")
    odd = Chart("odd", [Panel([Curve(np.array([1e-3, 1.0, 1e3]), np.array([1.0, 2.0, 4.0]))], "y", log_x=True)])
    path = tmp_path / "samples.html"
    path.write_text(page("t", [Section("s", charts=[Chart("c", [panel]), odd])]), encoding="utf-8")
    with shown(browser, path) as view:
        first, second = (
            {name: np.array(column, dtype=float) for name, column in chart.items()}
            for chart in view.page.evaluate(_COLUMNS)
        )
    assert sorted(first) == ["x", "y1", "y2", "y3", "y4", "y5"]
    np.testing.assert_array_equal(first["x"], X)
    for k, row in enumerate([*y, steep], start=1):
        # Heights are kept in 32 bits, that is to seven digits.
        np.testing.assert_allclose(first[f"y{k}"], row, rtol=1e-6)
    np.testing.assert_array_equal(first["y5"], 3.0)
    np.testing.assert_array_equal(second["x"], [1e-3, 1.0, 1e3])


def test_a_page_of_too_many_samples_keeps_the_least_and_the_most_of_each_piece_and_says_so() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(100_000) * 0.02
    y = np.sin(0.01 * t)
    y[rng.integers(0, t.size, 5)] = 9.0  # a spike of one sample must not vanish
    y[40_000:60_000] = np.nan
    charts = [Chart("long", [Panel([Curve(t, y), Curve(t, 2 * y)], "y")]), Chart("short", [Panel([Curve(X, X)], "y")])]
    long, short = thin_charts(charts, most=10_000)
    assert short is charts[1]
    assert sum(curve.y.size for panel in long.panels for curve in panel.curves) <= 10_000
    assert "Of 100000 samples" in long.caption
    curve = long.panels[0].curves[0]
    assert (np.nanmax(curve.y), np.nanmin(curve.y)) == (np.nanmax(y), np.nanmin(y))
    assert np.isin(curve.y[np.isfinite(curve.y)], y).all()
    inside = (curve.x > t[40_100]) & (curve.x < t[59_900])  # but for the pieces at its ends
    assert np.isnan(curve.y[inside]).all()
    assert (np.diff(curve.x) > 0).all()
    assert thin_charts(charts)[0] is charts[0]


def test_curves_within_rounding_are_drawn_in_their_least_span() -> None:
    for size, limits in ((1e-16, (-0.5, 0.5)), (1.0, None)):
        panel = Panel([Curve(X, size * np.sin(X))], "y", least_span=1.0)
        made = _plot(panel, Chart("c", [panel]), 0).y_range
        start, end = (getattr(made, edge) for edge in ("start", "end"))
        assert (pytest.approx((start, end)) == limits) if limits else np.isnan([start, end]).all()  # fitted by Bokeh


def test_the_command_line_starts_without_the_drawing_library() -> None:
    code = "import sys, softneck.plots, softneck.report; sys.exit('bokeh' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_browser_loads_it_in_silence_and_asks_for_nothing(view: Shown) -> None:
    assert [request for request in view.requests if not request.startswith(("data:", "blob:"))] == [view.page.url]
    assert view.complaints == []


def test_every_curve_of_every_style_is_drawn(view: Shown) -> None:
    for number, chart in enumerate((_waves(), _styles())):
        for k, panel in enumerate(chart.panels):
            for curve in panel.curves:
                # Bars are drawn with 60 % of their colour, and lighter where nothing is below them.
                colour = "#f1c566" if curve.style == "bars" else curve.colour
                assert view.pixels(number, k, colour) > 20, curve.label


def test_nothing_is_drawn_across_a_gap(view: Shown) -> None:
    script = """() => Bokeh.documents[2].roots()[0].children.map(([plot]) => {
      const view = Bokeh.index.get_by_id(Bokeh.documents[2].roots()[0].id).child_views[1].child_views
        .find(v => v.model === plot);
      const canvas = view.canvas_view.primary.canvas, scale = canvas.width / view.canvas_view.bbox.width;
      const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", {willReadFrequently: true});
      copy.drawImage(canvas, 0, 0);
      const row = x => {
        const sx = Math.round(scale * view.frame.bbox.left + scale * view.frame.x_scale.compute(x));
        const top = Math.round(scale * view.frame.bbox.top);
        const data = copy.getImageData(sx, top, 1, Math.round(scale * view.frame.bbox.height)).data;
        let coloured = 0;
        for (let i = 0; i < data.length; i += 4) if (data[i + 3] > 60 && data[i + 2] - data[i] > 20) coloured++;
        return coloured;
      };
      return [row(2.13), row(5.13), row(8.13)];
    })"""
    for before, inside, after in view.page.evaluate(script):
        assert before > 0
        assert inside == 0
        assert after > 0


def test_a_click_on_the_legend_hides_a_curve_in_all_panels_and_shows_it_again(view: Shown) -> None:
    assert view.pixels(0, 0, BLUE) > 100
    view.click_legend(0, "sine")
    assert view.pixels(0, 0, BLUE) == 0
    assert view.pixels(0, 1, BLUE) == 0
    assert view.pixels(0, 0, ORANGE) > 100
    view.click_legend(0, "sine")
    assert view.pixels(0, 0, BLUE) > 100
    assert view.pixels(0, 1, BLUE) > 100
    assert view.complaints == []


def test_ctrl_and_wheel_zoom_all_panels_and_a_bare_wheel_scrolls_the_page(view: Shown) -> None:
    middle = view.frame(0)
    before, scrolled = view.x_range(0), view.page.evaluate("scrollY")
    pixels = view.pixels(0, 1, BLUE)
    view.page.mouse.move(**middle)
    view.page.keyboard.down("Control")
    view.page.mouse.wheel(0, -400)
    view.page.keyboard.up("Control")
    view.wait(lambda: view.x_range(0) != before)
    view.settle()
    near = view.x_range(0)
    assert near == view.x_range(0, panel=1)
    assert near[1] - near[0] < before[1] - before[0]
    assert view.page.evaluate("scrollY") == scrolled
    assert view.pixels(0, 1, BLUE) != pixels  # redrawn
    view.page.mouse.wheel(0, 200)
    view.wait(lambda: view.page.evaluate("scrollY") > scrolled)
    assert view.x_range(0) == near


def test_dragging_zooms_into_the_box_and_reset_comes_back(view: Shown) -> None:
    middle, before = view.frame(0), view.x_range(0)
    view.page.mouse.move(middle["x"] - 100, middle["y"] - 20)
    view.page.mouse.down()
    view.page.mouse.move(middle["x"] + 100, middle["y"] + 20, steps=4)
    view.page.mouse.up()
    view.settle()
    near = view.x_range(0)
    assert before[0] < near[0] < near[1] < before[1]
    view.page.locator(".chart").first.locator(".bk-tool-icon-reset").click()
    view.settle()
    assert view.x_range(0) == before


@pytest.mark.parametrize(("chart", "words"), [(0, ("sine", "cosine")), (1, ("step",))], ids=["lines", "steps"])
def test_hovering_tells_the_values(view: Shown, chart: int, words: tuple[str, ...]) -> None:
    middle = view.frame(chart)
    view.page.mouse.move(middle["x"] - 3, middle["y"])
    view.page.mouse.move(**middle)
    tip = view.page.locator(".bk-Tooltip").first
    tip.wait_for(state="visible")
    view.wait(lambda: "time [s]" in tip.locator(".bk-tooltip-content").inner_text())
    text = tip.locator(".bk-tooltip-content").inner_text()
    assert all(re.search(rf"{word}:?\s*-?\d", text) for word in words), text


def test_levels_are_drawn_and_named(browser: Browser, tmp_path: Path) -> None:
    panel = Panel([Curve(X, np.sin(X), "sine")], "y", levels=(Level(0.5, "bound", RED, dashed=False),))
    path = tmp_path / "level.html"
    path.write_text(page("t", [Section("s", charts=[Chart("c", [panel])])]), encoding="utf-8")
    with shown(browser, path) as view:
        picture = Image.open(io.BytesIO(view.page.locator(".bk-Figure").screenshot())).convert("RGB")
        red, _, blue = np.asarray(picture, dtype=int).transpose(2, 0, 1)
        # A line of one pixel may lie between two rows, which then have half of its colour each.
        assert ((red - blue) > 80).sum() > 300
        assert view.page.locator(".bk-Legend .bk-item").all_inner_texts() == ["sine", "bound"]
        assert view.complaints == []
