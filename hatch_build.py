"""Reads README.md for a wheel: its links are of the repository's files, which a wheel does not have beside it.

They become absolute where `[project.urls]` names the `Source`, and plain words where it does not.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

# [words](path) and ![words](path); an address or a place in the page itself stays.
_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#|mailto:)([^)]+)\)")


class Readme(MetadataHookInterface):
    """The field `readme` of the project's metadata."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Fill in the text."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        home = metadata.get("urls", {}).get("Source")
        metadata["readme"] = {"content-type": "text/markdown", "text": with_links(text, home)}


def with_links(text: str, home: str | None) -> str:
    """Return Markdown whose links lead to `home`, such as https://host/owner/name/blob/main; None: without them."""
    if home is None:
        return _LINK.sub(r"\2", text)
    return _LINK.sub(lambda m: f"{m[1]}[{m[2]}]({home.rstrip('/')}/{m[3]})", text)
