"""`sn_kinds.h` in pieces: which functions a kind needs, so that the sources in an FMU hold no others."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Set

_DEFINED = re.compile(r"^(?:SN_SMALL )?static [^(\[=;]*?(\w+)[(\[]", re.MULTILINE)
_NUMBERED = re.compile(r"\w+\d\b")
_ENTRY = re.compile(r'^    \{"([^"]+)", .*\},\n', re.MULTILINE)
_COUNT = re.compile(r"(sn_kind_count = )\d+")


def defined(piece: str) -> str:
    """Return the name of the function or table that a piece of generated C defines; "" for none."""
    found = _DEFINED.search(piece)
    return found[1] if found else ""


def reached(pieces: Mapping[str, str], roots: Iterable[str]) -> set[str]:
    """Return the names of the pieces that `roots` use, directly or through others; all are numbered."""
    found: set[str] = set()
    waiting = [name for name in roots if name in pieces]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += [word for word in set(_NUMBERED.findall(pieces[name])) if word in pieces]
    return found


def nested_loops(piece: str) -> int:
    """Return how many loops of a function stand within each other at most; 0 for none."""
    depth, most = 0, 0
    open_loops: list[int] = []
    for line in piece.splitlines():
        if line.lstrip().startswith("for ("):
            open_loops.append(depth)
            most = max(most, len(open_loops))
        depth += line.count("{") - line.count("}")
        while open_loops and depth <= open_loops[-1]:
            open_loops.pop()
    return most


def only_kinds(text: str, modules: Set[str]) -> str:
    """Return `sn_kinds.h` with the runtimes `modules` alone."""
    left_out = [entry[0] for entry in _ENTRY.finditer(text) if entry[1] not in modules]
    for entry in left_out:
        text = text.replace(entry, "")
    text = _COUNT.sub(rf"\g<1>{len(_ENTRY.findall(text))}", text)
    # An empty line stands between two functions, none within one.
    pieces = text.split("\n\n")
    functions = {defined(piece): piece for piece in pieces if _is_function(piece)}
    roots = [word for entry in _ENTRY.finditer(text) for word in _NUMBERED.findall(entry[0])]
    needed = reached(functions, roots)
    return "\n\n".join(piece for piece in pieces if not _is_function(piece) or defined(piece) in needed)


def _is_function(piece: str) -> bool:
    return bool(re.search(r"\d$", defined(piece)))
