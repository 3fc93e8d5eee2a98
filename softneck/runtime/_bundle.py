"""One self-contained source text out of a kind's runtime modules.

A runtime module imports numpy, math and other runtime modules only. The bundle is what its functions need of those
modules, behind each other, without words and with places for names (see `_names`). numba compiles it, and an FMU
carries it: what runs in the kit and what runs in the host is the same text, under a name that its content decides.
A line that changes reaches the kinds that need it and no other.

A runtime may hold others: `outer(inner:11,other:13)` is module `outer` over member `inner`, which reads the first
11 arrays behind those of `outer`, and `other`, which reads the next 13. Each member's names get a prefix, and the
calls `member_*` of `_members_runtime` become calls of the members.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from softneck.core import SettingsError

from ._composition import member_calls, prefixed
from ._layout import Arrays, StateVector
from ._names import lowered, state_size

_LOOPS = "softneck.runtime._loops_runtime"
_MEMBERS = "softneck.runtime._members_runtime"
_DECLARATIONS = "softneck.runtime._layout"
_ALLOWED = {"numpy", "math", "__future__", _DECLARATIONS}


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
    texts = [prefixed(bundle(member, loops=False), f"m{i}_") for i, (member, _) in enumerate(members)]
    if members and _MEMBERS in order:
        order.remove(_MEMBERS)
        tangents = all(_has_tangent(member) for member, _ in members)
        texts.append(member_calls([count for _, count in members], own_arrays(outer), tangents=tangents))
    found = {module: [node for node in _statements(module) if not set(skip) & set(_defined(node))] for module in order}
    home = next((module for module in order if _defines(found[module], "step")), None)
    if home is not None and not any(_defines(nodes, "state_size") for nodes in found.values()):
        found[home].append(state_size(declared(home, Arrays), declared(home, StateVector)))
    if loops:
        found[_LOOPS] = [node for node in _statements(_LOOPS) if "step" not in _defined(node)]
    _check_names(found)
    kept = _needed(found, outer, [node for text in texts for node in ast.parse(text).body])
    parts = ["# A softneck runtime: generated, do not edit.", "import math", "", "import numpy as np", "", *texts]
    parts += [ast.unparse(node) + "\n" for nodes in found.values() for node in nodes if kept & set(_defined(node))]
    return "\n".join(parts)


def content_name(text: str, prefix: str = "softneck") -> str:
    """Return a module name that the content of `text` decides."""
    return f"{prefix}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def own_arrays(outer: str) -> int:
    """Return how many arrays a module with members reads before those of its members."""
    return len(declared(outer, Arrays).fields)


def declared(module: str, base: type) -> Any:
    """Return the class of arrays or of the state that a module's `step` works on, or else its first function.

    Raises:
        SettingsError: it names none.
    """
    functions = [node for node in _tree(module).body if isinstance(node, ast.FunctionDef)]
    for function in sorted(functions, key=lambda node: node.name != "step"):
        for argument in function.args.args:
            name = argument.annotation.id if isinstance(argument.annotation, ast.Name) else ""
            found = getattr(import_module(module), name, None)
            if isinstance(found, type) and issubclass(found, base):
                return found
    raise SettingsError(f"runtime module {module} does not declare its {base.__name__}.")


def _members(runtime: str) -> tuple[str, list[tuple[str, int]]]:
    """Return the outer module, and each member with the number of its arrays."""
    outer, _, inner = runtime.partition("(")
    pairs = [part.rpartition(":") for part in inner.rstrip(")").split(",")] if inner else []
    return outer, [(name, int(count)) for name, _, count in pairs]


def _has_tangent(member: str) -> bool:
    """Return whether the module of a member says how its outputs answer to planned inputs."""
    return any(_defined(node) == ["tangent"] for node in _tree(member.partition("(")[0]).body)


def _collect(module: str, order: list[str]) -> None:
    for node in _tree(module).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").endswith("_runtime"):
            _collect(node.module or "", order)
    if module not in order:
        order.append(module)


def _statements(module: str) -> list[ast.stmt]:
    """Return the functions and constants of a module, with places for names."""

    def find(name: str) -> Any:
        return None if hasattr(builtins, name) else getattr(import_module(module), name, None)

    kept: list[ast.stmt] = []
    for node in _tree(module).body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            _check_import(module, node)
        elif isinstance(node, ast.FunctionDef):
            kept.append(lowered(node, find, module))
        elif isinstance(node, ast.Assign):
            kept.append(node)
        elif not isinstance(node, ast.ClassDef | ast.Expr):
            raise SettingsError(f"runtime module {module} has a statement of another kind in line {node.lineno}.")
    return kept


def _check_names(found: dict[str, list[ast.stmt]]) -> None:
    names: dict[str, str] = {}
    for module, nodes in found.items():
        for defined in (name for node in nodes for name in _defined(node)):
            if defined in names:
                raise SettingsError(f"runtime modules {names[defined]} and {module} both define `{defined}`.")
            names[defined] = module


def _needed(found: dict[str, list[ast.stmt]], outer: str, others: list[ast.stmt]) -> set[str]:
    """Return the names that the outer module offers, and all that these, the loops and `others` read."""
    by_name = {name: node for nodes in found.values() for node in nodes for name in _defined(node)}
    waiting = ["state_size", *(name for node in (*found[outer], *found.get(_LOOPS, ())) for name in _defined(node))]
    waiting += [item.asname or item.name for node in _tree(outer).body for item in getattr(node, "names", ())]
    waiting += [name for node in others for name in _read(node)]
    kept: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in by_name and name not in kept:
            kept.add(name)
            waiting += _read(by_name[name])
    return kept


def _defines(nodes: list[ast.stmt], name: str) -> bool:
    return any(name in _defined(node) for node in nodes)


def _read(node: ast.stmt) -> list[str]:
    return [part.id for part in ast.walk(node) if isinstance(part, ast.Name)]


def _defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else []
    return [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]


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
