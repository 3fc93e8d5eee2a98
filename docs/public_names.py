"""A table of the public names of each subpackage, made from stubs and docstrings when the pages are built.

The stub `__init__.pyi` of a subpackage says which names are public; the first line of a docstring, or of the comment
`#:` above a constant, says what each is for. In a page: the directive `public-names`.
"""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

PACKAGE = Path(__file__).parents[1] / "softneck"
# Names below this line of a stub are for softneck's own subpackages.
SHARED = "# isort: split"


class PublicName(NamedTuple):
    """One name that a subpackage exports.

    Attributes:
        subpackage: dotted name of the package.
        name: as it is imported from there.
        target: dotted name where the API page documents it.
        purpose: one line; "" if nobody wrote one.
    """

    subpackage: str
    name: str
    target: str
    purpose: str


def subpackages() -> list[str]:
    """Return the subpackages that export something, the front door first."""
    stubs = sorted(PACKAGE.rglob("__init__.pyi"), key=lambda path: (len(path.parts), path))
    return [".".join(stub.parent.relative_to(PACKAGE.parent).parts) for stub in stubs]


def names_of(subpackage: str) -> Iterator[PublicName]:
    """Yield the names that a subpackage exports, in the order of its stub; subpackages inside it are not among them."""
    stub = PACKAGE.parent.joinpath(*subpackage.split("."), "__init__.pyi")
    documented, _, _ = stub.read_text(encoding="utf-8").partition(SHARED)
    for node in ast.parse(documented).body:
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            module = importlib.import_module(f"{subpackage}.{node.module}")
            # What the front door lends is documented in its own subpackage.
            home = subpackage if subpackage != "softneck" else f"softneck.{node.module.partition('.')[0]}"
            for alias in node.names:
                yield PublicName(subpackage, alias.name, f"{home}.{alias.name}", purpose(module, alias.name))


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


def table(subpackage: str) -> str:
    """Return one subpackage's names as a table in Markdown, the names as links to their documentation."""
    rows = [f"| {{py:obj}}`{item.name} <{item.target}>` | {_cell(item.purpose)} |" for item in names_of(subpackage)]
    return "\n".join(["| name | what it is for |", "|---|---|", *rows])


def _cell(text: str) -> str:
    return text.replace("|", r"\|").replace("*", r"\*")


def page() -> str:
    """Return all tables, each under the name of its subpackage and the first line on what is inside."""
    parts = []
    for subpackage in subpackages():
        inside = (importlib.import_module(subpackage).__doc__ or "").partition("\n")[0]
        parts.append(f"## {subpackage}\n\n{inside}\n\n{table(subpackage)}")
    return "\n\n".join(parts)


def skip_shared(app: Any, what: str, name: str, *_: Any) -> bool | None:
    """Return True for a member of a subpackage's page that is not documented; None leaves the choice to Sphinx."""
    page, _, subpackage = app.env.current_document.docname.rpartition("/")
    if what != "module" or page != "reference/api":
        return None
    return None if name in {item.name for item in names_of(f"softneck.{subpackage}")} else True


def setup(app: Any) -> dict[str, bool]:
    """Give Sphinx the directive."""
    from sphinx.util.docutils import SphinxDirective

    class PublicNames(SphinxDirective):
        """`public-names`: the tables of all subpackages."""

        def run(self) -> list[Any]:
            # Docstrings change while the page with this directive does not.
            self.env.note_reread()
            return self.parse_text_to_nodes(page(), allow_section_headings=True)

    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-skip-member", skip_shared)
    return {"parallel_read_safe": True}
