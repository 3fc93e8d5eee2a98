"""Time that a browser takes to zoom and redraw 30,000 samples; run with `pytest tests/benchmarks --benchmark-only`.

Issue 4: under 1 s. Each round sets the range of a chart and waits for the frame after which all its panels are drawn.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.plots import Section, page
from softneck.plots._charts import recording_chart, residual_chart, validation_chart
from softneck.report import write_tuned
from softneck.signals import Recording
from softneck.tuning import tune

from ..browser import shown
from ..data import ROOT

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROWS, TS = 30_000, 0.02
# Milliseconds from setting the range to the end of the frame in which all is drawn.
_ZOOM = """async ([chart, low, high]) => {
  const frame = () => new Promise(done => requestAnimationFrame(() => setTimeout(done, 0)));
  const range = Bokeh.documents[chart].roots()[0].children[0][0].x_range;
  const start = performance.now();
  range.setv({start: low, end: high});
  do await frame(); while (!Bokeh.documents[chart].is_idle);
  await frame();
  return performance.now() - start;
}"""


def validation_html(rows: int) -> str:
    rng = np.random.default_rng(0)
    t = np.arange(rows) * TS
    y = np.column_stack([0.4 * np.sin(0.5 * t) + 0.1 * np.sin(1.7 * t), 0.3 * np.cos(0.4 * t)])
    e = 1e-3 * rng.standard_normal(y.shape)
    runs = {"one step": y + e, "free run": y + 0.1 * np.cumsum(e, axis=0)}
    motors = np.column_stack([np.sign(np.sin(0.2 * t + j)) for j in range(3)])
    lags, cross_lags = np.arange(26), np.arange(-25, 26)
    charts = [
        validation_chart(t, y, runs, "Measured and predicted", bounds=(y - 0.05, y + 0.05)),
        validation_chart(t, y, {f"model {k}": y + k * e for k in range(3)}, "Free runs"),
        recording_chart(Recording.from_arrays(motors, y), "Recording"),
        residual_chart(
            (lags, 0.01 * rng.standard_normal((2, 26)), np.full(2, 0.015)),
            (cross_lags, 0.01 * rng.standard_normal((2, 3, 51)), np.full((2, 3), 0.03)),
            "Residual tests",
        ),
    ]
    return page("30,000 samples", [Section("Validation", charts=charts)])


@pytest.mark.benchmark(group="page of 30,000 samples")
def test_make_the_page(benchmark: BenchmarkFixture) -> None:
    html = benchmark.pedantic(validation_html, args=(ROWS,), rounds=3)
    print(f"page of {len(html) / 1e6:.1f} MB")


@pytest.mark.benchmark(group="page of 30,000 samples")
@pytest.mark.parametrize("chart", [0, 1, 2], ids=["validation", "three models", "recording"])
def test_zoom_and_redraw(benchmark: BenchmarkFixture, browser: Browser, tmp_path: Path, chart: int) -> None:
    path = tmp_path / "page.html"
    path.write_text(validation_html(ROWS), encoding="utf-8")
    whole = (0.0, ROWS * TS)
    ranges = [(100.0, 200.0), whole, (0.0, 300.0), whole, (10.0, 11.0), whole]
    with shown(browser, path) as view:

        def zoom_all() -> list[float]:
            return [view.page.evaluate(_ZOOM, [chart, low, high]) for low, high in ranges]

        times = benchmark.pedantic(zoom_all, rounds=3)
        print(f"zoom and redraw [ms]: {[round(time) for time in times]}")
        assert max(times) < 1000.0
        assert view.x_range(chart) == whole


# Milliseconds from moving a slider of the tuner page to the end of the frame in which all is drawn.
_MOVE = """async value => {
  const frame = () => new Promise(done => requestAnimationFrame(() => setTimeout(done, 0)));
  const node = document.getElementById("speed");
  await frame();
  const start = performance.now();
  node.value = value;
  node.dispatchEvent(new Event("input"));
  do await frame(); while (!Bokeh.documents[0].is_idle);
  return performance.now() - start;
}"""


@pytest.mark.benchmark(group="tuner page")
def test_move_a_slider_of_the_tuner(benchmark: BenchmarkFixture, browser: Browser, tmp_path: Path) -> None:
    """Five moves of the slider `speed`, each to the end of the frame in which all is drawn."""
    plants = {"oe.npz": ROOT / "tests" / "golden" / "oe.npz"}
    asked = {"sampling": {"plants": 12, "search_generations": 0}, "step": {"duration_s": 2.0}}
    found = tune({name: str(path) for name, path in plants.items()}, asked, kinds=("pi",), budget=10, workers=0,
                 folder=tmp_path)  # fmt: skip
    write_tuned(found, tmp_path, plants)
    with shown(browser, tmp_path / "tuner.html") as view:
        view.wait(lambda: view.page.evaluate("typeof tuner !== 'undefined'"))

        rounds: list[list[float]] = []

        def move_all() -> None:
            rounds.append([view.page.evaluate(_MOVE, value) for value in (0, 100, 25, 75, 50)])

        benchmark.pedantic(move_all, rounds=15)
        times = np.median(rounds, axis=0)
        print(f"frames of the tuner page, medians [ms]: {np.round(times, 1)}")
