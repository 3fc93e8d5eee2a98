"""A prose linter: README, the pages and the docstrings use no archaic words and no private ones.

`python tests/test_prose.py` prints each place (`make check` runs it). Add a word here once it is gone everywhere.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
ARCHAIC = (
    "albeit|alas|amongst|anon|aught|betwixt|ere|forthwith|hath|henceforth|hereby|herein|heretofore|hither|hitherto|lest|"
    "likelier|mayhap|methinks|naught|nay|notwithstanding|oft|perchance|thence|thenceforth|thereof|therein|thereto|"
    "thither|thrice|twain|unto|verily|whence|whereby|wherefore|wherein|whereof|whereupon|whilst|whither|whoever|"
    "whomever|whosoever|whatsoever|wont|yonder"
)
# Say instead: fix, run, held-out robot, safety margin, simulation model, your own, false alarm, start, permissive.
PRIVATE = (
    "mend(?:s|ed|ing)?|rooms|sittings|foreign necks?|ke(?:pt|eps) back|plants? that steps?|of yours|"
    "cr(?:y|ies|ied) wolf|no business|in vain|begins? anew|goes astray|obliging"
)
WORDS = re.compile(rf"\b(?:{ARCHAIC}|{PRIVATE})\b".replace(" ", r"\s+"), re.IGNORECASE)


def texts() -> Iterator[tuple[str, int, str]]:
    """Yield path, first line and text of README, each page and each docstring."""
    for path in [ROOT / "README.md", *(page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts)]:
        yield str(path.relative_to(ROOT)), 1, path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "softneck").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node, clean=False) or ""
                yield str(path.relative_to(ROOT)), node.body[0].lineno if text else 1, text


def findings() -> list[str]:
    """Return `path:line: word` of every place."""
    return [
        f"{path}:{line + text.count(chr(10), 0, found.start())}: {found[0]!r}"
        for path, line, text in texts()
        for found in WORDS.finditer(text)
    ]


def test_no_text_has_a_word_of_the_list() -> None:
    assert findings() == []


def test_the_linter_finds_words_also_across_lines() -> None:
    found = [match[0] for match in WORDS.finditer("Whoever runs it on a foreign\n    neck mends it.")]
    assert found == ["Whoever", "foreign\n    neck", "mends"]


if __name__ == "__main__":
    sys.exit("\n".join(findings()) or None)
