"""Tables of each kind's arrays and state, made from the declarations in its runtime. In a page: `kinds-tables`."""

from __future__ import annotations

import importlib
from typing import Any

from softneck.core import KINDS
from softneck.runtime._bundle import layout_of
from softneck.runtime._layout import Arrays, StateVector


def tables() -> str:
    """Return the tables of all runtimes, each under the names of the kinds that it steps."""
    kinds: dict[str, list[str]] = {}
    for kind in KINDS.values():
        if kind.runtime:
            kinds.setdefault(kind.runtime, []).append(kind.name)
    kinds["softneck.plant._neck_runtime"] = ["virtual_neck"]
    return "\n\n".join(section(runtime, names) for runtime, names in kinds.items())


def section(runtime: str, names: list[str]) -> str:
    """Return the two tables of one runtime."""
    inside = (importlib.import_module(runtime).__doc__ or "").partition("\n")[0].rstrip(":.")
    title = ", ".join(f"`{name}`" for name in names)
    arrays, state = table(layout_of(runtime, Arrays), "array"), table(layout_of(runtime, StateVector), "state")
    return f"## {title}\n\n{inside}.\n\n{arrays}\n\n{state}"


def table(layout: type[Arrays] | type[StateVector], head: str) -> str:
    """Return one declaration as a table in Markdown."""
    rows = [f"| {head} | shape | what it is |", "|---|---|---|"]
    for name, field in layout.fields.items():
        shape = "as long as it takes" if field.open else f"`({', '.join(field.shape)})`" if field.shape else "number"
        rows.append(f"| `{name}` | {shape} | {field.meaning.replace('|', chr(92) + '|').replace('*', chr(92) + '*')} |")
    symbols = [f"`{name}` is {of(layout, name)}" for name in layout.symbols]
    return "\n".join(rows) + (f"\n\n{'; '.join(symbols)}." if symbols else "")


def of(layout: type[Arrays] | type[StateVector], name: str) -> str:
    """Return what a symbol of the shapes stands for."""
    symbol = layout.symbols[name]
    if symbol.function is not None:
        return f"`{symbol.function.__name__}({symbol.array})`"
    return f"`{symbol.array}[{', '.join(map(str, symbol.places))}]`"


def setup(app: Any) -> dict[str, bool]:
    """Give Sphinx the directive."""
    from sphinx.util.docutils import SphinxDirective

    class KindsTables(SphinxDirective):
        """`kinds-tables`: the tables of all kinds."""

        def run(self) -> list[Any]:
            # Declarations change while the page with this directive does not.
            self.env.note_reread()
            return self.parse_text_to_nodes(tables(), allow_section_headings=True)

    app.add_directive("kinds-tables", KindsTables)
    return {"parallel_read_safe": True}
