"""A table of what softneck needs and under which licence, made from the installed packages' own metadata.

`python docs/licences.py` prints it; in a page: the directive `licences`.
"""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
_NAME = re.compile(r"[A-Za-z0-9_.-]+")
_CLASSIFIER = "License :: "
# A licence's whole text stands in some packages' field; its first line says which it is.
_MOST = 60


def needed() -> dict[str, list[str]]:
    """Return package -> what it is needed by: "softneck" or extras, as pyproject.toml says."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    groups = {"softneck": project["dependencies"], **project["optional-dependencies"]}
    found: dict[str, list[str]] = {}
    for group, requirements in groups.items():
        for requirement in requirements:
            match = _NAME.match(requirement)
            if match and match[0] != "softneck":
                found.setdefault(match[0], []).append(group)
    return dict(sorted(found.items()))


def licence(package: str) -> tuple[str, str]:
    """Return version and licence of an installed package; "not installed" where there is none."""
    try:
        about: Any = metadata.metadata(package)
    except metadata.PackageNotFoundError:
        return "", "not installed"
    classes = [text for text in about.get_all("Classifier") or () if text.startswith(_CLASSIFIER)]
    said = (about.get("License-Expression") or "").strip()
    said = said or ", ".join(text.rpartition(" :: ")[2] for text in classes if text.count(" :: ") > 1)
    lines = (about.get("License") or "").strip().splitlines() or _file(package)
    return about["Version"], said or lines[0][:_MOST]


def _file(package: str) -> list[str]:
    """Return the first lines of the licence that an installed package brings along."""
    for file in metadata.files(package) or ():
        if file.name.upper().startswith(("LICENSE", "LICENCE", "COPYING")):
            lines = file.read_text(encoding="utf-8").strip().splitlines()
            return [line.strip() for line in lines if "licen" in line.lower()] or lines
    return ["not said"]


def table() -> str:
    """Return the table in Markdown."""
    rows = [(name, *licence(name), ", ".join(groups)) for name, groups in needed().items()]
    head = "| package | version | licence | needed by |\n|---|---|---|---|\n"
    return head + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def setup(app: Any) -> dict[str, bool]:
    """Give Sphinx the directive."""
    from sphinx.util.docutils import SphinxDirective

    class Licences(SphinxDirective):
        """`licences`: the table."""

        def run(self) -> list[Any]:
            # Packages change while the page with this directive does not.
            self.env.note_reread()
            return self.parse_text_to_nodes(table())

    app.add_directive("licences", Licences)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    print(table())
