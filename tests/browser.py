"""A page in headless Chromium: what it asked for, what it complained about, and what its canvases show."""

from __future__ import annotations

import base64
import gzip
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

_FLAGS = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
# The pixels of the drawing of one panel that have exactly a colour: the inside of its curves.
_COUNT = """([chart, panel, colour]) => {
  const figures = [];
  const walk = node => {
    for (const child of node.children) {
      if (child.classList.contains("bk-Figure")) figures.push(child); else walk(child);
      if (child.shadowRoot && !child.classList.contains("bk-Figure")) walk(child.shadowRoot);
    }
  };
  walk(document.querySelectorAll(".chart")[chart]);
  // The canvases of a panel lie on each other, on white; legends have their own elsewhere.
  const layers = [...figures[panel].shadowRoot.querySelector(".bk-Canvas").shadowRoot.querySelectorAll("canvas")];
  const [canvas] = layers;
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", {willReadFrequently: true});
  copy.fillStyle = "white";
  copy.fillRect(0, 0, canvas.width, canvas.height);
  for (const layer of layers) copy.drawImage(layer, 0, 0);
  const pixels = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const [r, g, b] = colour;
  let count = 0;
  for (let i = 0; i < pixels.length; i += 4)
    if (Math.max(Math.abs(pixels[i] - r), Math.abs(pixels[i + 1] - g), Math.abs(pixels[i + 2] - b)) <= 2) count++;
  return count;
}"""
_IDLE = """async () => {
  const frame = () => new Promise(done => requestAnimationFrame(() => setTimeout(done, 0)));
  const charts = document.querySelectorAll(".chart").length;
  if (!charts) return;
  while (typeof Bokeh === "undefined" || Bokeh.documents.length < charts
         || !Bokeh.documents.every(document => document.is_idle)) await frame();
  await frame(); await frame();
}"""


def own_text(html: str) -> str:
    """Return a page without the library that draws its charts, whose text holds addresses that it does not use here.

    The tests in the browser watch that it asks for none, and the page's security policy forbids it.
    """
    return re.sub(r'<script type="application/gzip" id="library">.*?</script>', "", html, flags=re.DOTALL)


def charts_of(html: str) -> str:
    """Return the compressed charts of a page as their JSON."""
    (packed,) = re.findall(r'id="charts">([^<]*)<', html)
    return gzip.decompress(base64.b64decode(packed)).decode()


def chromium_path() -> str:
    """Return the system's Chromium; where there is none, skip the test, but fail where CI has to have one."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        message = "no Chromium here to show pages in; install the package `chromium`"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return found


@contextmanager
def started(path: str) -> Iterator[Browser]:
    """Run the browser at `path` until the end of the block."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_FLAGS)
        yield browser
        browser.close()


@dataclass(frozen=True, slots=True)
class Shown:
    """A page that is shown, and what was noted since it was opened."""

    page: Page
    requests: list[str]
    complaints: list[str]

    def settle(self) -> None:
        """Wait until all charts are drawn."""
        self.page.evaluate(_IDLE)

    def pixels(self, chart: int, panel: int, colour: str) -> int:
        """Count the pixels of a panel that have the colour #rrggbb (or black)."""
        text = "#000000" if colour == "black" else colour
        rgb = [int(text[k : k + 2], 16) for k in (1, 3, 5)]
        return int(self.page.evaluate(_COUNT, [chart, panel, rgb]))

    def x_range(self, chart: int, panel: int = 0) -> tuple[float, float]:
        """Return the range that a panel shows."""
        script = """([chart, panel]) => { const r = Bokeh.documents[chart].roots()[0].children[panel][0].x_range;
            return [r.start, r.end]; }"""
        low, high = self.page.evaluate(script, [chart, panel])
        return low, high

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait until something holds (the page's security policy forbids Playwright's own way), at most 5 s."""
        for _ in range(100):
            if condition():
                return
            self.page.wait_for_timeout(50)
        pytest.fail("the page did not do what was waited for")

    def frame(self, chart: int, panel: int = 0) -> Any:
        """Return the middle of a panel on the screen, as {x, y}."""
        figure = self.page.locator(".chart").nth(chart).locator(".bk-Figure").nth(panel)
        figure.scroll_into_view_if_needed()
        box = figure.bounding_box()
        assert box is not None
        return {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}

    def click_legend(self, chart: int, name: str) -> None:
        """Click the first entry of that name."""
        entry = self.page.locator(".chart").nth(chart).locator(".bk-Legend .bk-item").filter(has_text=name).first
        entry.click()
        self.settle()


@contextmanager
def shown(browser: Browser, path: Path, *, width: int = 1200) -> Iterator[Shown]:
    """Show a file and note every request and complaint."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    requests: list[str] = []
    complaints: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    page.on("websocket", lambda socket: requests.append(socket.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda text: complaints.append(text.text) if text.type in ("error", "warning") else None)
    page.goto(path.as_uri())
    view = Shown(page, requests, complaints)
    view.settle()
    yield view
    page.close()
