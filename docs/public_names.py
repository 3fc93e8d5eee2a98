"""A table of the public names of each room, made from stubs and docstrings when the pages are built.

The stub `__init__.pyi` of a room says which names are public; the first line of a docstring, or of the comment `#:`
above a constant, says what each is for. In a page: the directive `public-names`.
"""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

PACKAGE = Path(__file__).parents[1] / "softneck"


class PublicName(NamedTuple):
    """One name that a room exports.

    Attributes:
        room: dotted name of the package.
        name: as it is imported from there.
        target: dotted name where the API page documents it.
        purpose: one line; "" if nobody wrote one.
    """

    room: str
    name: str
    target: str
    purpose: str


def rooms() -> list[str]:
    """Return the rooms that export something, the front door first."""
    stubs = sorted(PACKAGE.rglob("__init__.pyi"), key=lambda path: (len(path.parts), path))
    return [".".join(stub.parent.relative_to(PACKAGE.parent).parts) for stub in stubs]


def names_of(room: str) -> Iterator[PublicName]:
    """Yield the names that a room exports, in the order of its stub; rooms inside it are not among them."""
    stub = PACKAGE.parent.joinpath(*room.split("."), "__init__.pyi")
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            module = importlib.import_module(f"{room}.{node.module}")
            # What the front door lends is documented in its own room.
            home = room if room != "softneck" else f"softneck.{node.module.partition('.')[0]}"
            for alias in node.names:
                yield PublicName(room, alias.name, f"{home}.{alias.name}", purpose(module, alias.name))


def purpose(module: Any, name: str) -> str:
    """Return the first line of what is written about a name."""
    value = getattr(module, name)
    if inspect.isclass(value) or inspect.isroutine(value):
        return (inspect.getdoc(value) or "").partition("\n")[0]
    lines = inspect.getsource(module).splitlines()
    for number, line in enumerate(lines):
        if line.startswith((f"{name} =", f"{name}:")):
            above = number - 1
            while above >= 0 and lines[above].startswith("#"):
                above -= 1
            first = lines[above + 1]
            return first.removeprefix("#:").strip() if first.startswith("#:") else ""
    return ""


def table(room: str) -> str:
    """Return one room's names as a table in Markdown, the names as links to their documentation."""
    rows = [f"| {{py:obj}}`{item.name} <{item.target}>` | {_cell(item.purpose)} |" for item in names_of(room)]
    return "\n".join(["| name | what it is for |", "|---|---|", *rows])


def _cell(text: str) -> str:
    return text.replace("|", r"\|").replace("*", r"\*")


def page() -> str:
    """Return all tables, each under the name of its room and the first line on what is inside."""
    parts = []
    for room in rooms():
        inside = (importlib.import_module(room).__doc__ or "").partition("\n")[0]
        parts.append(f"## {room}\n\n{inside}\n\n{table(room)}")
    return "\n\n".join(parts)


def setup(app: Any) -> dict[str, bool]:
    """Give Sphinx the directive."""
    from sphinx.util.docutils import SphinxDirective

    class PublicNames(SphinxDirective):
        """`public-names`: the tables of all rooms."""

        def run(self) -> list[Any]:
            # Docstrings change while the page with this directive does not.
            self.env.note_reread()
            return self.parse_text_to_nodes(page(), allow_section_headings=True)

    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True}
