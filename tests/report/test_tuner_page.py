"""The tuner page in a browser: sliders, limits and sentences follow the values of the search."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import softneck
from softneck.cli._main import run
from softneck.plots import cell
from softneck.report import write_tuned
from softneck.tuning import Tuned, tune

from ..browser import Shown, own_text, shown
from ..data import ROOT
from .test_decisions import figures, is_value, opening, values_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

PLANTS = {name: ROOT / "tests" / "golden" / name for name in ("oe.npz", "greybox.npz")}
ASKED: dict[str, Any] = {
    "sampling": {"plants": 12, "search_generations": 0}, "step": {"duration_s": 2.0}, "sim": {"duration_s": 2.5},
    "require": {"sim.rise_s": {"max": 0.9}, "axes.sensitivity": {"max": 3.0}},
}  # fmt: skip
_EPS = 1e-9


@dataclass(frozen=True)
class Made:
    found: Tuned
    folder: Path
    values: dict[str, Any]  # those of --json
    data: dict[str, Any]  # those on the page


def packed_data(html: str) -> dict[str, Any]:
    (text,) = re.findall(r'id="data">([^<]*)<', html)
    return json.loads(gzip.decompress(base64.b64decode(text)))


@pytest.fixture(scope="module", params=["linear", "simulated"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("tuned")
    plants = dict(list(PLANTS.items())[: 1 if request.param == "linear" else 2])
    asked = {**ASKED, "require": {"step.rise_s": {"max": 1.2}}} if request.param == "linear" else ASKED
    named = {name: str(path) for name, path in plants.items()}
    budget = 10 if request.param == "linear" else 30
    found = tune(named, asked, kinds=("pi",), budget=budget, workers=0, folder=folder)
    values = write_tuned(found, folder, plants)
    return Made(found, folder, values, packed_data((folder / "tuner.html").read_text()))


def test_the_report_opens_with_the_decision_whose_figures_are_in_the_json(made: Made) -> None:
    """What fails is named in words with its value and limit; a search that holds says what to do next."""
    said = opening((made.folder / "report.html").read_text())
    assert said == made.values["decision"]
    assert figures(said)
    rows = made.values["verdicts"]
    counts = [float(len(rows)), *(float(sum(row["holds"] is held for row in rows)) for held in (True, False, None))]
    # The note of a requirement is text of its own.
    notes = [row["note"] for row in rows if row["note"]]
    for note in notes:
        said = said.replace(note, "")
    known = [*counts, *(count - 2.0 for count in counts), *values_of(made.values)]
    assert [figure for figure in figures(said) if not is_value(figure, known)] == []
    if made.found.holds:
        held = "all" if counts[1] == len(rows) else f"{int(counts[1])} of"
        assert said.startswith(f"best.npz (pi) holds {held} {len(rows)} requirements of ")
        # Without a simulation model no loop was simulated: that decides nothing.
        assert made.found.task.own or {row["holds"] for row in rows if row["metric"].startswith("track.")} == {None}
    else:
        assert said.startswith(f"Do not run best.npz (pi) yet: {int(counts[2])} of {len(rows)} requirements fail: ")
    assert made.data["certified"] in made.values["decision"].replace("; open tuner.html to trade speed for caution", "")


@pytest.fixture
def view(made: Made, browser: Browser) -> Iterator[Shown]:
    with shown(browser, made.folder / "tuner.html") as page:
        page.wait(lambda: page.page.evaluate("typeof tuner !== 'undefined'"))
        yield page
        assert page.complaints == []
        assert [url for url in page.requests if not url.startswith(("file:", "blob:", "data:"))] == []


def digits(value: float) -> str:
    """Return a value as the page writes it: three significant digits."""
    return f"{float(f'{value:.3g}'):g}"


def move(view: Shown, name: str, value: float) -> None:
    view.page.locator(f"#{name}").evaluate(
        "(node, value) => { node.value = value; node.dispatchEvent(new Event('input')); }", value
    )
    view.settle()


def chosen(view: Shown) -> int:
    return int(view.page.evaluate("tuner.chosen.number"))


def test_every_verdict_is_that_of_the_search(made: Made, view: Shown) -> None:
    words = view.page.evaluate("tuner.candidates.map(one => tuner.verdicts(one))")
    task = made.found.task
    by_x = sorted(made.found.candidates, key=lambda item: item.metrics[made.found.objectives[0]])
    assert len(words) == len(by_x) >= 2
    for item, said in zip(by_x, words, strict=True):
        ratios = item.ratios(task.bounds, tested=task.tested)
        for one, word in zip(made.data["requirements"], said, strict=True):
            ratio = ratios.get(one["metric"])
            assert word == ("not computed" if ratio is None else "holds" if ratio <= 1.0 else "fails")
        assert ("fails" not in said) == item.holds(task.bounds, tested=task.tested)


def test_the_page_opens_with_the_best_in_the_values_of_the_json(made: Made, view: Shown) -> None:
    best = made.values["best"]
    rows = made.data["requirements"]
    for k, one in enumerate(rows):
        value = best["metrics"].get(one["metric"])
        said = view.page.locator(f"#value-{k}").inner_text()
        assert said.split(" ")[0] == ("-" if value is None else digits(value))
        assert float(view.page.locator(f"#limit-{k}").input_value()) == pytest.approx(one["limit"], rel=1e-5)  # :g
    verdict = view.page.locator(".verdict").inner_text()
    task = made.found.task
    ratios = made.found.best.ratios(task.bounds, tested=task.tested)
    broken = [one for one in rows if ratios.get(one["metric"], 0.0) > 1.0]
    assert f"{best['kind']} (best.npz)" in verdict
    if broken:
        assert f"breaks {len(broken)} of {len(ratios)} requirements" in verdict
        for one in broken[:4]:
            value = best["metrics"].get(one["metric"])
            assert value is None or f"{one['name']} {digits(value)}" in verdict
    else:
        assert f"keeps all {len(ratios)} requirements" in verdict
    assert view.page.locator("#file").inner_text().startswith(f"Its file is already there: {best['file']}.")


def test_sliders_choose_the_nearest_and_draw_it(made: Made, view: Shown) -> None:
    for speed, caution in ((100, 0), (0, 100), (40, 70)):
        move(view, "speed", speed)
        move(view, "caution", caution)
        far = [(one["speed"] - speed) ** 2 + (one["caution"] - caution) ** 2 for one in made.data["candidates"]]
        one = made.data["candidates"][int(np.argmin(far))]
        assert chosen(view) == one["number"]
        drawn = view.page.evaluate(
            """Object.values(tuner.plots[tuner.panels.step].renderers.filter(r => r.name === "one plant")
            .map(r => Array.from(r.data_source.data[r.glyph.y.field]))[0])"""
        )
        assert drawn == one["curves"]["value"]
        assert view.page.locator("#speed-says").inner_text().split(": ")[1].startswith(digits(one["x"]))
        assert view.page.locator("#command").inner_text() == one["command"]


def test_the_fastest_and_the_most_cautious_stand_at_the_ends(made: Made) -> None:
    each = made.data["candidates"]
    assert min(each, key=lambda one: one["x"])["speed"] == 100.0
    assert max(each, key=lambda one: one["x"])["speed"] == 0.0
    assert min(each, key=lambda one: one["y"])["caution"] == 100.0  # of the peak sensitivity, the smallest
    for one in each:
        low, high, value = (np.array(one["curves"][name]) for name in ("low", "high", "value"))
        assert (low - _EPS <= value).all()
        assert (value <= high + _EPS).all()
        assert value[-1] == pytest.approx(one["curves"]["reference"][0], rel=0.2)


def test_a_limit_that_is_moved_turns_what_breaks_it_grey(made: Made, view: Shown) -> None:
    number = made.data["x_limit"]
    xs = [one["x"] for one in made.data["candidates"]]
    view.page.locator(f"#limit-{number}").fill(repr(min(xs) * 0.999))
    view.settle()
    grey = """tuner.plots[0].renderers.filter(r => r.name === "breaks a requirement")
        .map(r => Array.from(r.data_source.data[r.glyph.y.field]).filter(Number.isFinite).length)[0]"""
    assert view.page.evaluate(grey) == len(xs)
    assert view.page.locator(f"#verdict-{number}").inner_text() == "fails"
    assert "breaks" in view.page.locator(".verdict").inner_text()
    assert view.pixels(0, 0, "#AAAAAA") > 20
    assert view.pixels(0, 0, "#009E73") < 20  # no candidate is green now


def test_what_20_percent_more_speed_costs_is_another_candidate(made: Made, view: Shown) -> None:
    move(view, "speed", 0)
    now = made.data["candidates"][chosen(view) - 1]
    said = view.page.locator("#cost").inner_text()
    assert f"at most {digits(0.8 * now['x'])}" in said
    found = re.search(r"candidate (\d+) \(", said)
    assert found is not None
    other = made.data["candidates"][int(found[1]) - 1]
    assert other["x"] <= 0.8 * now["x"]
    for k, one in enumerate(made.data["requirements"]):
        if f"{one['name']} " in said and f"instead of {digits(float(now['values'][k]))}" in said:
            assert f"{one['name']} {digits(float(other['values'][k]))}" in said


def test_the_decision_prices_20_percent_more_speed_as_the_page_does(made: Made, view: Shown) -> None:
    one, said, candidates = made.values["faster"], made.values["decision"], made.data["candidates"]
    page, best = view.page.locator("#cost").inner_text(), next(each for each in candidates if each["best"])
    assert one["at_most"] == pytest.approx(0.8 * best["x"], rel=1e-12)
    assert f"20 % faster ({made.data['x_name']} at most {one['at_most']:.3g} s): " in said
    if one["candidate"] is None:
        assert min(each["x"] for each in candidates) > one["at_most"]
        assert said.endswith("no judged candidate is.")
        assert "no judged candidate is" in page
        return
    other = candidates[one["candidate"] - 1]
    assert other["x"] == one["value"] <= one["at_most"]
    assert f"candidate {one['candidate']} of tuner.html (pi, {one['value']:.3g} s) costs " in said
    assert f"candidate {one['candidate']} (pi, " in page
    # What the search has not computed of it is said on both.
    assert set(one["not_computed"]) >= {item["metric"] for k, item in enumerate(made.data["requirements"])
                                        if other["values"][k] is None and not other["unproven"][k]}  # fmt: skip
    for text, said_open in ((page, "Not computed of it: "), (said, "were not computed of it")):
        assert (said_open in text) is bool(one["not_computed"])
        assert ("judged by fewer loops" in text) is one["fewer_loops"] is (other["level"] < best["level"])
    assert all(name in page for name in made.data["elsewhere"])
    told = 0
    for k, item in enumerate(made.data["requirements"]):
        (before, after), cost = (each["values"][k] for each in (best, other)), one["costs"].get(item["metric"])
        if cost is None:
            assert None in (before, after) or (
                float(after) >= 0.95 * float(before) if item["bound"] == "min" else float(after) <= 1.05 * float(before)
            )
        else:
            assert (cost["best"], cost["faster"]) == (before, after)
            here = f"{item['name']} {cell(before, '.3g')} -> {cell(after, '.3g')}" in said
            assert here or item["metric"] not in one["breaks"]
            told += here
    assert told == min(len(one["costs"]), 4)
    verdicts = view.page.evaluate(f"tuner.verdicts(tuner.candidates[{one['candidate'] - 1}])")
    breaks = [item["metric"] for item, word in zip(made.data["requirements"], verdicts, strict=True) if word == "fails"]
    assert set(breaks) == set(one["breaks"])


def test_keys_move_the_sliders(made: Made, view: Shown) -> None:
    view.page.locator("#speed").focus()
    view.page.keyboard.press("End")
    assert view.page.locator("#speed").input_value() == "100"
    view.page.keyboard.press("Home")
    view.settle()
    caution = view.page.locator("#caution").evaluate("node => node.valueAsNumber")
    far = [one["speed"] ** 2 + (one["caution"] - caution) ** 2 for one in made.data["candidates"]]
    assert chosen(view) == made.data["candidates"][int(np.argmin(far))]["number"]


def test_the_page_is_small_reaches_no_network_and_fits_a_phone(made: Made, browser: Browser) -> None:
    path = made.folder / "tuner.html"
    assert path.stat().st_size < 3e6
    assert "http" not in own_text(path.read_text()).replace("http-equiv", "")
    with shown(browser, path, width=400) as view:
        assert view.page.evaluate("document.documentElement.scrollWidth") <= 400
        assert view.page.locator("#speed").bounding_box()["height"] >= 24  # type: ignore[index]  # WCAG 2.5.8


def test_the_command_makes_the_candidate(made: Made, tmp_path: Path) -> None:
    one = next(one for one in made.data["candidates"] if one["best"])
    words = shlex.split(one["command"].splitlines()[0])
    words[words.index("-o") + 1] = str(tmp_path / "again.npz")
    assert run(words[1:]) == 0
    again, best = softneck.load(tmp_path / "again.npz").block(), made.found.controller.block()
    for left, right in zip(again.arrays, best.arrays, strict=True):
        np.testing.assert_array_equal(left, right)
