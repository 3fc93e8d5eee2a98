"""The validation page: what `validate` found, all of it, and a browser that draws it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from softneck.identification import INFINITE, Model, Validation, validate
from softneck.plots._chart import BLUE, COLOURS, ORANGE
from softneck.report import validation_page
from softneck.signals import Recording, concatenate

from ..browser import charts_of, shown

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results(models: dict[str, Model], neck: Recording) -> list[Validation]:
    rows = neck.rows(600, 1400)
    return [validate(models[name], rows, names=(f"{name}.npz", "neck.csv")) for name in ("rls", "nlsm", "nn")]


@pytest.fixture(scope="module")
def html(results: list[Validation]) -> str:
    return validation_page(results)


def _headings(html: str) -> list[str]:
    return re.findall(r"<h[23]>(.*?)</h[23]>", html)


def _tables(html: str) -> list[list[list[str]]]:
    tables = [
        re.findall(r"<tr>(.*?)</tr>", table) for table in re.findall(r"<table[^>]*>(.*?)</table>", html, re.DOTALL)
    ]
    return [[re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows] for rows in tables]


def test_the_page_tells_every_fit_beside_persistence(results: Sequence[Validation], html: str) -> None:
    head, *rows = _tables(html)[0]
    assert len(rows) == sum(len(fits) for r in results for fits in r.fits.values())
    persistence, model, linear = (head.index(name) for name in ("persistence", "model", "best linear"))
    by_name = {tuple(row[:3]): row for row in rows}
    for r in results:
        for horizon, fits in r.fits.items():
            for axis, fit in fits.items():
                row = by_name[f"{Path(r.model).stem} on neck", axis, "simulation" if horizon == INFINITE else horizon]
                held, best = r.persistence.get(horizon, {}).get(axis), r.best_linear.get(horizon, {}).get(axis)
                for column, value in ((model, fit), (persistence, held), (linear, best)):
                    assert row[column] == ("-" if value is None else f"{value:.1f}")


def test_all_free_runs_come_first_and_then_each_model(html: str) -> None:
    headings = _headings(html)
    assert headings[:2] == ["Fits", "Simulations on neck"]
    names = ("rls", "nlsm", "nn")
    assert [h for h in headings if h.endswith(" on neck")] == ["Simulations on neck", *(f"{n} on neck" for n in names)]
    assert [h for h in headings if h.endswith("measured and predicted")] == [
        f"{name} on neck: measured and predicted" for name in names
    ]
    assert headings.count("Residual tests of the one-step errors") == 3


def test_one_model_or_other_rows_are_not_compared(results: Sequence[Validation], models: dict, neck: Recording) -> None:
    alone = _headings(validation_page(results[:1]))
    assert "Simulations on neck" not in alone
    assert alone[:2] == ["Fits", "rls on neck: measured and predicted"]
    assert sum(h.endswith("measured and predicted") for h in alone) == 1
    other = validate(models["rls"], neck.rows(1400, 2000), names=("rls.npz", "neck.csv"))
    assert "Simulations on neck" not in _headings(validation_page([results[1], other]))


def test_the_verdict_names_the_model_of_the_best_free_run(results: Sequence[Validation], html: str) -> None:
    best = max(results, key=lambda r: min(-np.inf if fit is None else fit for fit in r.fits[INFINITE].values()))
    (said,) = re.findall(r'<p class="verdict ?">(.*?)</p>', html)
    assert said.startswith(
        f"Use {best.model}, the best of 3 models: on {best.rows_scored} rows of neck.csv it simulates "
    )
    for name, fit in best.fits[INFINITE].items():
        assert f"{name} {fit:.1f} % (" in said


def test_models_of_one_file_name_keep_their_folders_apart(results: Sequence[Validation]) -> None:
    twins = [replace(results[0], model="a/rls.npz"), replace(results[1], model="b/rls.npz")]
    html = charts_of(validation_page(twins))
    assert "a/rls.npz" in html
    assert "b/rls.npz" in html


def test_a_diverged_free_run_is_said_and_not_drawn_to_infinity(results: Sequence[Validation]) -> None:
    r = results[0]
    free = r.free_run.copy()
    free[400:] = 1e9
    runs = [entry | {"diverged": float(r.time[400])} for entry in r.per_run]
    lost = replace(r, free_run=free, per_run=runs, diverged=float(r.time[400]))
    assert f"diverged at {r.time[400]:.2f} s" in validation_page([lost])


def test_a_validation_without_free_run_makes_a_page_too(models: dict[str, Model], neck: Recording) -> None:
    r = validate(models["rls"], neck.rows(600, 900), names=("rls.npz", "neck.csv"), horizons=(1,))
    assert "Residual tests of the one-step errors" in _headings(validation_page([r]))


def test_a_browser_draws_all_of_it_in_silence(html: str, browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "validation.html"
    path.write_text(html, encoding="utf-8")
    with shown(browser, path) as view:
        assert [request for request in view.requests if not request.startswith(("data:", "blob:"))] == [path.as_uri()]
        assert view.complaints == []
        titles = view.page.locator("figure h3").all_inner_texts()
        assert len(titles) == view.page.locator(".chart").count()
        for number, title in enumerate(titles):
            panels = view.page.locator(".chart").nth(number).locator(".bk-Figure").count()
            assert panels >= 2, title
            for panel in range(panels):
                # Whatever a panel shows, some of it has one of our colours.
                assert sum(view.pixels(number, panel, c) for c in (*COLOURS, "#66aad1")) > 20, (title, panel)
        # All free runs: hiding one leaves the others.
        before = view.pixels(0, 1, ORANGE)
        view.click_legend(0, "rls")
        assert view.pixels(0, 1, BLUE) == 0
        assert view.pixels(0, 1, ORANGE) > 0
        assert before > 0


def test_bounds_are_a_band_where_a_model_has_them(results: Sequence[Validation]) -> None:
    banded = [np.isfinite(r.lower).any() for r in results]
    assert any(banded)
    assert [("The band shows" in validation_page([r])) for r in results] == banded


def test_residual_tests_and_scores_of_each_run_are_told(models: dict[str, Model], neck: Recording) -> None:
    parts = concatenate([neck.rows(600, 900), neck.rows(1000, 1300)])
    r = validate(models["rls"], parts, names=("rls.npz", "neck.csv"))
    html = validation_page([r])
    assert "Residual tests of the one-step errors" in _headings(html)
    head, *rows = _tables(html)[1]
    assert len(r.per_run) == 2
    free = head.index("simulation")
    cells = [f"{fit:.1f}" for entry in r.per_run for fit in entry["fits"][INFINITE].values()]
    assert [row[free] for row in rows] == cells
