"""Draw the subpackages and their imports, and list what is inside each: `python docs/architecture.py`.

Writes `docs/_static/architecture.svg` and the table inside `docs/architecture.md`, both from today's imports
and the subpackages' own docstrings; `tests/docs/test_architecture.py` fails where the committed ones are not those.
Needs grimp, which comes with import-linter (dependency group `lint`).
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from functools import cache
from itertools import combinations, pairwise
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "_static" / "architecture.svg"
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- subpackages: written by docs/architecture.py -->\n", "<!-- end of subpackages -->\n"

# Parts of the outside world that a subpackage uses, by the modules that it imports, and for files by the functions.
WORLD = {
    "FMI": {"fmpy", "pythonfmu"},
    "buses and ports": {"can", "canopen", "serial"},
    "clocks": {"time"},
    "processes": {"subprocess", "multiprocessing", "loky", "distributed"},
    "sockets": {"socket"},
    "terminal": {"click", "rich", "termios", "tty"},
    "files": {
        "open",
        "read_text",
        "write_text",
        "read_bytes",
        "write_bytes",
        "atomic_write",
        "read_archive",
        "write_archive",
    },
}

# A module that is imported, or a function that is called.
_SIGNS = re.compile(r"^ *(?:import|from) (\w+)|\b(\w+)\(", re.MULTILINE)

Graph = Mapping[str, frozenset[str]]
# Of the picture [px].
WIDTH, LEVEL, BOX, MARGIN = 1000.0, 118.0, 58.0, 20.0
# A long import passes between boxes; it needs less space than a box does.
PASSAGE, GAP = 26.0, 34.0
# Of a letter in each size of text, generously: fonts differ.
TITLE, SMALL = 10.5, 6.2


def subpackages_and_imports() -> Graph:
    """Return each subpackage of `softneck` with the subpackages that it imports, inside functions too."""
    graph = grimp.build_graph("softneck", cache_dir=None)
    graph.remove_module("softneck.__main__")  # the entry of `python -m softneck` is no subpackage
    found: dict[str, set[str]] = {name.partition(".")[2]: set() for name in graph.find_children("softneck")}
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            here, there = _subpackage(module), _subpackage(imported)
            if here and there and here != there:
                found[here].add(there)
    return {subpackage: frozenset(found[subpackage]) for subpackage in sorted(found)}


def _subpackage(module: str) -> str:
    return [*module.split("."), ""][1]


def levels(graph: Graph) -> dict[str, int]:
    """Return the number of layers below each subpackage; raise ValueError if imports form a circle."""
    found: dict[str, int] = {}
    while len(found) < len(graph):
        ready = [subpackage for subpackage in graph if subpackage not in found and graph[subpackage] <= found.keys()]
        if not ready:
            raise ValueError(f"imports go round in a circle among {sorted(graph.keys() - found.keys())}")
        found |= {
            subpackage: 1 + max((found[below] for below in graph[subpackage]), default=-1) for subpackage in ready
        }
    return found


def direct(graph: Graph) -> Graph:
    """Return the imports that no chain of others implies: those that the picture shows."""
    reach: dict[str, frozenset[str]] = {}
    for subpackage in sorted(graph, key=levels(graph).__getitem__):
        reach[subpackage] = graph[subpackage].union(*(reach[below] for below in graph[subpackage]))
    return {
        subpackage: frozenset(b for b in below if not any(b in reach[other] for other in below - {b}))
        for subpackage, below in graph.items()
    }


def inner_subpackages(subpackage: str) -> list[str]:
    """Return the subpackages inside a subpackage."""
    return sorted(path.parent.name for path in (ROOT / "softneck" / subpackage).glob("*/__init__.py"))


def docstring(subpackage: str) -> tuple[str, str, str]:
    """Return the docstring of a subpackage: its content, and two lines on its rules and imports."""
    text = (
        ast.get_docstring(ast.parse((ROOT / "softneck" / subpackage / "__init__.py").read_text(encoding="utf-8"))) or ""
    )
    inside, _, keeps, may = text.splitlines()
    return inside, keeps, may


@cache
def touches(subpackage: str) -> tuple[str, ...]:
    """Return the parts of `WORLD` that a subpackage uses."""
    used: set[str] = set()
    for path in (ROOT / "softneck" / subpackage).rglob("*.py"):
        for module, function in _SIGNS.findall(path.read_text(encoding="utf-8")):
            used.add(module or (function if function in WORLD["files"] else ""))
    return tuple(name for name, signs in WORLD.items() if signs & used)


def table(graph: Graph) -> str:
    """Return the table of subpackages, from the top layer down."""
    level = levels(graph)
    lines = ["| subpackage | what is inside |", "|---|---|"]
    for subpackage in sorted(graph, key=lambda name: (-level[name], name)):
        inside = docstring(subpackage)[0]
        lines.append(f"| `{subpackage}` | {inside} |")
    return "\n".join(lines) + "\n"


def with_table(page: str, text: str) -> str:
    """Return the page with `text` as its table of subpackages."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}"


def picture(graph: Graph) -> str:
    """Return the picture as SVG; the same imports give the same text."""
    level = levels(graph)
    rows, chains = _rows(direct(graph), level)
    x = _places(rows, chains)
    height = 2 * MARGIN + BOX + LEVEL * max(level.values())

    def y(row: int) -> float:
        return height - MARGIN - BOX / 2 - LEVEL * row

    lines = [_line([(x[node], y(row)) for node, row in chain]) for chain in chains]
    boxes = [_box(subpackage, x[subpackage], y(level[subpackage])) for subpackage in sorted(graph)]
    return "\n".join([_HEAD.format(w=WIDTH, h=height), *lines, "  </g>", *boxes, "</svg>", ""])


_HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w:g} {h:g}" font-family="system-ui, sans-serif">
  <rect width="{w:g}" height="{h:g}" fill="#fbfbf9"/>
  <defs>
    <marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">
      <path d="M0 0L10 5L0 10z" fill="#1c2530"/>
    </marker>
  </defs>
  <g fill="none" stroke="#1c2530" stroke-width="1.3" marker-end="url(#a)">"""

Chain = list[tuple[str, int]]


def _rows(edges: Graph, level: Mapping[str, int]) -> tuple[list[list[str]], list[Chain]]:
    """Return the subpackages and long arrows on each level, and each arrow from level to level."""
    rows: list[list[str]] = [[] for _ in range(max(level.values()) + 1)]
    for subpackage in sorted(level):
        rows[level[subpackage]].append(subpackage)
    chains: list[Chain] = []
    for above in sorted(edges):
        for below in sorted(edges[above]):
            between = [(f"{above}>{below}>{row}", row) for row in range(level[above] - 1, level[below], -1)]
            for name, row in between:
                rows[row].append(name)
            chains.append([(above, level[above]), *between, (below, level[below])])
    return rows, chains


def _places(rows: list[list[str]], chains: list[Chain]) -> dict[str, float]:
    """Return where each stands from the left, in an order with few crossings (Sugiyama's barycentres)."""
    near: dict[str, list[str]] = {name: [] for row in rows for name in row}
    for chain in chains:
        for (one, _), (other, _) in pairwise(chain):
            near[one].append(other)
            near[other].append(one)
    x = {name: place for row in rows for name, place in _spread(row).items()}
    best, fewest = x, _crossings(chains, x)
    # Twenty sweeps are more than enough for seven levels.
    for _ in range(20):
        for row in (*rows, *reversed(rows)):
            row.sort(key=lambda name: (sum(x[other] for other in near[name]) / max(1, len(near[name])), name))
            x = {**x, **_spread(row)}
        if (count := _crossings(chains, x)) < fewest:
            best, fewest = x, count
    return best


def _crossings(chains: list[Chain], x: Mapping[str, float]) -> int:
    steps: dict[int, list[tuple[float, float]]] = {}
    for chain in chains:
        for (one, row), (other, _) in pairwise(chain):
            steps.setdefault(row, []).append((x[one], x[other]))
    return sum((a - c) * (b - d) < 0 for row in steps.values() for (a, b), (c, d) in combinations(row, 2))


def _box_width(subpackage: str) -> float:
    return max(
        110.0, 26.0 + max(TITLE * len(subpackage), *(SMALL * len(line) for line in ("", *_inner_lines(subpackage))))
    )


def _width(name: str) -> float:
    return PASSAGE if ">" in name else _box_width(name)


def _spread(row: list[str]) -> dict[str, float]:
    """Return the row's places, centred, with equal gaps."""
    gap = min(GAP, (WIDTH - 2 * MARGIN - sum(map(_width, row))) / max(1, len(row) - 1))
    at = (WIDTH - sum(map(_width, row)) - gap * (len(row) - 1)) / 2
    places = {}
    for name in row:
        places[name] = at + _width(name) / 2
        at += _width(name) + gap
    return places


def _line(points: list[tuple[float, float]]) -> str:
    """Return an arrow from the lower edge of the first box to the upper edge of the last, straight through passages."""
    text = f"M{points[0][0]:.0f} {points[0][1] + BOX / 2:.0f}"
    for i, ((x0, y0), (x1, y1)) in enumerate(pairwise(points)):
        begin, end = y0 + BOX / 2, y1 - BOX / 2 - (2.0 if i == len(points) - 2 else 0.0)
        middle = (begin + end) / 2
        text += f"C{x0:.0f} {middle:.0f} {x1:.0f} {middle:.0f} {x1:.0f} {end:.0f}"
        if i < len(points) - 2:
            text += f"V{y1 + BOX / 2:.0f}"
    return f'    <path d="{text}"/>'


def _inner_lines(subpackage: str) -> list[str]:
    """Return the names of the subpackages inside, in at most two lines."""
    names = inner_subpackages(subpackage)
    cut = (len(names) + 1) // 2 if len(names) > 4 else len(names)
    return [", ".join(part) for part in (names[:cut], names[cut:]) if part]


def _box(subpackage: str, x: float, y: float) -> str:
    width, inner = _box_width(subpackage), _inner_lines(subpackage)
    first = y + 5 - 8 * len(inner)
    texts = [f'    <text x="{x:.0f}" y="{first:.0f}" font-size="16" font-weight="600">{subpackage}</text>']
    texts += [
        f'    <text x="{x:.0f}" y="{first + 17 + 14 * i:.0f}" font-size="11.5">{line}</text>'
        for i, line in enumerate(inner)
    ]
    return "\n".join([
        '  <g text-anchor="middle" fill="#1c2530">',
        f'    <rect x="{x - width / 2:.0f}" y="{y - BOX / 2:.0f}" width="{width:.0f}" height="{BOX:.0f}" rx="6"'
        ' fill="#fff" stroke="#0072B2" stroke-width="1.6"/>',
        *texts,
        "  </g>",
    ])  # fmt: skip


def main() -> None:
    """Write picture and table."""
    graph = subpackages_and_imports()
    PICTURE.write_text(picture(graph), encoding="utf-8")
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), table(graph)), encoding="utf-8")


if __name__ == "__main__":
    main()
