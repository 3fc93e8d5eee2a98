"""The loop page: what it plays, marks and says comes from the run, and it plays in a browser."""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from softneck.core import to_si
from softneck.cosim import Result
from softneck.loop import LoopResult
from softneck.report import fault_values, loop_decision, loop_page
from softneck.robot import Robot

from ..browser import Shown, own_text, shown

if TYPE_CHECKING:
    from playwright.sync_api import Browser

TS, STEP, ROWS = 0.02, 50, 200


class Fault:
    kind, start, duration = "sensor_dropout", 2.0, float("inf")


FAULTS = fault_values([Fault()])


BELLOWS = {
    "name": "bellows", "motors": {"names": ["pressure"], "unit": "kPa"}, "directions": {"kind": "identified"},
    "outputs": {"names": ["flexion"], "unit": "m", "display_unit": "mm", "min": -0.2, "max": 0.2},
}  # fmt: skip


def robot_of(name: str) -> Robot:
    return Robot.from_dict(BELLOWS) if name == "bellows" else Robot.preset(name)


def result(name: str, limits: dict[str, float]) -> Result:
    """A step of the first output that overshoots by a fifth for 0.5 s."""
    robot = robot_of(name)
    first, *others = robot.outputs.names
    time = np.arange(ROWS) * TS
    r = np.where(np.arange(ROWS) < STEP, 0.0, 0.1)
    y = r.copy()
    y[STEP + 10 : STEP + 35] = 0.12
    signals = {first: y, **dict.fromkeys(others, 0.0 * r), f"{first}_reference": r}
    signals |= {f"{other}_reference": 0.0 * r for other in others}
    signals |= dict.fromkeys(robot.set_points, 0.25 * r)
    return Result(signals=LoopResult(time, signals, {}, TS, robot), bounds=limits, wall_time=1.0)


def data_of(page: str) -> dict[str, Any]:
    (text,) = re.findall(r'id="data">([^<]*)<', page)
    return json.loads(gzip.decompress(base64.b64decode(text)))


@pytest.mark.parametrize("name", ["neck", "bellows"])
def test_the_page_plays_the_values_of_the_run_in_the_robot_s_units(name: str) -> None:
    found = result(name, {f"{robot_of(name).outputs.names[0]}.overshoot_pct": 5.0})
    robot, first = found.robot, found.robot.outputs.names[0]
    page = loop_page("loop", found, faults=FAULTS)
    data = data_of(page)
    assert data["bends"] == (name == "neck")
    assert data["time"] == pytest.approx(found.signals.time.tolist())
    # Five digits are on the page.
    shown_value = found.signals[first] / to_si(robot.outputs.display_unit)[0]
    assert data["outputs"][0]["value"] == pytest.approx(shown_value.tolist(), rel=1e-4)
    assert [(one["name"], one["unit"]) for one in data["outputs"]] == [
        (output, robot.outputs.display_unit) for output in robot.outputs.names
    ]
    for one in data["outputs"]:
        assert one["low"] <= min(one["value"])
        assert one["high"] >= max(one["value"])
        assert one["high"] > one["low"]
    fault, broken = data["marks"]
    assert fault == {"kind": "fault", "label": "fault: sensor dropout", "start": 2.0, "end": (ROWS - 1) * TS}
    assert (broken["kind"], broken["start"], broken["end"]) == ("broken", (STEP + 10) * TS, (STEP + 34) * TS)
    (said,) = re.findall(r'<p class="verdict fails">(.*?)</p>', page)
    (row,) = found.limits
    assert html.unescape(said) == loop_decision(found.limits)
    assert html.unescape(said) == (
        f"Do not run this loop: 1 of 1 limits broken: overshoot of {first} ({first}.overshoot_pct) {row['value']:.3g}, "
        "limit 5."
    )


def test_what_holds_names_the_nearest_limit_in_words() -> None:
    rows = [
        {"metric": "pitch.overshoot_pct", "limit": 5.0, "value": 1.0, "holds": True},
        {"metric": "pitch.settling_s", "limit": 2.0, "value": 1.5, "holds": True},
    ]
    assert loop_decision(rows) == (
        "In this run all 2 limits hold; the nearest is settling time of pitch (pitch.settling_s), 1.5 of 2."
    )
    assert "no limits" in loop_decision([])


def test_a_missing_sample_and_a_long_run_are_played() -> None:
    found = result("neck", {})
    found.signals.signals["pitch"][3] = np.nan
    data = data_of(loop_page("loop", found))
    assert data["outputs"][0]["value"][3] is None
    assert data["marks"] == []
    time = np.arange(100_000) * TS
    names = ("pitch", "roll", "pitch_reference", "roll_reference", *found.robot.set_points)
    signals = dict.fromkeys(names, np.zeros(time.size))
    data = data_of(loop_page("loop", Result(signals=LoopResult(time, signals, {}, TS, found.robot))))
    assert 750 <= len(data["time"]) <= 1500
    assert data["pace"] == pytest.approx(time[-1] / 30.0)  # 2,000 s are played in 30 s


@pytest.fixture(scope="module", params=["neck", "bellows"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    limits = {f"{robot_of(request.param).outputs.names[0]}.overshoot_pct": 5.0}
    path = tmp_path_factory.mktemp("loop") / "loop.html"
    path.write_text(loop_page("loop", result(request.param, limits), faults=FAULTS), encoding="utf-8")
    return path


@pytest.fixture
def view(made: Path, browser: Browser) -> Iterator[Shown]:
    with shown(browser, made) as page:
        page.wait(lambda: page.page.evaluate("typeof player !== 'undefined'"))
        yield page
        assert page.complaints == []
        assert [url for url in page.requests if not url.startswith(("file:", "blob:", "data:"))] == []


_LINES = "player.lines.map(line => line.location)"


@pytest.mark.slow
def test_slider_keys_and_button_move_the_outputs(made: Path, view: Shown, browser: Browser) -> None:
    data = data_of(made.read_text())
    scene = "document.getElementById('scene').toDataURL()"
    at_rest = view.page.evaluate(scene)
    view.page.locator("#moment").focus()
    view.page.keyboard.press("End")
    k = len(data["time"]) - 1
    first = data["outputs"][0]
    said = view.page.locator("#now").inner_text()
    assert f"{first['name']} {first['value'][k]:.3g} {first['unit']}" in said
    assert "fault: sensor dropout" in said
    assert set(view.page.evaluate(_LINES)) == {data["time"][k]}
    assert view.page.evaluate(scene) != at_rest
    view.page.keyboard.press("ArrowLeft")
    assert view.page.evaluate("player.frame") == k - 1
    marks = view.page.locator("#marks i")
    assert marks.count() == len(data["marks"])
    box, strip = marks.first.bounding_box(), view.page.locator("#marks").bounding_box()
    assert box is not None
    assert strip is not None
    # A fault from 2.0 of 3.98 s; a border of one pixel.
    assert (box["x"] - strip["x"]) / strip["width"] == pytest.approx(2.0 / data["time"][k], abs=0.01)
    view.page.keyboard.press("Home")
    view.page.locator("#play").focus()
    view.page.keyboard.press("Space")
    view.wait(lambda: view.page.evaluate("player.frame") > 5)
    assert view.page.locator("#play").inner_text() == "Pause"
    view.page.keyboard.press("Space")
    stopped = view.page.evaluate("player.frame")
    view.page.wait_for_timeout(200)
    assert view.page.evaluate("player.frame") == stopped
    assert made.stat().st_size < 3e6
    assert "http" not in own_text(made.read_text()).replace("http-equiv", "")
    with shown(browser, made, width=400) as phone:
        assert phone.page.evaluate("document.documentElement.scrollWidth") <= 400
