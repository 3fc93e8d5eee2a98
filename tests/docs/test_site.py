"""The documentation can be found one's way in, and its notebooks run."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import pytest

from ..browser import chromium_path, started
from ..data import ROOT

if TYPE_CHECKING:
    from playwright.sync_api import Page

DOCS = ROOT / "docs"
NOTEBOOKS = sorted(path.stem for path in (DOCS / "notebooks").glob("*.py"))


@pytest.fixture(scope="module")
def extension() -> ModuleType:
    """The one that runs notebooks."""
    spec = importlib.util.spec_from_file_location("executed", DOCS / "executed.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def entries(page: Path) -> list[list[str]]:
    """Return the entries of each group of a page's contents."""
    trees = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    return [[line for line in tree.splitlines() if line and not line.startswith(":")] for tree in trees]


def test_the_index_has_four_groups_and_at_most_twelve_entries() -> None:
    groups = entries(DOCS / "index.md")
    assert len(groups) == 4
    assert sum(map(len, groups)) <= 12
    captions = re.findall(r":caption: (.+)", (DOCS / "index.md").read_text(encoding="utf-8"))
    assert captions == ["Tutorials", "How-to", "Explanation", "Reference"]


def test_every_page_is_at_most_two_steps_away() -> None:
    first = {DOCS / f"{name}.md" for group in entries(DOCS / "index.md") for name in group}
    second = {(page.parent / f"{name}.md").resolve() for page in first for group in entries(page) for name in group}
    pages = {path for path in DOCS.rglob("*.md") if "_build" not in path.parts}
    rooms = set((DOCS / "reference" / "api").glob("*.md"))  # three: they have an index of their own
    assert pages - rooms - first - second - {DOCS / "index.md"} == set()


def test_cells_are_words_and_code(extension: ModuleType) -> None:
    found = extension.cells("# %% [markdown]\n# # Title\n#\n# words\n\n# %%\nx = 1\nx + 1\n")
    assert found == [(True, "# Title\n\nwords"), (False, "x = 1\nx + 1")]


def test_a_cell_shows_what_it_prints_and_what_its_last_line_is_worth(extension: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "n.py"
    path.write_text("# %%\nx = 1\n\n# %%\nprint('said')\nx + 1\n\n# %%\nx = 5\n", encoding="utf-8")
    text = extension.executed(path)
    assert text.count("```text") == 2
    assert "```text\nsaid\n```" in text
    assert "```text\n2\n```" in text
    path.write_text("# %%\n1 / 0\n", encoding="utf-8")
    with pytest.raises(ZeroDivisionError):
        extension.executed(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_shows_something(extension: ModuleType, name: str) -> None:
    text = extension.executed(DOCS / "notebooks" / f"{name}.py")
    assert text.startswith("# ")
    assert "```text" in text or "{raw} html" in text
    # What was printed, not the code that would print it.
    assert not re.search(r"^(?!.*\{).*\bfails\b", text, re.MULTILINE)


def test_there_are_four_notebooks_with_a_page_each() -> None:
    assert len(NOTEBOOKS) == 4
    for name in NOTEBOOKS:
        assert (DOCS / "notebooks" / f"{name}.md").read_text(encoding="utf-8") == f"```{{executed}} {name}.py\n```\n"


@pytest.mark.nightly
@pytest.mark.slow
def test_the_site_is_searched_offline_and_its_commands_are_copied_as_they_stand(tmp_path: Path) -> None:
    path = chromium_path()
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "-b", "html", str(DOCS), str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True)
    check_site(tmp_path, path)


def check_site(site: Path, path: str) -> None:
    """Look at a site that was built, in a browser without a server."""
    commands = re.sub(r"<[^>]+>", "", (site / "reference" / "cli.html").read_text(encoding="utf-8"))
    assert "--json" in commands
    assert "\u2013" not in commands  # the dash that a shell does not know
    with started(path) as browser:
        page: Page = browser.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto((site / "search.html").as_uri() + "?q=hysteresis")
        page.locator("#search-results li a").first.wait_for(timeout=20_000)
        assert page.locator("#search-results li").count() >= 2
        page.goto((site / "gallery.html").as_uri())
        broken = "[...document.images].filter(image => !image.complete || !image.naturalWidth).length"
        assert page.evaluate(broken) == 0
        assert page.locator(".gallery a").count() >= 9
        # The formulas' fonts and all else come with the pages.
        assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
