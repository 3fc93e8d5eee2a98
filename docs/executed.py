"""Notebooks as plain scripts in jupytext's percent format, run when the pages are built and shown with what they print.

`# %% [markdown]` begins words, `# %%` begins code. What the last line of a cell is worth is shown as a notebook shows
it: its picture or page if it has one, else its `repr`. `jupytext --to ipynb FILE` makes a notebook of each.
In a page: the directive `executed`.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import os
import tempfile
from code import InteractiveInterpreter
from pathlib import Path
from typing import Any, NamedTuple

_MARK, _WORDS = "# %%", "# %% [markdown]"


class Cell(NamedTuple):
    """One cell: words in Markdown, or code."""

    words: bool
    text: str


class _Interpreter(InteractiveInterpreter):
    def showtraceback(self) -> None:
        raise  # noqa: PLE0704  called while the error is being handled


def cells(source: str) -> list[Cell]:
    """Return the cells of a script in percent format."""
    found: list[tuple[bool, list[str]]] = []
    for line in source.splitlines():
        if line.startswith(_MARK):
            found.append((line.startswith(_WORDS), []))
        elif found:
            found[-1][1].append(line.removeprefix("#").removeprefix(" ") if found[-1][0] else line)
    return [Cell(words, "\n".join(lines).strip("\n")) for words, lines in found]


def executed(path: Path) -> str:
    """Run a script in a folder of its own and return it as Markdown, each cell with what it printed and showed."""
    parts, here = [], Path.cwd()
    interpreter = _Interpreter({"__name__": "__main__"})
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for cell in cells(path.read_text(encoding="utf-8")):
                parts.append(cell.text if cell.words else _ran(cell.text, interpreter, path.name))
        finally:
            os.chdir(here)
    return "\n\n".join(parts)


def _ran(code: str, interpreter: _Interpreter, name: str) -> str:
    tree, printed = ast.parse(code), io.StringIO()
    if tree.body and isinstance(tree.body[-1], ast.Expr):
        tree.body[-1] = ast.fix_missing_locations(
            ast.copy_location(ast.Assign([ast.Name("_shown", ast.Store())], tree.body[-1].value), tree.body[-1])
        )
    interpreter.locals.pop("_shown", None)
    with contextlib.redirect_stdout(printed):
        interpreter.runcode(compile(tree, name, "exec"))
    parts = [f"```python\n{code}\n```"]
    if printed.getvalue().strip():
        parts.append(f"```text\n{printed.getvalue().rstrip()}\n```")
    return "\n\n".join([*parts, *_shown(interpreter.locals.get("_shown"))])


def _shown(value: Any) -> list[str]:
    if value is None:
        return []
    if hasattr(value, "savefig"):
        buffer = io.BytesIO()
        value.savefig(buffer, format="png", dpi=80)
        data = base64.b64encode(buffer.getvalue()).decode()
        return [f'```{{raw}} html\n<img alt="what the cell drew" src="data:image/png;base64,{data}">\n```']
    page = value._repr_html_() if hasattr(value, "_repr_html_") else None
    return [f"```{{raw}} html\n{page}\n```" if page else f"```text\n{value!r}\n```"]


def setup(app: Any) -> dict[str, bool]:
    """Give Sphinx the directive."""
    from sphinx.util.docutils import SphinxDirective

    class Executed(SphinxDirective):
        """`executed`: one script beside the page."""

        required_arguments = 1

        def run(self) -> list[Any]:
            relative, path = self.env.relfn2path(self.arguments[0])
            self.env.note_dependency(relative)
            return self.parse_text_to_nodes(executed(Path(path)), allow_section_headings=True)

    app.add_directive("executed", Executed)
    return {"parallel_read_safe": False}
