"""Results that a run keeps line by line, so that one that was stopped goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def keep(path: Path, line: dict[str, Any]) -> None:
    """Add a line."""
    with path.open("a", encoding="utf-8") as file:
        # The break comes first: what a kill cut short spoils no line but its own.
        file.write("\n" + json.dumps(line))


def kept_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield what is kept; a line that was cut short counts for nothing."""
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            yield json.loads(text)
        except json.JSONDecodeError:
            continue
