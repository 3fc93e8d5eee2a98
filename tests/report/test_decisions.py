"""The sentences that pages open with are `decision` of the JSON, and each figure in them is one of its values."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import load, write_certificate
from softneck.identification import INFINITE, Validation, validate
from softneck.report import decision_values, project_page, read_project, validation_page
from softneck.report._decisions import (
    auto_decision,
    beats,
    fit_word,
    list_fits,
    model_values,
    project_decision,
    validation_decision,
)
from softneck.report._tune import _write_drawn
from softneck.report._tuner import faster_values, faster_words
from softneck.robot import Robot
from softneck.tuning import Candidate
from softneck.verification import Requirement, certificate_values, metric_words

from ..data import ROOT, neck_recording

GOLDEN = ROOT / "tests" / "golden"
FIGURE = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.]*\.(?:npz|csv|toml|json))")


def figures(text: str) -> list[str]:
    """Return the numbers in a text, without those in names of files."""
    return FIGURE.findall(re.sub(r"\S+\.(?:npz|csv|toml|json|html)", "", text))


def values_of(json_values: Any) -> Iterator[float]:
    """Yield all numbers of a JSON value, and the lengths of its lists."""
    if isinstance(json_values, dict):
        for item in json_values.values():
            yield from values_of(item)
    elif isinstance(json_values, list | tuple):
        yield float(len(json_values))
        for item in json_values:
            yield from values_of(item)
    elif isinstance(json_values, int | float):
        yield float(json_values)


def is_value(figure: str, known: list[float]) -> bool:
    """Return whether a figure is one of the values, as far as its digits go."""
    plain = figure.replace(",", "")
    digits = len(plain.partition(".")[2])
    # Three significant digits of `%.3g` may have no decimals.
    return any(f"{value:.{digits}f}" == plain or f"{value:.3g}" == plain for value in known)


def opening(page: str) -> str:
    """Return the text of the sentence that a page opens with."""
    (said,) = re.findall(r'<p class="verdict[^>]*>(.*?)</p>', page, re.DOTALL)
    return html.unescape(said)


@pytest.fixture(scope="module")
def entry() -> dict[str, Any]:
    linear = {"inf": {"flexion": 81.5, "twist": None}}
    fits = {"model": {"inf": {"flexion": 77.25, "twist": 93.5}}, "best_linear": linear, "persistence": {}}
    return {"model": "a/m.npz", "data": "log.csv", "rows_scored": 975, "fits": fits, "diverged": None, "unit": "mm",
            "measured_range": {"flexion": [-1.25, 17.5], "twist": None}}  # fmt: skip


@pytest.mark.parametrize(
    ("fit", "word"),
    [(90.0, "very good"), (89.9, "good"), (70.0, "fair"), (69.9, "poor"), (29.9, "useless"), (None, "no fit")],
)
def test_a_fit_has_a_word(fit: float | None, word: str) -> None:
    assert fit_word(fit) == word


@pytest.mark.parametrize(
    ("fit", "other", "word"),
    [(80.6, 80.0, "beats"), (80.4, 80.0, "equals"), (79.4, 80.0, "misses"), (None, 80.0, ""), (80.0, None, "")],
)
def test_a_fit_is_compared_with_a_baseline(fit: float | None, other: float | None, word: str) -> None:
    assert beats(fit, other) == word


def test_validate_decides_for_the_best_model_and_says_where_to_stop(entry: dict[str, Any]) -> None:
    worse = {**entry, "model": "b.npz", "fits": {**entry["fits"], "model": {"inf": {"flexion": 50.0, "twist": 60.0}}}}
    said = validation_decision([worse, entry])
    assert said == (
        "Use m.npz, the best of 2 models: on 975 rows of log.csv it simulates flexion 77.2 % (fair, below the best "
        "linear fit of these rows, 81.5 %), twist 93.5 % (very good). Do not trust it outside flexion -1.25 "
        "to 17.5 mm: it was not judged there."
    )
    assert "trained" not in validation_decision([{**entry, "rows_trained": 0}])
    assert "It was trained on 120 of these rows: they say nothing about new motions." in validation_decision(
        [{**entry, "rows_trained": 120}]
    )
    lost = {**worse, "diverged": 3.0}
    assert "Diverged: b.npz." in validation_decision([lost, entry])
    assert validation_decision([lost]).startswith("Do not use b.npz: ")
    other = {**entry, "data": "two.csv"}
    assert validation_decision([entry, other]).count("Use m.npz: ") == 2


@pytest.mark.parametrize(("fit", "use"), [(30.0, "Use "), (29.9, "Do not use "), (-5.0, "Do not use "),
                                          (math.nan, "Do not use "), (None, "Do not use ")])  # fmt: skip
def test_a_model_that_design_would_refuse_is_not_to_be_used(entry: dict[str, Any], fit: float | None, use: str) -> None:
    """One output decides, however good the other is; `design` refuses below 30 %."""
    for both in ({"flexion": fit, "twist": 93.5}, {"twist": 93.5, "flexion": fit}):
        fits = {**entry["fits"], "model": {"inf": both}}
        assert validation_decision([{**entry, "fits": fits}]).startswith(use)


def test_a_fit_that_is_no_number_equals_nothing() -> None:
    assert [beats(math.nan, 1.0), beats(1.0, math.nan), beats(1.0, 1.0)] == ["", "", "equals"]


RISE, GAIN, LOAD = (
    Requirement("sim.rise_s", "max", 1.0, False), Requirement("axes.gain_margin", "min", 2.0, False),
    Requirement("step.load_rms_deg", "max", 1.0, False),
)  # fmt: skip


def faster(*others: tuple[str, dict[str, float]]) -> dict[str, Any]:
    """Return what it costs to be faster than a best with all values, among candidates (level, values)."""
    best = {"sim.rise_s": 1.0, "axes.gain_margin": 3.0, "step.load_rms_deg": 0.5}
    items = [
        Candidate("pi", {"k": k}, np.zeros(1), level, {"axes.sensitivity": 1.0 + k, **metrics})
        for k, (level, metrics) in enumerate([("margins", best), *others])
    ]
    task = SimpleNamespace(bounds=(RISE, GAIN, LOAD), robot=Robot.preset(), tested=False)
    found: Any = SimpleNamespace(candidates=items, task=task, best=items[0])
    values = faster_values(found)
    assert values is not None
    return values


def test_what_is_not_computed_of_a_faster_candidate_is_said_and_not_kept() -> None:
    full = {"sim.rise_s": 0.5, "axes.gain_margin": 2.5, "step.load_rms_deg": 0.5}
    one = faster(("margins", full))
    assert (one["breaks"], one["not_computed"], one["fewer_loops"]) == ([], [], False)
    assert faster_words(one, "p").endswith("gain margin, worst axis 3 -> 2.5, and keeps all computed requirements.")
    # One that breaks nothing because little was computed of it is none that keeps all.
    bare = {"sim.rise_s": 0.3}
    for order in ([("all", bare), ("all", full)], [("all", full), ("all", bare)]):
        one = faster(*order)
        assert (one["value"], one["not_computed"], one["fewer_loops"]) == (0.5, [], True)
    one = faster(("all", bare))
    assert one["not_computed"] == ["axes.gain_margin", "step.load_rms_deg"]
    assert faster_words(one, "p").endswith(
        "keeps all computed requirements; 2 were not computed of it; it was judged by fewer loops."
    )
    # A value that is no number costs, and breaks.
    one = faster(("margins", full | {"step.load_rms_deg": math.nan}))
    assert (one["breaks"], set(one["costs"])) == (["step.load_rms_deg"], {"axes.gain_margin", "step.load_rms_deg"})
    assert faster(("margins", full | {"sim.rise_s": 0.81}))["candidate"] is None
    assert faster(("margins", full | {"sim.rise_s": 0.8}))["candidate"] == 1


def test_ahead_is_judged_beside_the_last_sample(entry: dict[str, Any]) -> None:
    fits = {"model": {"5": {"flexion": 60.0}}, "persistence": {"5": {"flexion": 71.0}}, "best_linear": {"5": {}}}
    said = validation_decision([{**entry, "fits": fits}])
    assert "5 samples ahead it fits flexion 60.0 % (repeating the last sample 71.0 %)" in said


def test_auto_names_the_file_and_its_worst_test(entry: dict[str, Any]) -> None:
    trial = {"kind": "play", "hold_out": entry, "fit": 68.75, "worst": "largest motions"}
    facts = {"model": "models/auto.npz", "chosen": "play", "ranking": [{"kind": "oe"}, trial]}
    said = auto_decision(facts)
    assert said.startswith("Use models/auto.npz (play): on rows it has not seen it simulates flexion 77.2 % (fair")
    assert said.endswith("Worst test: 68.8 % (largest motions).")
    lost = {**entry, "fits": {**entry["fits"], "model": {"inf": {"flexion": -3.0}}}}
    facts["ranking"][1]["hold_out"] = lost
    assert auto_decision(facts).startswith("Do not use models/auto.npz (play): simulation fit flexion -3.0 % (useless")


def test_fits_without_a_linear_one_have_their_word_alone() -> None:
    assert list_fits({"x": 91.0, "y": None}) == "x 91.0 % (very good), y - % (no fit)"


def certificate(failed: int) -> dict[str, Any]:
    rows = [
        {"metric": "sim.rise_s", "bound": "max", "limit": 0.4, "value": 0.4437, "holds": False},
        {"metric": "axes.gain_margin", "bound": "min", "limit": 2.5, "value": None, "holds": False, "note": "no plant"},
        {"metric": "sim.of_another_version", "bound": "max", "limit": 1.0, "value": 2.0, "holds": False},
        {"metric": "axes.disk_margin", "bound": "min", "limit": 0.5, "value": 0.61, "holds": True},
    ]
    files = {"controller": {"path": "tune/best.npz"}}
    return {"certificate": "verify", "holds": not failed, "requirements": rows[3 - failed :], "files": files,
            "controller_kind": "hinf"}  # fmt: skip


def test_a_project_decides_on_model_controller_and_next_step() -> None:
    fit = {"x": 91.0, "y": 85.0}
    models = [
        {"file": "a.npz", "kind": "nn", "fit": {"x": 99.0, "y": 99.0}, "chosen": False},
        {"file": "auto.npz", "kind": "play", "fit": fit, "chosen": True, "trained_set_points": [13.6, 146.04],
         "unit": "kPa"},
        {"file": "none.npz", "kind": "oe", "fit": {}, "chosen": False},
    ]  # fmt: skip
    held = [certificate_values("best.certificate.json", certificate(0))]
    said = project_decision(models, held, tuner="tune/tuner.html")
    assert said == (
        "Use auto.npz (play): on rows it has not seen it simulates x 91.0 % (very good), y 85.0 % (good). "
        "It was trained on set-points from 13.6 to 146 kPa: do not trust it outside. "
        "tune/best.npz (hinf) holds all 1 requirements of best.certificate.json. Next: run it on drives with that "
        "certificate (`softneck drives --help`), or open tune/tuner.html to trade speed for caution."
    )
    # What loops over draws say, with the doubt about them, comes before what to do next.
    drawn = certificate_values("best.certificate.json", {**certificate(0), "draws": [{"statement": "2 of 59 fail"}]})
    assert project_decision(models, [drawn], tuner="tune/tuner.html") == said.replace(
        "Next:", "Of its draws: 2 of 59 fail. Next:"
    )
    # A robot in pressures has no CANopen drives: its controller is exported.
    pressures = {**certificate(0), "units": ["kPa", "deg"]}
    said = project_decision([], [certificate_values("c.json", pressures)], tuner=None)
    way = "export it for your own computer (`softneck fmu tune/best.npz --backend compiled`: an FMU, C inside)."
    assert said.endswith(f"Next: {way}")
    turns = certificate_values("c.json", {**certificate(0), "units": ["rad", "deg"]})
    assert project_decision([], [turns], tuner=None).endswith("(`softneck drives --help`).")
    # What does not decide is not held; loops over no model of the robot are not enough for drives.
    for metric, way in (("sim.rise_s", "Next: verify it over a simulation model"), ("sim.slack_s", "Next: run"),
                        ("axes.sensitivity", "Next: run")):  # fmt: skip
        rows = [*certificate(0)["requirements"], {"metric": metric, "value": 0.4, "limit": 0.5, "holds": None}]
        said = project_decision(
            [], [certificate_values("c.json", {**certificate(0), "requirements": rows})], tuner=None
        )
        words = metric_words(metric)
        assert f"holds 1 of 2 requirements of c.json; 1 does not decide ({words})." in said
        assert way in said
    many = [{"metric": f"sim.{name}", "value": None, "limit": 1.0, "holds": None}
            for name in ("rise_s", "overshoot_pct", "settling_s")]  # fmt: skip
    # Where nothing was computed nothing holds, whatever an earlier version wrote.
    said = project_decision([], [certificate_values("c.json", {**certificate(0), "requirements": many})], tuner=None)
    assert said == "Do not run tune/best.npz (hinf) yet: no requirement was judged."
    more = {**certificate(0), "requirements": [*certificate(0)["requirements"][:1], *many]}
    said = project_decision([], [certificate_values("c.json", more)], tuner=None)
    assert "holds 1 of 4 requirements of c.json; 3 do not decide (rise time, simulation; overshoot, " in said
    assert "simulation; 1 more)" in said
    # The certificate that fails decides, wherever it is in the list.
    failed = certificate_values("z.json", certificate(3))
    for both in ([*held, failed], [failed, *held]):
        said = project_decision(models[:1], both, tuner=None)
        assert said == (
            "Use a.npz (nn): on rows it has not seen it simulates x 99.0 % (very good), y 99.0 % (very good). Do not "
            "run tune/best.npz (hinf) yet: 3 of 4 requirements fail: rise time, simulation 0.444 s, required at "
            "most 0.4 s; gain margin, worst axis not computed, required at least 2.5 (no plant) and 1 more. Next: "
            "allow a slower rise, or record another motion and start with both logs."
        )
    # A slower rise computes no margin.
    rows = [{**row, "note": "not computed: the controller adaptive has no linear form"} if row["value"] is None else row
            for row in certificate(3)["requirements"]]  # fmt: skip
    blind = certificate_values("z.json", {**certificate(3), "requirements": rows})
    said = project_decision([], [blind], tuner=None)
    assert "Next: take a kind with a linear form, such as pi or lqg, or record" in said
    # One that is no margin may be loosened.
    rise = certificate_values("z.json", {**certificate(3), "requirements": certificate(3)["requirements"][:1]})
    assert "Next: loosen these, or record" in project_decision([], [rise], tuner=None)
    unknown = certificate_values("z.json", {**certificate(3), "requirements": certificate(3)["requirements"][2:3]})
    assert "sim.of_another_version 2, required at most 1." in project_decision([], [unknown], tuner=None)
    assert project_decision([], [], tuner=None) == ""


def test_a_model_tells_the_set_points_it_was_trained_on_in_the_unit_of_its_robot() -> None:
    robot: Any = SimpleNamespace(motors=SimpleNamespace(unit="kPa"))
    trained = {"min": [13_600.0, 20_000.0], "max": [90_000.0, 146_000.0]}
    model = SimpleNamespace(kind="play", robot=robot, findings={"set_points_rad": trained})
    found = model_values("m.npz", model)
    assert (found["trained_set_points"], found["unit"]) == ([13.6, 146.0], "kPa")
    assert model_values("m.npz", SimpleNamespace(kind="play"))["trained_set_points"] is None


def test_a_project_s_page_opens_with_the_decision_and_links_the_tuner(tmp_path: Path) -> None:
    write_certificate(tmp_path / "c.json", certificate(2))
    for name in ("tune/tuner.html", "build/models.html", ".hidden/a.html"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("<p>page</p>")
    project = read_project(tmp_path)
    values = decision_values(project)
    assert values["tuner"] == "tune/tuner.html"
    page = project_page(project, place=tmp_path / "build")
    assert opening(page).startswith(values["decision"])
    assert values["decision"].startswith("Do not run tune/best.npz (hinf) yet: 2 of 3 requirements fail: ")
    assert [f for f in figures(values["decision"]) if not is_value(f, [2.0, 3.0, *values_of(values)])] == []
    assert re.findall(r'<a href="([^#"]*)">', page) == ["../tune/tuner.html", "models.html"]


@pytest.fixture(scope="module")
def judged() -> list[Validation]:
    rows = neck_recording(300)
    return [validate(GOLDEN / "rls.npz", rows, names=("rls.npz", "n.csv"), horizons=(1, INFINITE))]


@pytest.mark.slow
def test_the_page_opens_with_the_decision_whose_figures_are_in_the_json(judged: list[Validation]) -> None:
    values = [one.as_dict() for one in judged]
    page = validation_page(judged)
    said = opening(page)
    assert said == validation_decision(values)
    known = [*values_of(values)]
    assert figures(said)
    assert [figure for figure in figures(said) if not is_value(figure, known)] == []
    (table,) = re.findall(r"<table.*?</table>", page, re.DOTALL)[:1]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL)][1:]
    assert len(rows) == sum(len(fits) for one in judged for fits in one.fits.values())
    for row in rows:
        for number in row[3:-1]:  # one number a cell, each of the JSON
            assert number == "-" or is_value(number, known), row
        if row[2] == "simulation":
            fit = next(one for one in judged if row[0].startswith(one.model.removesuffix(".npz"))).fits[INFINITE][
                row[1]
            ]
            assert row[-1] == fit_word(fit)


def test_a_loop_without_simulation_model_is_over_the_model_of_the_draws(tmp_path: Path) -> None:
    """Those of the first family with draws, and only where draws decide."""
    model = load(GOLDEN / "greybox.npz")
    family = SimpleNamespace(draws=SimpleNamespace(model=model))
    linear = {"rls.npz": SimpleNamespace(), "box.npz": SimpleNamespace(draws=None), "family.npz": family}
    found: Any = SimpleNamespace(task=SimpleNamespace(drawn=(), linear=linear))
    assert _write_drawn(found, tmp_path) == {}
    assert list(tmp_path.iterdir()) == []
    found.task.drawn = ("family.npz, draw 1",)
    ((_, path),) = _write_drawn(found, tmp_path).items()
    assert path.parent == tmp_path
    copied = load(path)
    assert copied.kind == "greybox"
    assert all(np.array_equal(copied.arrays[name], values) for name, values in model.arrays.items())
