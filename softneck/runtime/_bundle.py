"""One self-contained source text out of a kind's runtime modules.

A runtime module imports numpy, math and other runtime modules only. The bundle is those modules behind
each other without the imports between them. numba compiles it, and an FMU carries it: what runs in the
kit and what runs in the host is the same text, under a name that its content decides.

A runtime may hold others: `outer(inner:11,other:13)` is module `outer` over member `inner`, which reads the first
11 arrays behind those of `outer`, and `other`, which reads the next 13. Each member's names get a prefix, and the
calls `member_*` of `_members_runtime` become calls of the members; one that calls `member_tangent` gets their
derivatives with them.
"""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from softneck.core import SettingsError

from ._composition import member_calls, prefixed
from ._tangent import with_tangent

_LOOPS = "softneck.runtime._loops_runtime"
_MEMBERS = "softneck.runtime._members_runtime"
_ALLOWED = {"numpy", "math", "__future__"}


@cache
def bundle(runtime: str, *, loops: bool = True, skip: tuple[str, ...] = ()) -> str:
    """Return the source text of runtime module `runtime` with all it needs.

    Args:
        runtime: dotted name, with members in brackets.
        loops: add the loops over `step`; false for a module of plain functions.
        skip: functions to leave out, which the caller writes otherwise.

    Raises:
        SettingsError: a module imports what a runtime must not, or two define the same name.
    """
    outer, members = _members(runtime)
    order: list[str] = []
    _collect(outer, order)
    names: dict[str, str] = {}
    parts = ["# A softneck runtime: generated, do not edit.", "import math", "", "import numpy as np", ""]
    tangents = bool(members) and any(_asks_for_tangents(module) for module in order)
    texts = [bundle(member, loops=False) for member, _ in members]
    parts += [prefixed(with_tangent(text) if tangents else text, f"m{i}_") for i, text in enumerate(texts)]
    for module in order:
        if module == _MEMBERS and members:
            parts.append(member_calls([count for _, count in members], _own_arrays(outer), tangents=tangents))
        else:
            parts.append(_stripped(module, names, skip=set(skip)))
    if loops:
        parts.append(_stripped(_LOOPS, names, skip={"step"}))
    return "\n".join(parts)


def content_name(text: str, prefix: str = "softneck") -> str:
    """Return a module name that the content of `text` decides."""
    return f"{prefix}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _members(runtime: str) -> tuple[str, list[tuple[str, int]]]:
    """Return the outer module, and each member with the number of its arrays."""
    outer, _, inner = runtime.partition("(")
    pairs = [part.rpartition(":") for part in inner.rstrip(")").split(",")] if inner else []
    return outer, [(name, int(count)) for name, _, count in pairs]


def _own_arrays(outer: str) -> int:
    """Return the number that a module with members says it reads before those of its members."""
    for node in _tree(outer).body:
        if _defined(node) == ["OWN_ARRAYS"] and isinstance(node, ast.Assign):
            return int(ast.literal_eval(node.value))
    raise SettingsError(f"runtime module {outer} takes no members: it does not say OWN_ARRAYS.")


def _asks_for_tangents(module: str) -> bool:
    """Return whether a module reads how the outputs of its members answer to their inputs."""
    imports = [node for node in _tree(module).body if isinstance(node, ast.ImportFrom) and node.module == _MEMBERS]
    return any(alias.name == "member_tangent" for node in imports for alias in node.names)


def _collect(module: str, order: list[str]) -> None:
    for node in _tree(module).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("softneck."):
            _collect(node.module, order)
    if module not in order:
        order.append(module)


def _stripped(module: str, names: dict[str, str], *, skip: set[str]) -> str:
    source = _source(module).splitlines()
    drop: set[int] = set()
    for node in _tree(module).body:
        name = getattr(node, "name", "")
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom):
            _check_import(module, node)
            drop.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        elif name in skip or docstring:
            drop.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        for defined in _defined(node):
            if defined in skip:
                continue
            if defined in names:
                raise SettingsError(f"runtime modules {names[defined]} and {module} both define `{defined}`.")
            names[defined] = module
    kept = [line for number, line in enumerate(source, start=1) if number not in drop]
    return f"# from {module}\n" + "\n".join(kept).strip("\n") + "\n\n"


def _defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


def _check_import(module: str, node: ast.Import | ast.ImportFrom) -> None:
    imported = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
    for name in imported:
        runtime = name.startswith("softneck.") and name.endswith("_runtime")
        if not runtime and name not in _ALLOWED:
            raise SettingsError(f"runtime module {module} imports `{name}`; only numpy and math are allowed.")


@cache
def _source(module: str) -> str:
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        raise SettingsError(f"there is no runtime module `{module}`.")
    return Path(spec.origin).read_text(encoding="utf-8")


def _tree(module: str) -> ast.Module:
    return ast.parse(_source(module))
