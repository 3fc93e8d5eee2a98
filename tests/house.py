"""Print how the house reads: `python tests/house.py [ROOT]`, with the limit of each figure.

- odd first lines: docstrings whose first line holds a word of `ODD`, in percent;
- bare participles: functions called by one participle (`grounded`), where a verb says what they do;
- one-word constants: private constants of a module called by one word, with a literal behind it;
- files of the package, and words of README.md and docs/*.md.

`--list` names them. Exit code 1 where a figure is above its limit.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

# "Least squares" is the field's term.
ODD = ("what", "told", "seen", "asked", "know", "knows", "say", "says", "stand", "stands", "behind", "worth",
       r"least(?![ -]squares)", "lies", "nothing", "nobody", "whoever", "of ours", "of yours")  # fmt: skip
_ODD = re.compile(rf"\b({'|'.join(ODD)})\b", re.IGNORECASE)
# Participles that do not end in "ed".
_IRREGULAR = re.compile(
    r"held|made|seen|told|kept|known|said|shown|given|taken|drawn|grown|begun|done|gone|bound|built|left|met|risen|sent|"
    r"spent|stood|written|worn|torn|lost|meant|sought|bent|swept|driven|broken|chosen|frozen|hidden|spoken|thought|won|"
    r"heard|led|fed|laid|paid"
)
# Words that end in "ed" and are none.
_NOUNS = {"speed", "seed", "feed", "need", "bed", "red", "shed", "embed", "exceed", "proceed"}
LIMITS = {
    "odd first lines, %": 3.0,
    "bare participles": 70,
    "one-word constants": 150,
    "files": 450,
    "words of docs": 60_000,
}


def main() -> int:
    """Print the figures; return 1 where one is above its limit."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parents[1])
    parser.add_argument("--list", action="store_true", help="name what is counted")
    asked = parser.parse_args()
    files = sorted((asked.root / "softneck").rglob("*.py"))
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}
    lines = [entry for path, tree in trees.items() for entry in first_lines(path, tree)]
    odd = [entry for entry in lines if _ODD.search(entry.split(": ", 1)[1])]
    named = {"odd first lines, %": odd, "bare participles": [p for f, t in trees.items() for p in participles(f, t)],
             "one-word constants": [c for f, t in trees.items() for c in constants(f, t)]}  # fmt: skip
    figures = {
        "odd first lines, %": 100.0 * len(odd) / max(len(lines), 1),
        "bare participles": len(named["bare participles"]),
        "one-word constants": len(named["one-word constants"]),
        "files": len(files),
        "words of docs": sum(words(path) for path in documents(asked.root)),
    }
    for name, value in figures.items():
        if asked.list:
            print(*named.get(name, []), sep="\n")
        print(f"{name:20} {value:9.6g}  (limit {LIMITS[name]:g})")
    return int(any(value > LIMITS[name] for name, value in figures.items()))


def first_lines(path: Path, tree: ast.AST) -> Iterator[str]:
    """Yield `file:line: first line` of every docstring."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield f"{path}:{getattr(node, 'lineno', 1)}: {text.splitlines()[0]}"


def participles(path: Path, tree: ast.AST) -> Iterator[str]:
    """Yield `file:line: name` of every function called by one participle."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            name = node.name.strip("_")
            ends = name.endswith("ed") and name not in _NOUNS
            if "_" not in name and (ends or _IRREGULAR.fullmatch(name)) and not _is_property(node):
                yield f"{path}:{node.lineno}: {node.name}"


def constants(path: Path, tree: ast.Module) -> Iterator[str]:
    """Yield `file:line: name` of every private one-word constant of a module with a literal behind it."""
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        for target in node.targets:
            if isinstance(target, ast.Name) and re.fullmatch(r"_[A-Z0-9]+", target.id) and _is_literal(node):
                yield f"{path}:{node.lineno}: {target.id}"


def documents(root: Path) -> list[Path]:
    """Return README.md and the pages."""
    return [root / "README.md", *sorted(path for path in (root / "docs").rglob("*.md") if "_build" not in path.parts)]


def words(path: Path) -> int:
    """Return how many words a page has."""
    return len(path.read_text(encoding="utf-8").split())


def _is_property(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(
        isinstance(item, ast.Name) and item.id in ("property", "cached_property") for item in node.decorator_list
    )


def _is_literal(node: ast.Assign) -> bool:
    """Return whether a constant is a literal: a number, a text, or a tuple or expression of those."""
    return all(
        isinstance(part, ast.Constant | ast.Tuple | ast.List | ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop
                   | ast.expr_context)
        for part in ast.walk(node.value)
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
