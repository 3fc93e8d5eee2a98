"""Pages in a browser: nothing is cut, all can be read, and keys go the way the eye does."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from softneck.plots import Chart, Curve, Panel, Section, Table, page
from softneck.plots._charts import loop_chart

from ..browser import Shown, shown

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

WIDTHS = (1400, 768, 390)
# WCAG 2.1, 1.4.3 (AA): of text, and of large text such as titles.
_CONTRAST = """() => {
  const canvas = new OffscreenCanvas(1, 1).getContext("2d", {willReadFrequently: true});
  const rgba = text => {
    canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = text; canvas.fillRect(0, 0, 1, 1);
    return [...canvas.getImageData(0, 0, 1, 1).data];
  };
  const light = ([r, g, b]) => [r, g, b].map(c => c / 255)
    .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, k) => sum + c * [0.2126, 0.7152, 0.0722][k], 0);
  const behind = node => {
    for (; node; node = node.parentElement) {
      const colour = rgba(getComputedStyle(node).backgroundColor);
      if (colour[3] === 255) return colour;
    }
    return [255, 255, 255];
  };
  const poor = [];
  for (const node of document.querySelectorAll("h1, h2, h3, p, td, th, caption, li, b, a, span, figcaption, footer")) {
    if (!node.textContent.trim() || !node.getClientRects().length) continue;
    const [a, b] = [light(rgba(getComputedStyle(node).color)), light(behind(node))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) poor.push(`${node.tagName} ${node.textContent.slice(0, 20)} ${ratio.toFixed(2)}`);
  }
  return poor;
}"""
# What reaches out of the window, or of a box that does not scroll.
_CUT = """() => [...document.querySelectorAll("main *, footer *")]
  .filter(node => node.getClientRects().length && !node.closest(".scroll") && !node.closest("svg"))
  .filter(node => node.getBoundingClientRect().right > innerWidth + 1 || node.getBoundingClientRect().left < -1)
  .map(node => `${node.tagName}.${node.className}: ${node.textContent.slice(0, 30)}`)"""
_FOCUS = """() => { const box = document.activeElement.getBoundingClientRect();
  return [document.activeElement.tagName, box.top + scrollY, box.left]; }"""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    t = np.arange(400) * 0.02
    signals = {name: np.sin(t) for name in ("pitch", "roll", "pitch_measured", "pitch_estimate", "roll_reference")}
    signals |= {f"motor_setpoint_{j}": np.cos(t) for j in (1, 2, 3)}
    signals["pitch_reference"] = np.where(t < 1.0, 0.0, 0.3)
    gang = Chart("gang", [Panel([Curve(t, t, f"curve {k}")], "y") for k in range(4)], columns=2)
    long = "a_very_long_name_of_a_file_that_stands_in_a_deep_folder/and_goes_on/model_of_everything.npz"
    wide = Table("wide", [f"column {k}" for k in range(9)], [[long, *["97.4..98.8/97.1..98.3"] * 8]] * 3)
    limits = {"pitch.overshoot_pct": 60.0, "pitch.settling_s": 1.5}
    sections = [
        Section(
            "Result", charts=[loop_chart(t, signals, "loop", limits=limits), gang],
            findings=[("ok", "good"), ("note", "so so"), ("warning", "bad")], method=["how " * 60],
            tables=[Table("narrow", ["metric", "value", ""], [["rise_s", "0.62", "holds"], ["b", "2", "fails"]]), wide],
        ),
        Section("More", text=["words"]),
        Section("The rest", text=["words"]),  # contents are listed for three sections and more
    ]  # fmt: skip
    found = tmp_path_factory.mktemp("pages") / "page.html"
    found.write_text(page("A page of all sorts", sections, verdict="It holds.", holds=True), encoding="utf-8")
    return found


@pytest.fixture(scope="module")
def view(path: Path, browser: Browser) -> Iterator[Shown]:
    with shown(browser, path) as showing:
        yield showing


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_at_any_width(path: Path, browser: Browser, width: int) -> None:
    with shown(browser, path, width=width) as view:
        assert view.page.evaluate("document.documentElement.scrollWidth") <= width
        assert view.page.evaluate(_CUT) == []
        # The names above a plot as well, which Bokeh draws beyond its left edge where they need more room.
        assert all(box["x"] >= 0 for box in legends(view))
        assert view.complaints == []
        if width == 390:
            # A row of many cells stands as a card: nothing is left to scroll sideways.
            assert view.page.evaluate(
                "[...document.querySelectorAll('.scroll')].every(n => n.scrollWidth <= n.clientWidth)"
            )


def legends(view: Shown) -> list[Any]:
    found = [item.bounding_box() for item in view.page.locator(".bk-Legend .bk-item").all()]
    assert len(found) >= 10
    return [box for box in found if box is not None]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_text_has_contrast(view: Shown, scheme: str) -> None:
    view.page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
    assert view.page.evaluate(_CONTRAST) == []
    # Plots turn dark with the page.
    assert (view.page.evaluate("getComputedStyle(document.querySelector('.chart')).filter") == "none") == (
        scheme == "light"
    )


def test_on_paper_it_is_black_on_white_without_what_one_clicks(view: Shown) -> None:
    view.page.emulate_media(media="print", color_scheme="dark")
    assert not view.page.locator("nav").is_visible()
    assert view.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert view.page.evaluate("getComputedStyle(document.querySelector('.chart')).filter") == "none"
    assert view.page.evaluate(_CONTRAST) == []
    view.page.emulate_media(media="screen", color_scheme="light")


def test_the_verdict_comes_first_then_a_picture_then_numbers_then_method(view: Shown) -> None:
    tops = view.page.evaluate(
        "['h1', '.verdict', '.chart', '.findings', 'table', '.method', 'nav']"
        ".map(name => document.querySelector(name).getBoundingClientRect().top)"
    )
    assert tops == sorted(tops)


def test_the_tab_key_goes_down_the_page(view: Shown) -> None:
    places = []
    while len(places) < 60 and sum(tag == "A" for tag, _, _ in places) < 2:
        view.page.keyboard.press("Tab")
        places.append(view.page.evaluate(_FOCUS))
    # The tools beside the plots come first (their plot has the focus then), then contents.
    stops = [(round(top), left) for _, top, left in places]
    assert sum(tag == "A" for tag, _, _ in places) == 2
    assert stops == sorted(stops)


# Words of cells that stand on two lines.
_BROKEN = """() => [...document.querySelectorAll("td")].flatMap(cell => {
  const text = cell.firstChild, range = document.createRange();
  return [...text.data.matchAll(/\\S+/g)].filter(word => {
    range.setStart(text, word.index);
    range.setEnd(text, word.index + word[0].length);
    return range.getClientRects().length > 1;
  }).map(word => word[0]);
})"""


def test_a_table_of_long_names_scrolls_on_a_phone_and_breaks_no_word(browser: Browser, tmp_path: Path) -> None:
    names = ["motor_setpoint_1", "commanded_position_of_winch_1 [rad]", "-2.953 to 3.126 rad", "inverted"]
    table = Table("Channels", ["channel", "from", "in the recording", "changed"], [names], text=2)
    file = tmp_path / "page.html"
    file.write_text(page("Import", [Section("Mapping", tables=[table])]), encoding="utf-8")
    with shown(browser, file, width=400) as view:
        assert view.page.evaluate(_BROKEN) == []
        assert view.page.evaluate("document.documentElement.scrollWidth") <= 400
        assert view.page.evaluate("[...document.querySelectorAll('.scroll')].some(n => n.scrollWidth > n.clientWidth)")
