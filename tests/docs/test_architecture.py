"""The page on the architecture: its picture and table are today's, its rules hold, and its walk-through runs."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from softneck.cli._main import group

from ..data import ROOT

PAGE = ROOT / "docs" / "architecture.md"
Graph = dict[str, frozenset[str]]
TEXT = PAGE.read_text(encoding="utf-8")
_PLACES = ("Where things are", "The path of a sample", "Where to add what")


@pytest.fixture(scope="module")
def drawing() -> ModuleType:
    """The script that draws the picture."""
    pytest.importorskip("grimp", reason="grimp comes with import-linter (dependency group `lint`)")
    spec = importlib.util.spec_from_file_location("architecture", ROOT / "docs" / "architecture.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def graph(drawing: ModuleType) -> Graph:
    return drawing.subpackages_and_imports()


def test_picture_and_table_are_those_of_todays_imports(drawing: ModuleType, graph: Graph) -> None:
    assert drawing.PICTURE.read_text(encoding="utf-8") == drawing.picture(graph), "run python docs/architecture.py"
    assert drawing.with_table(TEXT, drawing.table(graph)) == TEXT, "run python docs/architecture.py"


def test_the_picture_leaves_out_what_other_arrows_say_and_nothing_else(drawing: ModuleType, graph: Graph) -> None:
    shown = drawing.direct(graph)

    def reach(edges: Graph, subpackage: str) -> set[str]:
        return {subpackage}.union(*(reach(edges, below) for below in edges[subpackage]))

    for subpackage in graph:
        assert shown[subpackage] <= graph[subpackage]
        assert reach(shown, subpackage) == reach(graph, subpackage)


def test_every_arrow_points_down_and_no_box_is_cut(drawing: ModuleType, graph: Graph) -> None:
    svg = drawing.picture(graph)
    width, height = (float(value) for value in re.findall(r'viewBox="0 0 (\d+) (\d+)"', svg)[0])
    boxes = [
        tuple(map(float, box)) for box in re.findall(r'<rect x="(-?\d+)" y="(-?\d+)" width="(\d+)" height="(\d+)"', svg)
    ]
    assert len(boxes) == len(graph)
    assert all(x >= 0 and y >= 0 and x + w <= width and y + h <= height for x, y, w, h in boxes)
    arrows = re.findall(r'<path d="M\d+ (\d+).* (\d+)"/>', svg)
    assert len(arrows) == sum(map(len, drawing.direct(graph).values()))
    assert all(float(begin) < float(end) for begin, end in arrows)


def test_every_subpackage_of_the_source_tree_is_in_the_table() -> None:
    subpackages = {path.parent.name for path in (ROOT / "softneck").glob("*/__init__.py")}
    assert set(re.findall(r"^\| `(\w+)` \|", TEXT, re.MULTILINE)) == subpackages


def test_every_function_and_subpackage_in_the_tables_of_places_is_there() -> None:
    sections = "".join(TEXT.partition(f"\n## {head}\n")[2].partition("\n## ")[0] for head in _PLACES)
    sources = sorted((ROOT / "softneck").rglob("*.py"))
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    known = set(re.findall(r"^ *(?:def|class) (\w+)|^([A-Z]\w+)\b.*=", text, re.MULTILINE))
    known = (
        {name for pair in known for name in pair}
        | {name for path in sources for name in (path.stem, path.parent.name)}
        | {"auto", "case"}
    )
    named = re.findall(r"`([A-Za-z_][\w.]*)`", sections)
    assert len(named) > 50
    inner = {name for item in named if not item.endswith((".toml", ".md")) for name in item.split(".")}
    assert inner - known - {"softneck", *group.commands} == set()


@pytest.mark.parametrize(
    ("outside", "subpackages"),
    [
        # The command line and the report ask fmpy what a file is.
        ("FMI", {"fmu", "cosim", "cli", "report"}),
        ("buses and ports", {"drives"}),
        # The bar of what takes long in Python is drawn in `core`.
        ("terminal", {"cli", "core", "drives"}),
        ("sockets", {"drives"}),
    ],
)
def test_what_is_outside_is_touched_at_the_edge(
    outside: str, subpackages: set[str], drawing: ModuleType, graph: Graph
) -> None:
    assert {subpackage for subpackage in graph if outside in drawing.touches(subpackage)} <= subpackages


def test_subpackages_import_what_their_docstrings_say(drawing: ModuleType, graph: Graph) -> None:
    """`May import a, b and below` names subpackages; those below them are the lower layers of the contract."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    layers = [re.findall(r"softneck\.(\w+)", layer) for layer in contracts[0]["layers"]]
    height = {subpackage: -row for row, names in enumerate(layers) for subpackage in names}
    for subpackage, imported in graph.items():
        said = drawing.docstring(subpackage)[2]
        named = set(re.findall(r"`(\w+)`", said.partition("May import")[2].partition(";")[0].lower()))
        named |= set(re.findall(r"`(\w+)`", said.partition("may import")[2]))
        if "everything" in said:
            continue
        top = max((height[name] for name in named), default=-len(layers))
        assert all(name in named or ("below" in said and height[name] <= top) for name in imported), subpackage


@pytest.mark.slow
def test_the_walk_through_runs(tmp_path: Path) -> None:
    """Blocks that begin with a file's name are written, the others run behind each other in a process of their own."""
    script = []
    for language, text in re.findall(r"^```(python|toml)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL):
        name = re.match(r"# (\w+\.(?:py|toml))\n", text)
        if name is not None:
            (tmp_path / name[1]).write_text(text, encoding="utf-8")
        else:
            assert language == "python"
            script.append(text)
    # Three walk-throughs: kind (table, use), sensor (check), profile (tables, check).
    assert len(script) == 5
    (tmp_path / "walk.py").write_text("\n".join(script), encoding="utf-8")
    path = os.pathsep.join(filter(None, (str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", ""))))
    done = subprocess.run(
        [sys.executable, "-W", "error", "walk.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "Gain.fmu").is_file()
